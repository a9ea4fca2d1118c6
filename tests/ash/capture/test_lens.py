import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.executing import InThisProcess
from helpers.scenes import small_scene
from helpers.squares import camera, squares, studio

from ash.capture.dataset import Capture, image_path
from ash.capture.formats import load_capture, read_cameras, write_cameras
from ash.capture.lens import distort, undistort
from ash.capture.manifest import verify_capture
from ash.files import InputError
from synth.camera.rig import make_cameras, rig_from_file
from synth.camera.sensing import make_sensor, window_of
from synth.capture import make_capture
from synth.export.formats import export
from synth.export.undistorted import undistort as undistort_capture
from synth.scene import Rig
from synth.truth import pixels as truth

LENSES = {
    "barrel": (-0.28, 0.07, 0.0, 0.0),
    "pincushion": (0.2, 0.03, 0.0, 0.0),
    "decentred": (-0.1, 0.01, 0.02, -0.015),
}
GRID = np.stack(np.meshgrid(np.linspace(-1.1, 1.1, 5), np.linspace(-1.0, 1.0, 5)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistortion_inverts_distortion(lens: tuple[float, ...]):
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, size=(200, 2))
    np.testing.assert_allclose(undistort(distort(rays, np.array(lens)), np.array(lens)), rays, atol=1e-12)


def test_the_formula_is_opencvs():
    """Worked by hand for x = 0.3, y = -0.2: r^2 = 0.13, radial 1 + 0.1 * 0.13 + 0.2 * 0.0169."""
    radial = 1 + 0.013 + 0.00338
    x = 0.3 * radial + 2 * 0.01 * 0.3 * -0.2 + 0.02 * (0.13 + 0.18)
    y = -0.2 * radial + 0.01 * (0.13 + 0.08) + 2 * 0.02 * 0.3 * -0.2
    found = distort(np.array([0.3, -0.2]), np.array([0.1, 0.2, 0.01, 0.02]))
    np.testing.assert_allclose(found, [x, y], atol=1e-15)


def test_a_lens_that_folds_the_picture_is_refused(tmp_path: Path):
    folding = camera(96, 96, fx=80.0, fy=80.0, distortion=(-1.5, 0, 0, 0))
    with pytest.raises(ValueError, match="folds"):
        undistort(np.array([[0.9, 0.0]]), folding.distortion)
    write_cameras(tmp_path / "cameras.json", [folding])
    with pytest.raises(InputError, match="camera lens: the lens folds"):
        read_cameras(tmp_path / "cameras.json")


def test_a_pinhole_is_written_as_before_and_a_lens_read_back(tmp_path: Path):
    bent = camera(96, 64, fx=80.0, fy=70.0, distortion=LENSES["decentred"])
    write_cameras(tmp_path / "cameras.json", [replace(bent, name="pinhole", distortion=np.zeros(4)), bent])
    rows = json.loads((tmp_path / "cameras.json").read_text())["cameras"]
    assert set(rows[0]) == {"name", "width", "height", "K", "viewmat"}
    np.testing.assert_array_equal(read_cameras(tmp_path / "cameras.json")["lens"].distortion, bent.distortion)


@pytest.mark.parametrize("shape", ["square", "skewed", *LENSES])
def test_known_points_land_on_their_pixels(shape: str):
    """The centre of gravity of each small square's picture is where the camera says, within 0.05 pixels."""
    plain = camera(192, 176, fx=190.0, fy=190.0)
    view = camera(192, 176, fx=170.0, fy=150.0, skew=11.0) if shape == "skewed" else plain
    view = replace(view, distortion=np.array(LENSES.get(shape, (0, 0, 0, 0)), dtype=np.float64))
    centres = np.concatenate([GRID, np.zeros((len(GRID), 1))], axis=1)
    pose = squares(centres, 0.04)
    picture = studio(len(GRID)).render(pose, [view], samples=128, seeds=[1])[0]
    alpha = picture.rgba[..., 3] / 255
    expected, depth = view.project(centres)
    straight, _ = plain.project(centres)
    rows, columns = np.indices(alpha.shape)
    for target in expected:
        near = (np.abs(columns + 0.5 - target[0]) < 6) & (np.abs(rows + 0.5 - target[1]) < 6)
        weight = alpha * near
        found = np.array([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()]) / weight.sum()
        assert np.linalg.norm(found - target) < 0.05
    if shape != "square":
        assert np.linalg.norm(expected - straight, axis=1).max() > 2  # A straight pinhole would be far off.
    hit = picture.triangle >= 0
    weights = np.concatenate([1 - picture.barycentric.sum(-1, keepdims=True), picture.barycentric], axis=-1)[hit]
    faces = studio(len(GRID)).surface.faces
    points = np.einsum("nk,nka->na", weights, pose[faces[picture.triangle[hit]]])
    where = np.stack([columns[hit] + 0.5, rows[hit] + 0.5], axis=1)
    assert np.abs(view.project(points)[0] - where).max() < 0.005 and depth.min() > 2.5


def test_without_llvm_such_lenses_are_refused():
    bent = camera(96, 96, fx=80.0, fy=80.0, distortion=LENSES["barrel"])
    window = window_of(bent, np.zeros((1, 3)))
    with pytest.raises(InputError, match="LLVM"):
        make_sensor(None, bent, window, vectorised=False)


def test_a_camera_that_sees_nobody_is_refused(tmp_path: Path):
    write_cameras(tmp_path / "rig.json", [replace(camera(96, 96, fx=80.0, fy=80.0), name=name) for name in "ab"])
    rig = rig_from_file(tmp_path / "rig.json")
    person = np.random.default_rng(0).uniform(-0.5, 0.5, size=(50, 3))
    assert len(make_cameras(rig, person)) == 2
    for shift in ([0.0, 0, 5.0], [0.0, 0, 2.9], [30.0, 0, 0]):
        with pytest.raises(InputError, match="camera a: expected the person in front of it"):
            make_cameras(rig, person + shift)


def test_a_distorted_capture_is_exact_and_undistorted_it_is_that_of_pinholes(tmp_path: Path):
    """Against a render by pinholes of the same K: equal masks and truth, images equal up to noise and resampling."""
    rig = Rig(cameras=3, held_out=1, width=96, height=96, pixel_aspect=1.2, distortion=(-0.9, 0.5, 0.01, 0.0))
    scene = replace(small_scene(), rig=rig, samples=12, train=small_scene().test, novel_view_stride=2)
    bent = make_capture(scene, tmp_path / "bent", executor=InThisProcess())
    capture = load_capture(bent)
    assert verify_capture(bent) == []
    with pytest.raises(InputError, match="ash-bench export --format undistorted"):
        capture.training_only()
    _require_exact_truth(bent)
    for camera_ in capture.cameras.values():
        assert camera_.K[1, 1] == pytest.approx(1.2 * camera_.K[0, 0])
    with pytest.raises(InputError, match="undistorted"):
        export(capture, tmp_path / "official", form="ash")
    text = (export(capture, tmp_path / "colmap", form="colmap") / "sparse/0/cameras.txt").read_text()
    assert " OPENCV 96 96 " in text and text.split()[-1] == "0.0"
    export(capture, tmp_path / "studio", form="nerfstudio")
    row = json.loads((tmp_path / "studio" / "frame_000000" / "transforms.json").read_text())["frames"][0]
    assert [row[key] for key in ("k1", "k2", "p1", "p2")] == [-0.9, 0.5, 0.01, 0.0]
    folder = undistort_capture(bent, tmp_path / "straight")
    assert verify_capture(folder) == []
    straight = load_capture(folder)
    straight.training_only()
    _require_exact_truth(folder)
    assert all(view.is_pinhole for view in straight.cameras.values())
    by_pinholes = replace(scene, rig=_rig_of(straight, tmp_path))
    _require_alike(bent, folder, make_capture(by_pinholes, tmp_path / "pinhole", executor=InThisProcess()))
    with pytest.raises(InputError, match="empty folder"):
        undistort_capture(bent, folder)


def _rig_of(capture: Capture, folder: Path) -> Rig:
    write_cameras(folder / "rig.json", list(capture.cameras.values()))
    return rig_from_file(folder / "rig.json", held_out=1)


def _require_exact_truth(folder: Path) -> None:
    capture = load_capture(folder)
    for name, frame in capture.splits["train"].views:
        pixels = truth.pixel_truth(capture, name, frame)
        rows, columns = np.nonzero(pixels.covered)
        found, _ = capture.cameras[name].project(truth.points(capture, pixels)[pixels.covered])
        assert np.abs(found - np.stack([columns + 0.5, rows + 0.5], axis=1)).max() < 0.02
        assert ((capture.image(name, frame)[..., 3] > 127) == pixels.covered).mean() > 0.985


def _require_alike(bent: Path, straight: Path, pinhole: Path) -> None:
    capture, undistorted = load_capture(pinhole), load_capture(straight)
    error, count = 0.0, 0
    for path in sorted(pinhole.rglob("frames/*/*.png")):
        name, frame = path.parent.name, int(path.stem)
        direct, resampled = capture.image(name, frame) / 255.0, undistorted.image(name, frame) / 255.0
        both = (direct[..., 3] == 1) & (resampled[..., 3] == 1)
        error += float(((direct - resampled)[both][:, :3] ** 2).mean(axis=1).sum())
        count += int(both.sum())
        assert np.abs(direct[..., 3] - resampled[..., 3]).mean() < 0.01
        assert image_path(bent, name, frame).read_bytes() != path.read_bytes()
    assert -10 * np.log10(error / count) > 20
