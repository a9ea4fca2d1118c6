import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ash.capture.dataset import Camera, Capture, background_path, farthest_points, image_path, pixels_path
from ash.capture.formats import load_capture
from ash.capture.manifest import verify_capture
from ash.files import InputError, read_image, write_arrays
from synth.camera.rig import held_out, make_cameras
from synth.person.body import PARTS
from synth.perturbation.perturb import Perturbation, miscalibrate, mistrack, perturb, through_lens
from synth.scene import RIGS, Rig
from synth.truth import pixels as truth


@pytest.fixture(scope="module")
def capture(small_capture: Path) -> Capture:
    return load_capture(small_capture)


@pytest.fixture(scope="module")
def view(capture: Capture) -> truth.PixelTruth:
    return truth.pixel_truth(capture, capture.splits["train"].cameras[0], 0)


def test_depth_and_normals_agree_with_the_geometry(capture: Capture, view: truth.PixelTruth):
    camera = capture.cameras[view.camera]
    seen = view.covered
    points, depth, normals = truth.points(capture, view), truth.depth(capture, view), truth.normals(capture, view)
    np.testing.assert_allclose(depth[seen], camera.project(points[seen])[1], rtol=1e-12)
    assert not depth[~seen].any()
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=-1), 1.0, atol=1e-9)
    towards = np.sum(normals[seen] * (camera.position - points[seen]), axis=-1)
    assert (towards > 0).mean() > 0.97  # The inside of the skirt's hem may be seen.


def test_uv_albedo_and_parts_describe_the_same_spot(capture: Capture, view: truth.PixelTruth):
    uvs, parts, albedo = truth.uvs(capture, view), truth.parts(capture, view), truth.albedo(capture, view)
    seen = view.covered
    assert ((uvs[seen] > 0) & (uvs[seen] < 1)).all()
    assert set(np.unique(parts[seen])) <= set(range(len(PARTS))) and (parts[~seen] == -1).all()
    picture = capture.image(view.camera, view.frame)[..., :3] / 255
    skin = parts == PARTS.index("skin")
    assert skin.sum() > 10
    assert (albedo[skin] @ [1, 0, -1]).mean() > 0.1  # Skin is warmer than it is blue, in albedo and picture alike.
    solid = seen & (capture.image(view.camera, view.frame)[..., 3] == 255)
    grey = [channel[solid].mean(axis=-1) for channel in (albedo, picture)]
    assert np.corrcoef(*grey)[0, 1] > 0.6


def test_flow_leads_to_where_the_spot_is_in_the_next_frame(capture: Capture, view: truth.PixelTruth):
    flow = truth.flow(capture, view)
    seen = view.covered
    rows, columns = np.nonzero(seen)
    target = np.stack([columns + 0.5, rows + 0.5], axis=1) + flow[seen]
    pixels, _ = capture.cameras[view.camera].project(truth.points(capture, view, frame=1)[seen])
    assert np.abs(pixels - target).max() < 0.03
    assert np.abs(flow[seen]).max() > 0.5 and not flow[~seen].any()
    with pytest.raises(ValueError, match="last of its sequence"):
        truth.flow(capture, truth.pixel_truth(capture, view.camera, 2))


def test_damaged_truth_is_refused(capture: Capture, tmp_path: Path, view: truth.PixelTruth):
    other = tmp_path / "other"
    shutil.copytree(capture.folder, other)
    path = pixels_path(other, view.camera, 0)
    write_arrays(path, triangle=np.full((64, 64), 10**6), barycentric=np.zeros((64, 64, 2)), noise=np.zeros((64, 64)))
    with pytest.raises(InputError, match="triangle that the surface lacks"):
        truth.pixel_truth(load_capture(other), view.camera, 0)


def test_no_perturbation_changes_no_byte(capture: Capture, tmp_path: Path):
    same = load_capture(perturb(capture.folder, tmp_path / "same", Perturbation()))
    assert same.manifest.files == capture.manifest.files and same.splits == capture.splits
    assert verify_capture(same.folder) == []


