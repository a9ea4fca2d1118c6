"""`export` of avatars: what is written is the avatar that the cell renders."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.figures import tube_motion, tube_skeleton
from helpers.gaussian_files import read_gltf, read_ply
from helpers.scoring import psnr

from ash.capture.dataset import Pose
from ash.gaussians.splatting import splat
from ash.mesh.drawing import draw_mesh, textured, topology_of
from ash.model import image_of, views_of
from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.export.bvh import bvh_bytes
from benchmarks.play.avatars import open_avatars
from synth.posing import bone_frames, rotvec_to_rotmat


def exported(source: Path, form: str, out: Path, *more: str) -> int:
    return cli.main(["export", str(source), "--format", form, "--out", str(out), *more])


@pytest.mark.parametrize(
    ("form", "suffix", "start"), [("ply", ".ply", b"ply\n"), ("gltf", ".glb", b"glTF"), ("gltf", ".gltf", b'{"asset"')]
)
def test_exported_gaussians_draw_the_frame_that_the_avatar_renders(form, suffix, start, tube_cells, tmp_path) -> None:
    out = tmp_path / f"frame{suffix}"
    assert exported(tube_cells["ash"], form, out, "--motion", "train", "--frames", "1") == cli.DONE
    assert out.read_bytes().startswith(start)
    read = (read_ply if form == "ply" else read_gltf)(out.read_bytes())
    with open_avatars(tube_cells["ash"]) as avatars:
        capture, avatar = avatars.capture, avatars[avatars.titles[0]].avatar
        frame = capture.splits["train"].frames[1]
        for camera in capture.cameras.values():
            ours = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
            theirs = image_of(splat(read, **views_of([camera]), dilation=avatar.dilation))
            assert (ours[..., 3] > 0.5).mean() > 0.05
            assert psnr(theirs[..., :3], ours[..., :3], ours[..., 3]) > 60


def test_a_range_of_frames_becomes_a_folder_of_files_named_by_the_captures_frames(tube_cells, tmp_path: Path) -> None:
    for motion, frames, names in (("train", "1:4", (1, 2, 3)), ("test", "0:2", (4, 5))):
        out = tmp_path / motion
        assert exported(tube_cells["ash"], "spz", out, "--motion", motion, "--frames", frames) == cli.DONE
        files = sorted(out.iterdir())
        assert [file.name for file in files] == [f"{frame:06d}.spz" for frame in names]
        assert len({file.read_bytes() for file in files}) == len(names)
    assert exported(tube_cells["ash"], "spz", tmp_path / "one") == cli.DONE
    assert (tmp_path / "one.spz").is_file(), "a name without a suffix gets the format's"


def test_the_exported_mesh_is_the_mesh_that_is_drawn(tube_cells, tmp_path: Path) -> None:
    out = tmp_path / "frame.glb"
    assert exported(tube_cells["ddc"], "gltf", out, "--frames", "0") == cli.DONE
    (mesh,) = trimesh.load(io.BytesIO(out.read_bytes()), file_type="glb", process=False).geometry.values()
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    with open_avatars(tube_cells["ddc"]) as avatars:
        capture, avatar = avatars.capture, avatars[avatars.titles[0]].avatar
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


@pytest.mark.parametrize(
    ("source", "form", "out", "more", "words"),
    [
        ("ddc", "ply", "x", (), "has no Gaussians"),
        ("ash", "obj", "x", (), "expected one of ply, spz, gltf, bvh, mp4, html for a trained avatar"),
        ("ash", "colmap", "x", (), "expected one of ply, spz, gltf, bvh, mp4, html for a trained avatar"),
        (
            "capture",
            "ply",
            "x",
            (),
            "expected one of ash, nerfstudio, colmap, plain, test-views, undistorted for a capture",
        ),
        ("ash", "ply", "x.spz", (), "x.spz: expected a name that ends with .ply for the format ply"),
        ("ash", "gltf", "x.ply", (), "x.ply: expected a name that ends with .glb or .gltf for the format gltf"),
        ("run", "ply", "x", (), "expected one avatar"),
        ("nothing", "ply", "x", (), "expected the folder of a capture, a run or a cell"),
        ("ash", "ply", "x", ("--frames", "7"), "within 0:2"),
        ("ash", "ply", "x", ("--frames", "1:1"), "within 0:2"),
        ("ash", "ply", "x", ("--frames", "a"), "A:B or one number"),
        ("ash", "ply", "x.ply", ("--frames", "0:2"), "x.ply: expected a folder for 2 frames"),
        ("ash", "ply", "x", ("--truth",), "--truth: goes with the format mp4, got ply"),
        ("capture", "ash", "x", ("--frame", "0"), "--frame: goes with the format nerfstudio, colmap, got ash"),
        ("capture", "plain", "x", ("--motion", "walk"), "--motion: goes with the format ply, spz, gltf"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(
    source, form, out, more, words, tube_run: Path, tube_cells, tmp_path: Path, capsys
) -> None:
    folder = {"run": tube_run, "capture": tube_run.parent / "capture", "nothing": tube_run.parent, **tube_cells}[source]
    assert exported(folder, form, tmp_path / out, *more) == cli.WRONG_INPUT
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_old_commands_are_aliases_that_say_what_to_type(tube_cells, tmp_path: Path, capsys) -> None:
    cell, out = str(tube_cells["ddc"]), tmp_path / "frame.glb"
    assert cli.main(["export-avatar", cell, "--format", "glb", "--out", str(out)]) == cli.DONE
    assert out.read_bytes().startswith(b"glTF")
    assert capsys.readouterr().err == "ash-bench: export-avatar is now: export\n"
    for old, form, out in (("video", "mp4", "x.gif"), ("share", "html", "x.txt")):
        assert cli.main([old, cell, "--out", out]) == cli.WRONG_INPUT
        message = capsys.readouterr().err
        assert f"{old} is now: export --format {form}\n" in message and "expected a name that" in message


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
            frame_of_joint = np.eye(4)
            frame_of_joint[:3, 3] = rows[frame, :3] if parent < 0 else offsets[joint]
            for axis, angle in zip((2, 0, 1), angles[frame, joint], strict=True):
                turn = np.eye(4)
                turn[:3, :3] = rotvec_to_rotmat(angle * np.eye(3)[axis])
                frame_of_joint = frame_of_joint @ turn
            world.append(frame_of_joint if parent < 0 else world[parent] @ frame_of_joint)
            ours = wanted[frame, skeleton.names.index(names[joint])]
            np.testing.assert_allclose(world[-1], ours, atol=1e-5)
