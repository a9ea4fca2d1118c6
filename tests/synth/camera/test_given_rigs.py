"""Rigs that users bring: other files, other units, rounded rotations and other lenses."""

import json
from pathlib import Path

import numpy as np
import pytest

from ash.files import InputError
from synth.camera.rig import look_at, make_cameras, rig_from_file

PERSON = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (0.0, 1.8) for z in (-0.2, 0.2)])
K = [[200.0, 0, 64], [0, 200.0, 64], [0, 0, 1]]


def matrices() -> list[np.ndarray]:
    positions = [np.array([3.4 * np.sin(a), 1.0, 3.4 * np.cos(a)]) for a in (0.1, 1.7, 3.3, 4.8)]
    return [look_at(position, np.array([0, 0.95, 0])) for position in positions]


def ours(path: Path, **changes) -> Path:
    rows = [
        {"name": f"cam{k}", "width": 128, "height": 128, "K": K, "viewmat": viewmat.tolist(), **changes}
        for k, viewmat in enumerate(matrices())
    ]
    path.write_text(json.dumps({"cameras": rows}))
    return path


def viewmats(path: Path) -> np.ndarray:
    return np.stack([camera.viewmat for camera in make_cameras(rig_from_file(path), PERSON)])


def test_cameras_of_gaussian_splatting_are_read(tmp_path: Path) -> None:
    rows = []
    for k, viewmat in enumerate(matrices()):
        pose = np.linalg.inv(viewmat)
        image = {"id": k, "img_name": f"view_{k}", "width": 128, "height": 128, "fx": 200.0, "fy": 200.0}
        rows.append(image | {"rotation": pose[:3, :3].tolist(), "position": pose[:3, 3].tolist()})
    (tmp_path / "cameras.json").write_text(json.dumps(rows))
    np.testing.assert_allclose(viewmats(tmp_path / "cameras.json"), np.stack(matrices()), atol=1e-12)
    cameras = make_cameras(rig_from_file(tmp_path / "cameras.json"), PERSON)
    assert [camera.name for camera in cameras] == [f"view_{k}" for k in range(4)]
    np.testing.assert_array_equal(cameras[0].K, np.array(K))


def test_cameras_of_nerfstudio_are_read(tmp_path: Path) -> None:
    frames = []
    for k, viewmat in enumerate(matrices()):
        pose = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{k}/frame.png", "transform_matrix": pose.tolist()})
    lens = {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.001}
    shared = {"camera_model": "OPENCV", "w": 128, "h": 128, "fl_x": 200.0, "fl_y": 200.0, "cx": 64.0, "cy": 64.0}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(shared | lens | {"frames": frames}))
    np.testing.assert_allclose(viewmats(path), np.stack(matrices()), atol=1e-12)
    cameras = make_cameras(rig_from_file(path), PERSON)
    assert [camera.name for camera in cameras] == ["cam000", "cam001", "cam002", "cam003"], "names that repeat"
    np.testing.assert_array_equal(cameras[0].distortion, [-0.1, 0.02, 0.001, -0.001])
    path.write_text(json.dumps(shared | {"camera_model": "OPENCV_FISHEYE", "frames": frames}))
    with pytest.raises(InputError, match=r"transforms\.json: camera 0: camera_model 'OPENCV_FISHEYE'"):
        rig_from_file(path)


@pytest.mark.parametrize(("scale", "unit"), [(1000, "millimetres"), (100, "centimetres")])
def test_a_rig_in_other_units_is_refused_with_the_guess(scale: int, unit: str, tmp_path: Path) -> None:
    rows = json.loads(ours(tmp_path / "rig.json").read_text())["cameras"]
    for row in rows:
        for k in range(3):
            row["viewmat"][k][3] *= scale
    (tmp_path / "rig.json").write_text(json.dumps(rows))
    with pytest.raises(InputError, match=rf"camera cam0: the person is \d\.\d pixels tall, .* m away .*{unit}\?"):
        viewmats(tmp_path / "rig.json")


def test_rounded_rotations_are_made_orthonormal(tmp_path: Path) -> None:
    path = ours(tmp_path / "rig.json")
    rows = json.loads(path.read_text())["cameras"]
    for row in rows:
        row["viewmat"] = np.round(row["viewmat"], 4).tolist()
    path.write_text(json.dumps(rows))
    found = viewmats(path)[:, :3, :3]
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(found, np.stack(matrices())[:, :3, :3], atol=1e-4)


def test_exact_rotations_keep_their_bits(tmp_path: Path) -> None:
    cameras = make_cameras(rig_from_file(ours(tmp_path / "rig.json")), PERSON)
    np.testing.assert_array_equal([camera.viewmat for camera in cameras], np.stack(matrices()))
    assert [camera.name for camera in cameras] == ["cam0", "cam1", "cam2", "cam3"]


@pytest.mark.parametrize(
    "distortion", [[-0.1, 0.02, 0.001, 0.0], [[-0.1, 0.02, 0.001, 0.0, 0.0]], [-0.1, 0.02, 0.001, *[0.0] * 11]]
)
def test_trailing_zeros_of_a_lens_are_taken(distortion: list, tmp_path: Path) -> None:
    cameras = make_cameras(rig_from_file(ours(tmp_path / "rig.json", distortion=distortion)), PERSON)
    np.testing.assert_array_equal(cameras[3].distortion, [-0.1, 0.02, 0.001, 0.0])


def test_other_coefficients_are_refused_by_camera_and_field(tmp_path: Path) -> None:
    path = ours(tmp_path / "rig.json", distortion=[-0.1, 0.02, 0.001, 0.0, -0.02])
    with pytest.raises(InputError, match=r"rig\.json: camera cam0: k3 is -0\.02, expected 0"):
        rig_from_file(path)


def test_whole_numbers_beyond_the_range_of_floats_are_refused(tmp_path: Path) -> None:
    path = ours(tmp_path / "rig.json", viewmat=[[10**400, 0, 0, 0], *np.eye(4)[1:].tolist()])
    with pytest.raises(InputError, match=r"rig\.json: expected a list of cameras: .*too large"):
        rig_from_file(path)