def test_perturbations_touch_training_only_and_follow_their_seed(capture: Capture, tmp_path: Path):
    harsh = Perturbation(
        tracking_deg=5.0,
        tracking_mm=10.0,
        calibration_px=3.0,
        mask_px=2,
        exposure_stops=0.3,
        noise_factor=4.0,
        cameras=2,
        frames=2,
    )
    first, again = (load_capture(perturb(capture.folder, tmp_path / name, harsh, seed=1)) for name in ("a", "b"))
    assert first.identity == again.identity and verify_capture(first.folder) == []
    assert len(first.splits["train"].cameras) == 2 and len(first.splits["train"].frames) == 2
    for split in ("novel_view", "novel_pose"):
        assert first.splits[split] == capture.splits[split]
        for camera, frame in first.splits[split].views:
            np.testing.assert_array_equal(first.image(camera, frame), capture.image(camera, frame))
            np.testing.assert_array_equal(first.cameras[camera].viewmat, capture.cameras[camera].viewmat)
    camera, frame = first.splits["train"].views[0]
    assert np.abs(first.image(camera, frame).astype(int) - capture.image(camera, frame)).max() > 20
    assert (first.image(camera, frame)[..., 3] > 127).sum() > (capture.image(camera, frame)[..., 3] > 127).sum() + 50
    truths = {name: value for name, value in capture.manifest.files.items() if name.startswith("truth/")}
    assert {name: value for name, value in first.manifest.files.items() if name in truths}.items() <= truths.items()


def test_a_mask_that_is_too_large_shows_the_studio(capture: Capture, tmp_path: Path):
    perturbed = load_capture(perturb(capture.folder, tmp_path / "grown", Perturbation(mask_px=3)))
    camera, frame = capture.splits["train"].views[0]
    before, after = capture.image(camera, frame), perturbed.image(camera, frame)
    plate = read_image(background_path(capture.folder, camera), shape=before[..., :3].shape)
    ring = (before[..., 3] == 0) & (after[..., 3] == 255)
    assert ring.sum() > 50
    np.testing.assert_array_equal(after[ring, :3], plate[ring])
    inside = before[..., 3] == 255
    np.testing.assert_array_equal(after[inside], before[inside])
    (bare := tmp_path / "bare").mkdir()
    shutil.copytree(capture.folder, bare, dirs_exist_ok=True)
    shutil.rmtree(bare / "plates")
    with pytest.raises(InputError, match="masks that are too large show the studio"):
        perturb(bare, tmp_path / "again", Perturbation(mask_px=3))


def test_the_studio_is_textured_and_every_camera_sees_another_part_of_it(capture: Capture):
    plates = [
        read_image(background_path(capture.folder, name), shape=(camera.height, camera.width, 3)).astype(float)
        for name, camera in capture.cameras.items()
    ]
    assert all(plate.std() > 10 and 20 < plate.mean() < 200 for plate in plates)
    assert min(np.abs(a - b).mean() for i, a in enumerate(plates) for b in plates[:i]) > 5
    assert all(name in capture.manifest.files for name in (f"plates/{camera}.png" for camera in capture.cameras))


def test_severities_are_what_they_say(capture: Capture):
    wrong = mistrack(capture.motion, Perturbation(tracking_deg=4.0, tracking_mm=20.0), seed=0)
    error = (wrong.dofs - capture.motion.dofs)[:, 3:].reshape(len(wrong.dofs), -1, 3)
    assert abs(np.rad2deg(np.sqrt(np.mean(np.sum(error**2, axis=-1)))) - 4.0) < 0.1
    point = np.array([[0.1, 1.2, 0.0], [0.0, 0.6, 0.1]])
    shifts = []
    for camera in capture.cameras.values():
        for seed in range(40):
            shifts.append(miscalibrate(camera, 2.0, seed=seed).project(point)[0] - camera.project(point)[0])
    assert 1.2 < np.sqrt(np.mean(np.sum(np.concatenate(shifts) ** 2, axis=-1))) < 3.0


