"""Exports are read back by plain parsers written from the formats' description, sharing no code with the writers."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError
from synth.posing import linear_blend_skinning, skinning_transforms
from synth.readers.export import export


@pytest.fixture(scope="module")
def capture(small_capture: Path) -> Capture:
    return load_capture(small_capture)


def test_nerfstudio_cameras_look_along_minus_z(capture: Capture, tmp_path: Path):
    export(capture, tmp_path, form="nerfstudio")
    document = json.loads((tmp_path / "frame_000000" / "transforms.json").read_text())
    points = capture.template.vertices[::100]
    for row in document["frames"]:
        camera = capture.cameras[Path(row["file_path"]).stem]
        in_camera = (
            np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.linalg.inv(row["transform_matrix"]).T
        )
        x, y, z = in_camera[:, :3].T
        assert (z < 0).all()
        pixels = np.stack([row["fl_x"] * x / -z + row["cx"], row["fl_y"] * -y / -z + row["cy"]], axis=1)
        np.testing.assert_allclose(pixels, camera.project(points)[0], atol=1e-6)
        assert (tmp_path / "frame_000000" / row["file_path"]).is_file()


def test_colmap_text_projects_as_ours(capture: Capture, tmp_path: Path):
    export(capture, tmp_path, form="colmap")
    model = {
        name: [line for line in (tmp_path / "sparse/0" / f"{name}.txt").read_text().splitlines()[1:] if line]
        for name in ("cameras", "images", "points3D")
    }
    points = np.array([line.split()[1:4] for line in model["points3D"]], dtype=float)
    frame, weights = capture.splits["train"].frames[0], capture.template.skin_weights
    transforms = skinning_transforms(capture.skeleton, capture.motion.dofs)[frame]
    softer = linear_blend_skinning(capture.template.vertices, weights, transforms)
    assert np.linalg.norm(points - softer, axis=1).mean() < 0.01
    for camera_line, image_line in zip(model["cameras"], model["images"], strict=True):
        fx, fy, cx, cy = (float(value) for value in camera_line.split()[4:])
        w, x, y, z, *shift = (float(value) for value in image_line.split()[1:8])
        q = np.array([x, y, z])
        seen = points + 2 * np.cross(q, np.cross(q, points) + w * points) + shift
        pixels = np.stack([fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy], axis=1)
        camera = capture.cameras[Path(image_line.split()[-1]).stem]
        np.testing.assert_allclose(pixels, camera.project(points)[0], atol=1e-6)


def test_glb_animates_the_skinned_template(capture: Capture, tmp_path: Path):
    content = (export(capture, tmp_path, form="glb") / "human.glb").read_bytes()
    magic, version, size = struct.unpack("<4sII", content[:12])
    assert (magic, version, size) == (b"glTF", 2, len(content))
    length = struct.unpack("<I", content[12:16])[0]
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]

    def read(index: int) -> np.ndarray:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: np.float32, 5125: np.uint32, 5123: np.uint16}[accessor["componentType"]]
        flat = np.frombuffer(binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], dtype=kind)
        return flat.reshape(accessor["count"], -1).astype(np.float64)

    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    positions, joints, weights = (read(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0"))
    frame = 2
    local = [np.eye(4) for _ in capture.skeleton.names]
    for j, node in enumerate(document["nodes"][: len(local)]):
        local[j][:3, 3] = node["translation"]
    animation = document["animations"][0]
    for channel in animation["channels"]:
        value = read(animation["samplers"][channel["sampler"]]["output"])[frame]
        j = channel["target"]["node"]
        if channel["target"]["path"] == "translation":
            local[j][:3, 3] = value
        else:
            x, y, z, w = value
            skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            local[j][:3, :3] = np.eye(3) + 2 * w * skew + 2 * skew @ skew
    world: list[np.ndarray] = []
    for j, parent in enumerate(capture.skeleton.parents):
        world.append(local[j] if parent < 0 else world[parent] @ local[j])
    bind = read(document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    dense = np.zeros((len(positions), len(world)))
    np.add.at(dense, (np.arange(len(positions))[:, None], joints.astype(int)), weights)
    posed = linear_blend_skinning(positions, dense, np.array(world) @ bind)
    expected = linear_blend_skinning(
        positions, dense, skinning_transforms(capture.skeleton, capture.motion.dofs)[frame]
    )
    np.testing.assert_allclose(posed, expected, atol=1e-5)


def test_unknown_formats_are_refused(capture: Capture, tmp_path: Path):
    with pytest.raises(InputError, match="ash, nerfstudio, colmap, glb"):
        export(capture, tmp_path, form="fbx")


def test_frames_and_splits_can_be_chosen(capture: Capture, tmp_path: Path):
    frame = capture.splits["novel_pose"].frames[1]
    held_out = capture.splits["novel_pose"].cameras
    export(capture, tmp_path / "c", form="colmap", split="novel_pose", frame=frame)
    lines = (tmp_path / "c/sparse/0/images.txt").read_text().splitlines()[1:]
    assert [line.split()[-1] for line in lines if line] == [f"{name}.png" for name in held_out]
    with Image.open(tmp_path / "c/images" / f"{held_out[0]}.png") as image:
        np.testing.assert_array_equal(np.array(image), capture.image(held_out[0], frame))
    assert f"split novel_pose, frame {frame}" in (tmp_path / "c/ABOUT.txt").read_text()
    export(capture, tmp_path / "n", form="nerfstudio", split="novel_pose", frame=frame)
    assert [path.name for path in (tmp_path / "n").glob("frame_*")] == [f"frame_{frame:06d}"]
    assert "1 frame of split novel_pose" in (tmp_path / "n/ABOUT.txt").read_text()


@pytest.mark.parametrize(
    ("form", "choice", "message"),
    [
        ("colmap", {"split": "test"}, "novel_pose, novel_view, train"),
        ("colmap", {"frame": 999}, r"frame 999.*expected one of"),
        ("glb", {"frame": 0}, "glb holds the whole motion"),
        ("ash", {"split": "novel_pose"}, "ash holds"),
    ],
)
def test_a_wrong_choice_is_refused(capture: Capture, tmp_path: Path, form: str, choice: dict, message: str):
    with pytest.raises(InputError, match=message):
        export(capture, tmp_path / "x", form=form, **choice)
