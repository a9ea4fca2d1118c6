import ast
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.executing import InThisProcess
from helpers.scenes import small_scene
from helpers.waiting import wait_for

import synth.source_hash
from ash.capture.dataset import Capture, image_path, pixels_path, scan_path
from ash.capture.formats import load_capture, read_surface_mesh_truth
from ash.capture.manifest import read_manifest, verify_capture
from ash.files import InputError, sha256_of
from synth import cost, presets
from synth.camera import render
from synth.camera.render import find_libllvm, llvm_version, probe
from synth.capture import _begin, is_finished, make_body, make_capture, why_stale
from synth.rendering import render_views, studio_of
from synth.scene import Rig
from synth.truth import pixels as truth
from synth.views import splits, wanted_views


@pytest.fixture(scope="module")
def capture(small_capture: Path) -> Capture:
    return load_capture(small_capture)


def test_the_capture_is_whole(capture: Capture):
    assert verify_capture(capture.folder) == []
    pairs = {pair for split in capture.splits.values() for pair in split.views}
    assert len(pairs) == 3 * 3 + 1 * 1 + 1 * 2
    assert {(path.parent.name, int(path.stem)) for path in (capture.folder / "frames").rglob("*.png")} == pairs
    train, view, pose = (capture.splits[name] for name in ("train", "novel_view", "novel_pose"))
    assert not set(train.cameras) & set(view.cameras) and set(view.frames) <= set(train.frames)
    assert not set(pose.frames) & set(train.frames) and pose.cameras == view.cameras
    assert 5 < capture.manifest.pose_novelty_deg < 90


def test_every_pixel_knows_what_it_sees(capture: Capture):
    """The point that a pixel sees, projected by our own camera, lands in the middle of that pixel."""
    agreements = []  # of a mask by one ray per pixel with one by four, which differ along the outline alone
    for camera, frame in capture.splits["train"].views:
        pixels = truth.pixel_truth(capture, camera, frame)
        place, depth = capture.cameras[camera].project(truth.points(capture, pixels)[pixels.covered])
        rows, columns = np.nonzero(pixels.covered)
        assert np.abs(place - np.stack([columns + 0.5, rows + 0.5], axis=1)).max() < 0.02
        assert (depth > 0.5).all()
        alpha = capture.image(camera, frame)[..., 3]
        agreements.append((pixels.covered == (alpha > 127)).mean())
        assert (pixels.noise[alpha > 0] >= 0).all() and pixels.noise[alpha > 127].mean() < 0.02
    assert np.mean(agreements) > 0.99 and min(agreements) > 0.985


def test_visible_vertices_hit_depth_and_mask(capture: Capture):
    """A vertex is visible where the renderer's own ray towards it hits one of its own triangles.

    99.9 % of these rays hit within 0.5 pixels and 1 mm of the vertex, and the picture is covered there.
    """
    studio = studio_of(small_scene(), capture.folder, probe())
    missed, off_pixels, off_mm = [], [], []
    for camera, frame in capture.splits["train"].views[:4]:
        vertices, faces = read_surface_mesh_truth(capture, frame)
        view = capture.cameras[camera]
        studio.dress(vertices)
        point, triangle = studio.hits(view.position, vertices)
        visible = (faces[triangle] == np.arange(len(vertices))[:, None]).any(axis=1) & (triangle >= 0)
        assert visible.sum() > 1000
        pixels, _ = view.project(vertices[visible])
        off_pixels.append(np.linalg.norm(view.project(point[visible])[0] - pixels, axis=1))
        off_mm.append(1000 * np.linalg.norm(point - vertices, axis=1)[visible])
        alpha = np.pad(capture.image(camera, frame)[..., 3], 1)
        rows, columns = (np.floor(pixels[:, ::-1, None] + 1 + np.array([-0.5, 0, 0.5])).astype(int)).transpose(1, 0, 2)
        missed.append(~(alpha[rows[:, :, None], columns[:, None, :]] > 0).any(axis=(1, 2)))
    assert np.mean(np.concatenate(missed)) < 0.001
    assert np.mean(np.concatenate(off_pixels) > 0.5) < 0.001
    assert np.mean(np.concatenate(off_mm) > 1.0) < 0.001


