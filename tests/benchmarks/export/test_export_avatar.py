"""`export-avatar`: what is written is the avatar that the cell renders."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.figures import tube_motion, tube_skeleton
from helpers.gaussian_files import read_gltf, read_ply

from ash.capture.dataset import Pose
from ash.gaussians.splatting import splat
from ash.inference import psnr
from ash.mesh.drawing import draw_mesh, textured, topology_of
from ash.model import image_of, views_of
from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.export.bvh import bvh_bytes
from benchmarks.play.actors import open_cast
from synth.posing import bone_frames, rotvec_to_rotmat


@pytest.mark.parametrize(("form", "reader"), [("ply", read_ply), ("gltf", read_gltf)])
def test_exported_gaussians_draw_the_frame_that_the_avatar_renders(form, reader, tube_cells, tmp_path: Path) -> None:
    out = tmp_path / "frame"
    command = ["export-avatar", str(tube_cells["ash"]), "--format", form, "--motion", "train", "--frames", "1"]
    assert cli.main([*command, "--out", str(out)]) == cli.DONE
    read = reader(out.read_bytes())
    with open_cast(tube_cells["ash"]) as cast:
        capture, avatar = cast.capture, cast.actor(cast.titles[0]).avatar
        frame = capture.splits["train"].frames[1]
        for camera in capture.cameras.values():
            ours = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
            theirs = image_of(splat(read, **views_of([camera]), dilation=avatar.dilation))
            assert (ours[..., 3] > 0.5).mean() > 0.05
            assert psnr(theirs[..., :3], ours[..., :3], ours[..., 3]) > 60


def test_a_range_of_frames_becomes_a_folder_of_files(tube_cells, tmp_path: Path, capsys) -> None:
    out = tmp_path / "frames"
    command = ["export-avatar", str(tube_cells["ash"]), "--format", "splat", "--motion", "train", "--frames", "1:4"]
    assert cli.main([*command, "--out", str(out)]) == cli.DONE
    files = sorted(out.iterdir())
    assert [file.name for file in files] == ["000000.splat", "000001.splat", "000002.splat"]
    assert len({file.read_bytes() for file in files}) == 3 and len({file.stat().st_size for file in files}) == 1


def test_the_exported_mesh_is_the_mesh_that_is_drawn(tube_cells, tmp_path: Path) -> None:
    out = tmp_path / "frame.glb"
    command = ["export-avatar", str(tube_cells["ddc"]), "--format", "glb", "--frames", "0", "--out", str(out)]
    assert cli.main(command) == cli.DONE
    (mesh,) = trimesh.load(io.BytesIO(out.read_bytes()), file_type="glb", process=False).geometry.values()
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    with open_cast(tube_cells["ddc"]) as cast:
        capture, avatar = cast.capture, cast.actor(cast.titles[0]).avatar
        frame = capture.splits["novel_pose"].frames[0]
        camera = capture.cameras["cam0"]
        ours = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
    faces = torch.from_numpy(np.asarray(mesh.faces, dtype=np.int64))
    vertices = torch.from_numpy(np.asarray(mesh.vertices, dtype=np.float32))
    image = torch.from_numpy(texture.astype(np.float32) / 255).permute(2, 0, 1)
    uvs = torch.from_numpy(np.asarray(mesh.visual.uv, dtype=np.float32))  # trimesh turns glTF's v around.
    shade = textured(image, uvs, faces, torch.zeros_like(vertices), faces, None)
    theirs = draw_mesh(vertices, topology_of(faces), camera, shade, torch.zeros(3), outlines=False).numpy()
    assert (ours[..., 3] > 0.5).mean() > 0.05
    assert psnr(theirs[..., :3], ours[..., :3], ours[..., 3]) > 45, (
        "eight bits, and light at texels for light at pixels"
    )


def test_formats_that_an_avatar_cannot_fill_are_refused(tube_run: Path, tube_cells, tmp_path: Path, capsys) -> None:
    refused = {
        ("ash", "glb"): "has no textured mesh",
        ("ddc", "ply"): "has no Gaussians",
        ("ash", "obj"): "expected one of ply, splat, spz, gltf, glb, bvh, got 'obj'",
    }
    for (method, form), words in refused.items():
        command = ["export-avatar", str(tube_cells[method]), "--format", form, "--out", str(tmp_path / "x")]
        assert cli.main(command) == cli.WRONG_INPUT
        assert words in capsys.readouterr().err
    command = ["export-avatar", str(tube_run), "--format", "ply", "--out", str(tmp_path / "x")]
    assert cli.main(command) == cli.WRONG_INPUT
    assert "expected one avatar" in capsys.readouterr().err
    for frames, words in (("7", "within 0:2"), ("1:1", "within 0:2"), ("a", "A:B or one number")):
        command = ["export-avatar", str(tube_cells["ash"]), "--format", "ply", "--frames", frames]
        assert cli.main([*command, "--out", str(tmp_path / "x")]) == cli.WRONG_INPUT
        assert words in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_bvh_says_where_every_joint_is(tmp_path: Path) -> None:
    """Read with nothing but the format's rules: offsets, and the channels' rotations from left to right."""
    skeleton, motion = tube_skeleton(), tube_motion(6)
    motion.dofs[:, 3:] += 0.4 * np.random.default_rng(0).normal(size=motion.dofs[:, 3:].shape)
    lines = bvh_bytes(skeleton, motion).decode().splitlines()
    names, offsets, parents, open_joints = [], [], [], []
    for number, line in enumerate(lines):
        words = line.split()
        if words[0] in ("ROOT", "JOINT"):
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(words[1])
        elif words[0] == "{":
            open_joints.append(len(names) - 1)
        elif words[0] == "}":
            open_joints.pop()
        elif words[0] == "OFFSET" and lines[number - 2].split()[0] != "End":
            offsets.append([float(word) for word in words[1:]])
        elif words[0] == "MOTION":
            break
    rows = np.array([[float(word) for word in line.split()] for line in lines[number + 3 :]])
    assert lines[number + 1] == "Frames: 6" and float(lines[number + 2].split()[-1]) == pytest.approx(1 / motion.fps)
    angles = np.deg2rad(rows[:, 3:].reshape(6, -1, 3))
    wanted = bone_frames(skeleton, motion.dofs)
    for frame in range(6):
        world: list[np.ndarray] = []
        for joint, parent in enumerate(parents):
            place = np.eye(4)
            place[:3, 3] = rows[frame, :3] if parent < 0 else offsets[joint]
            for axis, angle in zip((2, 0, 1), angles[frame, joint], strict=True):
                turn = np.eye(4)
                turn[:3, :3] = rotvec_to_rotmat(angle * np.eye(3)[axis])
                place = place @ turn
            world.append(place if parent < 0 else world[parent] @ place)
            ours = wanted[frame, skeleton.names.index(names[joint])]
            np.testing.assert_allclose(world[-1], ours, atol=1e-5)
