"""Footage becomes a capture without truth, or is refused with a line for each thing that does not fit."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes
from helpers.commands import refused
from PIL import Image

from ash.capture.dataset import Camera, Capture
from ash.capture.formats import load_capture, read_cameras, write_cameras
from ash.capture.manifest import verify_capture
from benchmarks import cli
from benchmarks.cell.schema import CellResult, read_result
from benchmarks.importing.cameras import read_any_cameras
from benchmarks.importing.overlap import silhouette, template_overlaps
from benchmarks.suites.files import given_captures
from benchmarks.suites.runs import read_run
from synth.export.formats import export

pytestmark = pytest.mark.usefixtures("installed_fakes")

METHOD = "fake_good"
TEST = ("--test-cameras", "cam3,cam4")


@pytest.fixture
def footage(capture: Path, tmp_path: Path) -> Path:
    """What a lab would have of the boxes: no truth, masks apart from images, names of its own."""
    folder = tmp_path / "footage"
    for name in ("cameras.json", "skeleton.json", "motion.npz", "template.npz"):
        folder.mkdir(exist_ok=True)
        shutil.copy(capture / name, folder / name)
    for path in (capture / "frames").rglob("*.png"):
        rgba, name = np.array(Image.open(path)), f"image_c_{path.parent.name}_f_{int(path.stem)}.png"
        for what, pixels in (("images", rgba[..., :3]), ("masks", rgba[..., 3])):
            (folder / what / path.parent.name).mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(folder / what / path.parent.name / name)
    return folder


def picture(folder: Path, what: str, camera: str, frame: int) -> Path:
    return folder / what / camera / f"image_c_{camera}_f_{frame}.png"


def trained(capture: Path, out: Path) -> CellResult:
    """The result of a method that needs no training."""
    assert cli.main(["train", METHOD, str(capture), "--preset", "ci", "--out", str(out)]) == cli.DONE
    (cell,) = (out / "cells").iterdir()
    result = read_result(cell)
    assert result is not None
    return result


def test_the_whole_chain_gives_the_scores_of_the_capture_and_none_that_needs_truth(
    footage: Path, capture: Path, made_once: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "imported"
    assert cli.main(["import", str(footage), "--out", str(out), *TEST]) == cli.DONE
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()[1:7]] == [*(f"cam{k}" for k in range(5)), "mean"]
    assert "train: 3 cameras, 4 frames, 12 images" in printed and not (out / "truth").exists()
    made, original = load_capture(out), load_capture(capture)
    assert made.splits == original.splits and verify_capture(out) == []
    result = trained(out, tmp_path / "run")
    before = next(
        r for cell in read_run(made_once).cells if (r := read_result(cell.folder)) and r.config.method == METHOD
    )
    needs_truth = {"template_mm", "surface_mm", "noise_ceiling"}
    assert needs_truth < {row.metric for row in before.summary}
    assert not needs_truth & {row.metric for row in result.summary}
    for view, same in zip(result.views, before.views, strict=True):
        scores = {name: value for name, value in same.scores.items() if name[1] not in needs_truth}
        assert view.scores == pytest.approx(scores, rel=1e-6)
    shutil.copytree(tmp_path / "run" / "cells" / result.config.key / "images", tmp_path / "mine" / "images")
    (tmp_path / "mine" / "info.json").write_text('{"alpha": "premultiplied"}')
    score = ["score", str(tmp_path / "mine"), str(out), "--name", "mine", "--out", str(tmp_path / "run")]
    assert cli.main(score) == cli.DONE
    capsys.readouterr()
    assert cli.main(["report", str(tmp_path / "run")]) == cli.DONE
    assert "failed" not in capsys.readouterr().out
    report = (tmp_path / "run" / "report.md").read_text()
    assert "n/a" in report and "imported" in report
    assert "oracle is shown the truth" in refused(capsys, "train", "ash_truth", str(out))


def test_people_who_were_imported_are_people_of_one_scene(footage: Path, tmp_path: Path) -> None:
    outs = [tmp_path / name for name in ("a", "b")]
    for subject, out in enumerate(outs):
        imported = ["import", str(footage), "--out", str(out), "--name", "studio", "--subject", str(subject), *TEST]
        assert cli.main(imported) == cli.DONE
    assert [(row.name, row.subject) for row in given_captures(outs)] == [("studio", 0), ("studio", 1)]


def test_cameras_of_four_formats_are_the_same(capture: Path, tmp_path: Path) -> None:
    loaded = load_capture(capture)
    export(loaded, tmp_path / "nerf", form="nerfstudio", frame=0)
    export(loaded, tmp_path / "colmap", form="colmap")
    splatting = [
        {"id": k, "img_name": camera.name, "width": camera.width, "height": camera.height}
        | {"position": camera.position.tolist(), "rotation": camera.viewmat[:3, :3].T.tolist()}
        | {"fx": camera.K[0, 0], "fy": camera.K[1, 1]}
        for k, camera in enumerate(loaded.cameras.values())
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(splatting))
    paths = ("nerf/frame_000000/transforms.json", "colmap/sparse/0/cameras.txt", "cameras.json")
    for path in (capture / "cameras.json", *(tmp_path / path for path in paths)):
        read = read_any_cameras(path)
        assert set(read) >= {"cam0", "cam1", "cam2"}
        for name, camera in read.items():
            assert np.allclose(camera.K, loaded.cameras[name].K, atol=1e-12)
            assert np.allclose(camera.viewmat, loaded.cameras[name].viewmat, atol=1e-12)
            assert (camera.width, camera.height) == (fakes.SIZE, fakes.SIZE) and camera.is_pinhole


def test_the_lenses_of_colmap(tmp_path: Path) -> None:
    lenses = {"SIMPLE_RADIAL": "50 32 31 0.1", "OPENCV": "50 51 32 31 0.1 0.01 0.001 0.002", "RADIAL": "50 32 31 .1 .2"}
    text = "\n".join(f"{k} {model} 64 62 {lens}" for k, (model, lens) in enumerate(lenses.items()))
    (tmp_path / "cameras.txt").write_text(text)
    pose = "1 0 0 0 0 0 3"
    (tmp_path / "images.txt").write_text("# a comment\n" + "".join(f"9 {pose} {k} in/c{k}.png\n\n" for k in range(3)))
    cameras = list(read_any_cameras(tmp_path / "cameras.txt").values())
    assert [camera.distortion.tolist() for camera in cameras] == [
        [0.1, 0, 0, 0],
        [0.1, 0.01, 0.001, 0.002],
        [0.1, 0.2, 0, 0],
    ]
    assert cameras[1].K.tolist() == [[50, 0, 32], [0, 51, 31], [0, 0, 1]] and cameras[0].position.tolist() == [0, 0, -3]


def test_a_silhouette_is_where_the_mesh_is() -> None:
    """A square of 8 pixels, its middle 2 pixels right and 1 down of that of the picture."""
    K, viewmat = np.array([[64, 0, 16.0], [0, 64, 16], [0, 0, 1]]), np.eye(4)
    viewmat[2, 3] = 8
    square = np.array([[-0.25, -0.375, 0], [0.75, -0.375, 0], [0.75, 0.625, 0], [-0.25, 0.625, 0]])
    camera = Camera(name="a", width=32, height=32, K=K, viewmat=viewmat)
    expected = np.zeros((32, 32), dtype=bool)
    expected[13:21, 14:22] = True
    assert (silhouette(square, np.array([[0, 1, 2], [0, 2, 3]]), camera) == expected).all()


def test_a_calibration_that_is_off_shows_in_the_overlap(capture: Path) -> None:
    loaded = load_capture(capture)
    right = template_overlaps(loaded)
    assert min(row.iou for row in right) > 0.8 and max(map(abs, right[0].offset_px)) < 0.7
    K = loaded.cameras["cam0"].K + np.array([[0, 0, -3.0], [0, 0, -2], [0, 0, 0]])
    off = replace(loaded, cameras=loaded.cameras | {"cam0": replace(loaded.cameras["cam0"], K=K)})
    wrong = template_overlaps(off)
    moved = np.subtract(wrong[0].offset_px, right[0].offset_px)
    assert np.allclose(moved, (3, 2), atol=0.05) and wrong[0].iou < right[0].iou - 0.1 and wrong[1:] == right[1:]


def test_a_lens_that_distorts_is_undone_by_export(footage: Path, tmp_path: Path) -> None:
    cameras = [replace(c, distortion=np.array([0.2, 0, 0, 0])) for c in fakes.cameras()]
    write_cameras(footage / "cameras.json", cameras)
    for camera in cameras:
        for path in (footage / "images" / camera.name).iterdir():
            frame = int(path.stem.rpartition("_")[2])
            rgba = np.rint(255 * fakes.draw(fakes.posed(fakes.motion().dofs[frame]), camera)).astype(np.uint8)
            Image.fromarray(rgba).save(path)
    shutil.rmtree(footage / "masks")
    assert cli.main(["import", str(footage), "--out", str(tmp_path / "bent"), *TEST]) == cli.DONE
    command = ["export", str(tmp_path / "bent"), "--format", "undistorted", "--out", str(tmp_path / "straight")]
    assert cli.main(command) == cli.DONE
    straight = load_capture(tmp_path / "straight")
    straight.training_only()
    assert verify_capture(straight.folder) == []
    bent: Capture = load_capture(tmp_path / "bent")
    for before, after in zip(template_overlaps(bent), template_overlaps(straight), strict=True):
        assert after.iou > before.iou - 0.05 > 0.75


def _change(name: str, key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        with np.load(folder / name) as arrays:
            content = dict(arrays)
        np.savez(folder / name, **(content | {key: change(content[key])}))

    return spoil


def _cameras(change: Callable[[Camera], Camera]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        write_cameras(folder / "cameras.json", [change(c) for c in read_cameras(folder / "cameras.json").values()])

    return spoil


def _redraw(what: str, draw: Callable[[Image.Image], Image.Image]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        path = picture(folder, what, "cam1", 2)
        draw(Image.open(path)).save(path)

    return spoil


def _far(camera: Camera) -> Camera:
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] *= 1000
    return replace(camera, viewmat=viewmat)


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "centimetres": (_change("template.npz", "vertices", lambda v: 100 * v), "metres, 0.5 to 2.6; is it centimetres?"),
    "millimetres": (_cameras(_far), "distance to the person is .* is it millimetres?"),
    "root in cm": (_change("motion.npz", "dofs", lambda d: d + 1e2 * np.eye(len(d), 12)), "root moves over 100 units"),
    "missing": (lambda f: picture(f, "images", "cam1", 2).unlink(), "cam1: 1 of 4 frames are missing, the first is 2"),
    "no mask": (lambda f: picture(f, "masks", "cam4", 6).unlink(), "masks/cam4: 1 of 7 frames are missing"),
    "size": (_redraw("images", lambda p: p.resize((32, 64))), "32x64 pixels, expected 64x64"),
    "empty": (_redraw("masks", lambda p: p.point(lambda v: v // 255)), "mask is empty: its values go to 1"),
    "full": (_redraw("masks", lambda p: p.point(lambda v: 255)), "covers the whole picture"),
    "depth": (_redraw("masks", lambda p: p.convert("RGBA")), "mode RGBA, expected one in grey"),
    "damaged": (lambda f: picture(f, "images", "cam1", 2).write_bytes(b"\x89PNG"), "expected a PNG or JPEG picture"),
    "no alpha": (lambda f: shutil.rmtree(f / "masks"), "mode RGB, expected one with alpha"),
    "names": (lambda f: (f / "images/cam1").rename(f / "images/left"), "no camera is called so, expected cam0, cam1"),
    "twice": (lambda f: shutil.copy(picture(f, "images", "cam1", 2), f / "images/cam1/2.png"), "frame 2 is also"),
    "stray": (lambda f: (f / "images/cam1/notes.txt").touch(), "name ends with the frame's number"),
    "swapped": (_cameras(lambda c: replace(c, name=f"cam{4 - int(c.name[3])}")), "overlap by 0.* expected 0.9"),
    "late": (lambda f: picture(f, "images", "cam1", 2).rename(f / "images/cam1/99.png"), "frame 99, and motion.npz"),
    "two rigs": (lambda f: (f / "transforms.json").touch(), "got cameras.json and transforms.json; --cameras"),
    "no skeleton": (lambda f: (f / "skeleton.json").unlink(), "skeleton.json: cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_does_not_fit_is_named(case: str, footage: Path, tmp_path: Path, capsys) -> None:
    spoil, message = BAD[case]
    spoil(footage)
    extra = ["--least-iou", "0.95"] if case == "swapped" else []
    assert cli.main(["import", str(footage), "--out", str(tmp_path / "out"), *TEST, *extra]) == cli.WRONG_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert lines and all(line.startswith("ash-bench: ") for line in lines)
    assert [line for line in lines if re.search(message, line)], lines
    assert {path.name for path in tmp_path.iterdir()} <= {"footage", "plugins"}


def test_what_is_held_out_can_be_chosen(footage: Path, tmp_path: Path, capsys) -> None:
    def command(*more: str) -> list[str]:
        return ["import", str(footage), "--out", str(tmp_path / "out"), *more]

    assert "expected some of cam0" in refused(capsys, *command("--test-cameras", "cam9"))
    assert "lies before training frame" in refused(capsys, *command("--test-frames", "1:3"))
    assert "expected A:B" in refused(capsys, *command("--test-frames", "1"))
    for path in [*footage.rglob("*_4.png"), *footage.rglob("*_5.png"), *footage.rglob("*_6.png")]:
        path.unlink()
    assert cli.main(command("--test-frames", "3:4", "--name", "hall")) == cli.DONE
    made = load_capture(tmp_path / "out")
    assert made.scene == "hall" and made.splits["novel_pose"].frames == (3,)
    assert made.splits["novel_view"].cameras == ("cam2",) and made.splits["train"].frames == (0, 1, 2)
    assert "expected an empty folder" in refused(capsys, *command())