def test_the_person_fills_the_frame(capture: Capture):
    views = [view for split in capture.splits.values() for view in split.views]
    for camera in capture.cameras:
        masks = np.stack([capture.image(*view)[..., 3] > 0 for view in views if view[0] == camera])
        assert not masks[:, [0, -1]].any() and not masks[:, :, [0, -1]].any()
        assert max(np.ptp(np.flatnonzero(rows)) + 1 for rows in masks.any(axis=2)) >= 0.75 * 64


def test_bytes_do_not_depend_on_order_or_sharding(tmp_path: Path, small_capture: Path):
    """Two shards that render the frames backwards, one image at a time, make the same images."""
    other = tmp_path / "other"
    shutil.copytree(small_capture, other)
    scene = small_scene()
    views = wanted_views(scene)
    for view in views:
        image_path(other, view.camera, view.frame).unlink()
        pixels_path(other, view.camera, view.frame).unlink()
    for shard in (views[1::2], views[0::2]):
        for view in reversed(shard):
            assert render_views(scene, other, probe(), [view]) == 1
    assert verify_capture(other) == []


def test_a_killed_capture_resumes_to_the_same_manifest(tmp_path: Path, small_capture: Path):
    program = (
        "from pathlib import Path; import sys\n"
        "from helpers.scenes import small_scene; from synth.capture import make_capture\n"
        "if __name__ == '__main__': make_capture(small_scene(), Path(sys.argv[1]))\n"
    )
    script, target = tmp_path / "make.py", tmp_path / "killed"
    script.write_text(program)
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))
    process = subprocess.Popen([sys.executable, str(script), str(target)], env=environment)
    wait_for(lambda: len(list(target.rglob("*.png"))) >= 4, 240)
    process.kill()
    process.wait()
    (target / ".half-written.png.x1").write_bytes(b"left by a kill")
    with pytest.raises(InputError, match="unfinished"):
        load_capture(target)
    make_capture(small_scene(), target, executor=InThisProcess())
    assert sha256_of(target / "manifest.json") == sha256_of(small_capture / "manifest.json")
    assert verify_capture(target) == []


def test_a_finished_capture_returns_at_once_and_shards_bring_back_what_is_lost(tmp_path: Path, small_capture: Path):
    """An image of the second shard and a scan of the first one: each makes its own share, and the last one finishes."""
    other, scene = shutil.copytree(small_capture, tmp_path / "other"), small_scene()
    told: list[tuple[int, int]] = []
    make_capture(scene, other, progress=lambda *now: told.append(now))
    assert told == []
    image_path(other, wanted_views(scene)[3].camera, 1).unlink()
    scan_path(other, 0).unlink()
    for shard, first, share in (((2, 2), 4, 5), ((1, 2), 4, 7)):
        told.clear()
        make_capture(scene, other, shard=shard, executor=InThisProcess(), progress=lambda *now: told.append(now))
        assert told[0] == (first, share) and told[-1] == (share, share)
        assert is_finished(scene, other) == (shard == (1, 2))
    assert sha256_of(other / "manifest.json") == sha256_of(small_capture / "manifest.json")


