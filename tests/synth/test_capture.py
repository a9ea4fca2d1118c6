import ast
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.executing import InThisProcess
from helpers.scenes import small_scene

import synth.source_hash
from ash.capture.dataset import Capture, image_path, pixels_path, scan_path
from ash.capture.formats import load_capture, read_surface_mesh_truth, read_template_truth
from ash.capture.manifest import read_manifest, verify_capture
from ash.files import InputError, read_arrays, sha256_of
from synth import cost, presets
from synth.camera import render
from synth.camera.render import find_libllvm, llvm_version, probe
from synth.capture import _begin, is_finished, make_body, make_capture, why_stale
from synth.posing import dual_quaternion_skinning, skinning_transforms
from synth.rendering import render_views, studio_of
from synth.scene import Clip, Outfit, Rig
from synth.views import splits, wanted_views


@pytest.fixture(scope="module")
def folder(small_capture: Path) -> Path:
    return small_capture


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    return load_capture(folder)


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
    """Triangle and barycentrics, projected by our own camera, land in the middle of their pixel."""
    agreements = []  # of a mask by one ray per pixel with one by four, which differ along the outline alone
    for camera, frame in capture.splits["train"].views:
        vertices, faces = read_surface_mesh_truth(capture, frame)
        truth = read_arrays(pixels_path(capture.folder, camera, frame), expected=("triangle", "barycentric", "noise"))
        seen = truth["triangle"] >= 0
        rest = truth["barycentric"][seen].astype(np.float64)
        weights = np.concatenate([1 - rest.sum(axis=1, keepdims=True), rest], axis=1)
        points = np.einsum("nk,nka->na", weights, vertices[faces[truth["triangle"][seen]]])
        pixels, depth = capture.cameras[camera].project(points)
        rows, columns = np.nonzero(seen)
        assert np.abs(pixels - np.stack([columns + 0.5, rows + 0.5], axis=1)).max() < 0.02
        assert (depth > 0.5).all()
        alpha = capture.image(camera, frame)[..., 3]
        agreements.append((seen == (alpha > 127)).mean())
        assert (truth["noise"][alpha > 0] >= 0).all() and truth["noise"][alpha > 127].mean() < 0.02
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
    for camera in capture.cameras:
        heights = []
        for split in capture.splits.values():
            for name, frame in split.views:
                if name == camera:
                    alpha = capture.image(name, frame)[..., 3]
                    assert not alpha[[0, -1]].any() and not alpha[:, [0, -1]].any()
                    heights.append(np.flatnonzero(alpha.any(axis=1)))
        assert max(np.ptp(rows) + 1 for rows in heights) >= 0.75 * 64


def test_skinned_template_is_wrong_only_by_what_the_scene_adds(tmp_path: Path, capture: Capture):
    def error(outfit: Outfit) -> np.ndarray:
        from synth.cloth import surface
        from synth.motion.clips import make_motion
        from synth.person.mannequin import mannequin

        body = mannequin(skirt=outfit.skirt)
        motion = make_motion(body.skeleton, (Clip(generator="walk", frames=3),), fps=12.0, seed=0)
        truth = surface.true_surface(body, motion, outfit, seed=1)[:, body.template_to_surface]
        template = body.template()
        transforms = skinning_transforms(body.skeleton, motion.dofs)
        skinned = [dual_quaternion_skinning(template.vertices, template.skin_weights, frame) for frame in transforms]
        return np.linalg.norm(np.stack(skinned) - truth, axis=-1)

    assert error(Outfit(skirt=True)).max() < 1e-12
    folds = error(Outfit(skirt=True, folds_mm=5.0))
    assert 0.001 < np.sqrt(np.mean(folds**2)) < 0.005 and folds.max() < 0.03
    assert error(Outfit(skirt=True, swing=1.0)).max() > 0.02
    truth = read_template_truth(capture)
    assert truth.shape == (5, len(capture.template.vertices), 3)