def test_a_lens_moves_training_images_by_the_cube_of_the_radius_and_nothing_else(capture: Capture, tmp_path: Path):
    K = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])
    camera = Camera(name="plain", width=160, height=120, K=K, viewmat=np.eye(4))
    image = np.zeros((120, 160, 4), np.uint8)
    image[60], image[30] = 255, 255  # A line through the centre, and one halfway to the border above it.
    column = through_lens(image, camera, 8.0)[:, 80, 3].astype(float)
    rows = np.arange(120)
    middles = [(column[part] * rows[part]).sum() / column[part].sum() for part in (rows >= 45, rows < 45)]
    np.testing.assert_allclose(middles, [60, 29], atol=0.2)  # An eighth of 8 pixels, away from the centre.
    perturbed = load_capture(perturb(capture.folder, tmp_path / "lens", Perturbation(lens_px=3.0)))
    changed = {n for n, digest in perturbed.manifest.files.items() if capture.manifest.files.get(n) != digest}
    assert changed == {str(image_path(Path(), *view)) for view in capture.splits["train"].views}
    with pytest.raises(InputError, match="lens_px needs pinhole cameras"):
        through_lens(image, replace(camera, distortion=np.array([0.1, 0, 0, 0])), 8.0)


def test_colour_drift_tints_cameras_and_brightness_drift_does_not(capture: Capture, tmp_path: Path):
    def gains(name: str, perturbation: Perturbation) -> np.ndarray:
        """Linear gain of every training camera's channels, where no channel is clipped."""
        perturbed = load_capture(perturb(capture.folder, tmp_path / name, perturbation, seed=3))
        found = []
        for camera in capture.splits["train"].cameras:
            before, after = (c.image(camera, capture.splits["train"].frames[0]) for c in (capture, perturbed))
            plain = (before[..., 3] == 255) & (before[..., :3] > 40).all(-1) & (after[..., :3] < 250).all(-1)
            found.append(((after[plain, :3] / 255.0) ** 2.2).mean(0) / ((before[plain, :3] / 255.0) ** 2.2).mean(0))
        return np.array(found)

    grey = gains("grey", Perturbation(exposure_stops=0.3))
    tinted = gains("tinted", Perturbation(colour_stops=0.3))
    assert np.ptp(np.log2(grey), axis=1).max() < 0.1 and np.ptp(np.log2(grey), axis=0).min() > 0.2
    assert np.ptp(np.log2(tinted), axis=1).mean() > 0.2


@pytest.mark.parametrize("bad", [{"tracking_deg": -1.0}, {"cameras": 0}, {"noise_factor": 0.5}, {"mask_px": 1000}])
def test_bad_severities_are_refused(bad: dict):
    with pytest.raises(InputError, match="perturbation"):
        Perturbation(**bad)


@pytest.mark.parametrize("kind", [kind for kind in RIGS if kind != "given"])
def test_rigs_frame_the_person(kind: str):
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.4, 0.0, -0.3], [0.4, 1.8, 0.3], size=(500, 3))
    rig = Rig(kind=kind, cameras=20, held_out=4, width=120, height=90)
    cameras = make_cameras(rig, points)
    assert len({camera.name for camera in cameras}) == 20 and len(set(held_out(rig))) == 4
    for camera in cameras:
        pixels, depth = camera.project(points)
        assert (depth > 1).all() and pixels.min() > 0 and (pixels.max(axis=0) < [120, 90]).all()
        assert np.ptp(pixels[:, 1]) > 0.6 * 90 or np.ptp(pixels[:, 0]) > 0.6 * 120
    directions = np.stack([camera.position for camera in cameras])
    assert np.linalg.norm(directions[:, None] - directions, axis=-1)[~np.eye(20, dtype=bool)].min() > 0.2


def test_subsets_are_nested_and_spread():
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(60, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    four, twelve = farthest_points(positions, 4), farthest_points(positions, 12)
    assert twelve[:4] == four and len(set(twelve)) == 12
    apart = np.linalg.norm(positions[four][:, None] - positions[four], axis=-1)[~np.eye(4, dtype=bool)]
    assert apart.min() > 0.9