def test_what_other_code_made_is_made_again_and_the_reason_said(
    tmp_path: Path, small_capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    other = tmp_path / "other"
    shutil.copytree(small_capture, other)
    next(other.rglob("frames/*/*.png")).write_bytes(b"an image of other code")
    assert is_finished(small_scene(), other) and not why_stale(small_scene(), other)
    monkeypatch.setattr("synth.capture.code_version", lambda: "newer")
    assert not is_finished(small_scene(), other)
    told: list[tuple[int, int]] = []
    make_capture(small_scene(), other, executor=InThisProcess(), progress=lambda *now: told.append(now))
    assert told[0] == (0, 12) and told[-1] == (12, 12)
    assert "made by other code" in capsys.readouterr().err
    assert read_manifest(other).code == "newer" and verify_capture(other) == []
    assert read_manifest(other).files == read_manifest(small_capture).files


def test_the_code_that_counts_is_all_that_making_a_capture_imports():
    """No module that `synth.capture` imports, however far down, is left out of the hash."""
    root = Path(synth.source_hash.__file__).parents[1]
    found, waiting = set(), {root / "synth" / "capture.py"}
    while waiting:
        path = waiting.pop()
        found.add(path)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("synth", "ash"):
                folder = root.joinpath(*node.module.split("."))
                named = {folder.with_suffix(".py"), *(folder / f"{alias.name}.py" for alias in node.names)}
                waiting |= {part for part in named if part.is_file()} - found
    assert found <= set(synth.source_hash.maker_sources())


def test_wrong_folders_are_refused(tmp_path: Path, small_capture: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="other parameters"):
        make_capture(small_scene(seed=1), small_capture)
    (tmp_path / "letters.txt").write_text("mine")
    with pytest.raises(InputError, match="empty folder"):
        make_capture(small_scene(), tmp_path)
    (tmp_path / "file").write_text("a file")
    with pytest.raises(InputError, match="cannot be written"):
        make_capture(small_scene(), tmp_path / "file" / "below")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(cost.shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(InputError, match=r"needs \d+\.\d MB more and the disk has 0\.0 MB free"):
        make_capture(small_scene(), tmp_path / "full")


def test_names_and_sizes_are_checked():
    with pytest.raises(InputError, match=r"expected one of .*mannequin"):
        presets.scene("mannekin", size="ci")
    with pytest.raises(InputError, match="expected one of ci, factor, quick"):
        presets.scene("loose", size="huge")
    with pytest.raises(InputError, match="held out"):
        Rig(cameras=4, held_out=4)
    assert presets.scene("loose", size="quick") == presets.scene("loose", size="quick")
    assert presets.scene("loose", size="quick").identity != presets.scene("loose", size="quick", seed=1).identity


@pytest.mark.parametrize("name", ["ci", "quick"])
def test_the_estimate_counts_what_is_made(name: str):
    scene = presets.scene("mannequin", size=name)
    assert cost.estimate(scene).images == len(wanted_views(scene))
    assert len(splits(scene)["novel_view"].views) > 0
    assert cost.VERTICES["mannequin"] == len(make_body(scene).surface.vertices)


def test_a_capture_of_the_papers_size_says_what_it_needs():
    needed = cost.estimate(presets.scene("loose", size="paper"))
    assert 48 * 27_000 * 7_000 < needed.memory < 32e9
    assert needed.text.endswith(f"{needed.bytes / 1e9:.2f} GB on disk, {needed.memory / 1e9:.1f} GB of memory")


def test_a_library_that_aborts_the_process_is_never_chosen(monkeypatch: pytest.MonkeyPatch):
    assert [
        llvm_version(name) for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-14.0.6.so.1", "libfoo.so")
    ] == [15, 19, 14, 0]
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/usr/lib/libLLVM-15.so.1")
    assert all(llvm_version(path) >= render.OLDEST_LLVM for path in find_libllvm())


def test_a_probe_that_is_killed_is_tried_again_and_is_no_missing_library(monkeypatch):
    killed, real, calls = SimpleNamespace(returncode=-9, stdout=b""), render.subprocess.run, []

    def run(*arguments, **options):
        calls.append(arguments)
        return killed if len(calls) == 1 else real(*arguments, **options)

    monkeypatch.setattr(render.subprocess, "run", run)
    assert render._try("scalar_rgb", "")
    assert len(calls) == 2
    monkeypatch.setattr(render.subprocess, "run", lambda *_, **__: killed)
    with pytest.raises(InputError, match="killed from outside, or stopped, 2 times"):
        render._try("scalar_rgb", "")


def test_a_capture_begun_with_another_variant_is_not_gone_on_with(tmp_path):
    scene = small_scene()
    known = probe()
    _begin(scene, tmp_path, known, alone=True)
    _begin(scene, tmp_path, known, alone=True)
    other = replace(known, variant="scalar_rgb" if known.libllvm else "llvm_ad_rgb")
    with pytest.raises(InputError, match=f"was begun with {known.variant}, this machine has"):
        _begin(scene, tmp_path, other, alone=True)