def test_bytes_do_not_depend_on_order_or_sharding(tmp_path: Path, folder: Path):
    """Two shards that render the frames backwards, one image at a time, make the same images."""
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    scene = small_scene()
    views = wanted_views(scene)
    for view in views:
        image_path(other, view.camera, view.frame).unlink()
        pixels_path(other, view.camera, view.frame).unlink()
    for shard in (views[1::2], views[0::2]):
        for view in reversed(shard):
            assert render_views(scene, other, probe(), [view]) == 1
    assert verify_capture(other) == []


@pytest.mark.parametrize("kills", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_a_killed_capture_resumes_to_the_same_manifest(kills: int, tmp_path: Path, folder: Path):
    program = (
        "from pathlib import Path; import sys\n"
        "from helpers.scenes import small_scene; from synth.capture import make_capture\n"
        "if __name__ == '__main__': make_capture(small_scene(), Path(sys.argv[1]))\n"
    )
    script = tmp_path / "make.py"
    script.write_text(program)
    target = tmp_path / "killed"
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))
    rng = random.Random(kills)
    for kill in range(kills):
        process = subprocess.Popen([sys.executable, str(script), str(target)], env=environment)
        deadline = time.monotonic() + 240
        there = len(list(target.rglob("*.png")))
        while len(list(target.rglob("*.png"))) < min(there + (1 if kill else 4), 12) and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.3) if kill else 0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        if kill:  # Something to do again for the next one.
            for path in sorted(target.rglob("frames/*/*.png"))[:3]:
                path.unlink()
    (target / ".half-written.png.x1").write_bytes(b"left by a kill")
    if kills == 1:
        with pytest.raises(InputError, match="unfinished"):
            load_capture(target)
    make_capture(small_scene(), target)
    assert sha256_of(target / "manifest.json") == sha256_of(folder / "manifest.json")
    assert verify_capture(target) == []


def test_a_finished_capture_returns_at_once_and_shards_bring_back_what_is_lost(tmp_path: Path, folder: Path):
    """An image of the second shard and a scan of the first one: each makes its own share, and the last one finishes."""
    other, scene = shutil.copytree(folder, tmp_path / "other"), small_scene()
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
    assert sha256_of(other / "manifest.json") == sha256_of(folder / "manifest.json")


def test_what_other_code_made_is_made_again_and_the_reason_said(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    next(other.rglob("frames/*/*.png")).write_bytes(b"an image of other code")
    assert is_finished(small_scene(), other) and not why_stale(small_scene(), other)
    monkeypatch.setattr("synth.capture.code_version", lambda: "newer")
    assert not is_finished(small_scene(), other)
    told: list[tuple[int, int]] = []
    make_capture(small_scene(), other, progress=lambda done, total: told.append((done, total)))
    assert told[0] == (0, 12) and told[-1] == (12, 12)
    assert "made by other code" in capsys.readouterr().err
    assert read_manifest(other).code == "newer" and verify_capture(other) == []
    assert read_manifest(other).files == read_manifest(folder).files


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
    assert not any(path.is_relative_to(root / "synth" / "readers") for path in found)


def test_wrong_folders_are_refused(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="other parameters"):
        make_capture(small_scene(seed=1), folder)
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


class Killed:
    """What `subprocess.run` gives back of a probe that somebody killed."""

    returncode, stdout = -9, b""


def test_a_probe_that_is_killed_is_tried_again_and_is_no_missing_library(monkeypatch):
    real, calls = render.subprocess.run, []

    def run(*arguments, **options):
        calls.append(arguments)
        return Killed() if len(calls) == 1 else real(*arguments, **options)

    monkeypatch.setattr(render.subprocess, "run", run)
    assert render._try("scalar_rgb", "")
    assert len(calls) == 2
    monkeypatch.setattr(render.subprocess, "run", lambda *_, **__: Killed())
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
