"""Exports are read back by plain parsers written from the formats' description, sharing no code with the writers."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ash.capture.dataset import Capture, scan_path
from ash.capture.formats import load_capture, read_scan
from ash.files import InputError
from synth.export.formats import export
from synth.posing import linear_blend_skinning, skinning_transforms


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


def test_plain_files_say_where_a_point_of_the_template_is_seen(capture: Capture, tmp_path: Path):
    """Read by JSON, NumPy and PNG: a rigidly bound vertex projects into the silhouette of its image."""
    export(capture, tmp_path, form="plain")
    views = json.loads((tmp_path / "views.json").read_text())["views"]
    assert {(view["camera"], view["frame"]) for view in views} == set(capture.splits["train"].views)
    cameras = {row["name"]: row for row in json.loads((tmp_path / "cameras.json").read_text())["cameras"]}
    for frame in capture.splits["train"].frames:
        vertices = np.load(scan_path(tmp_path, frame))["vertices"]
        np.testing.assert_array_equal(vertices, read_scan(capture, frame)[0])
    poses, template = np.load(tmp_path / "poses.npz"), np.load(tmp_path / "template.npz")
    np.testing.assert_array_equal(poses["dofs"], capture.motion.dofs[poses["frame"]])
    rigid = template["skin_weights"].max(axis=1) > 0.999
    assert rigid.sum() > 20
    points = np.concatenate([template["vertices"], np.ones((len(rigid), 1))], axis=1)[rigid]
    joint = template["skin_weights"][rigid].argmax(axis=1)
    for view in views:
        camera, row = cameras[view["camera"]], int(np.flatnonzero(poses["frame"] == view["frame"])[0])
        world = np.einsum("vab,vb->va", poses["skinning"][row][joint], points)
        seen = world @ np.array(camera["viewmat"]).T
        pixels = (seen[:, :3] @ np.array(camera["K"]).T)[:, :2] / seen[:, 2:3]
        with Image.open(tmp_path / view["image"]) as image:
            rgba = np.array(image)
        np.testing.assert_array_equal(rgba, capture.image(view["camera"], view["frame"]))
        column, line = pixels.astype(int).T
        assert (rgba[line, column, 3] > 0).mean() > 0.9


def test_test_views_hold_poses_and_cameras_and_no_image(capture: Capture, tmp_path: Path):
    chosen = [(split, capture.splits[split]) for split in ("novel_view", "novel_pose")]
    views = [(name, split.cameras[0], split.frames[0]) for name, split in chosen]
    export(capture, tmp_path, form="test-views", views=views)
    rows = json.loads((tmp_path / "views.json").read_text())["views"]
    assert [(row["split"], row["camera"], row["frame"]) for row in rows] == views
    assert rows[0]["image"] == f"images/novel_view/{views[0][1]}/{views[0][2]:06d}.png"
    assert {row["name"] for row in json.loads((tmp_path / "cameras.json").read_text())["cameras"]} == {
        camera for _, camera, _ in views
    }
    np.testing.assert_array_equal(np.load(tmp_path / "poses.npz")["dofs"], capture.motion.dofs)
    document = json.loads((tmp_path / "views.json").read_text())
    assert document["splits"] == {split: [f"images/{split}/{c}/{f:06d}.png"] for split, c, f in views}
    assert "straight alpha" in (tmp_path / "README.md").read_text()
    assert not list(tmp_path.rglob("*.png"))
    poses, template = np.load(tmp_path / "poses.npz"), np.load(tmp_path / "template.npz")
    for row, frame in enumerate(poses["frame"]):
        moved = np.load(tmp_path / "posed_template" / f"{frame:06d}.npz")["vertices"]
        softer = linear_blend_skinning(template["vertices"], template["skin_weights"], poses["skinning"][row])
        assert np.linalg.norm(moved - softer, axis=1).mean() < 0.01


@pytest.mark.parametrize("form", ["nerfstudio", "colmap", "ash", "plain"])
def test_no_export_of_the_training_part_holds_a_test_image(capture: Capture, tmp_path: Path, form: str):
    """Compared by colours: the release's images have no alpha, its masks are black and white."""
    export(capture, tmp_path, form=form)
    train = {capture.image(*view)[..., :3].tobytes() for view in capture.splits["train"].views}
    tests = [view for name, split in capture.splits.items() if name != "train" for view in split.views]
    held_out = {capture.image(*view)[..., :3].tobytes() for view in tests} - train
    images = [np.array(Image.open(path).convert("RGB")).tobytes() for path in tmp_path.rglob("*.png")]
    assert set(images) & train and held_out and not set(images) & held_out


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
    ("choice", "message"),
    [({"split": "test"}, "novel_pose, novel_view, train"), ({"frame": 999}, r"frame 999.*expected one of")],
)
def test_a_wrong_choice_is_refused(capture: Capture, tmp_path: Path, choice: dict, message: str):
    with pytest.raises(InputError, match=message):
        export(capture, tmp_path / "x", form="colmap", **choice)
