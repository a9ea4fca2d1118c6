"""Motion files as other programs write them give the motion of their twin, which is written as this project expects."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import refused
from helpers.motion_files import amass_file

from ash.files import InputError
from benchmarks import cli
from synth.motion.importing import import_motion, read_motion_file
from synth.motion.strip import describe
from synth.person.mannequin import heads
from synth.posing import bone_frames
from synth.scene import Take
from synth.skeleton import make_skeleton

SKELETON = make_skeleton(heads())
SMPLX, PARTS = "165 numbers", "root_orient and pose_body"
DATA = Path(__file__).parents[2] / "data" / "motion"


LIMBS = {  # joints of a side: in the twin, in SMPL's words, and as collar, shoulder, elbow
    "Shoulder": ("_collar", "Collar"), "Arm": ("_shoulder", "Shoulder"), "ForeArm": ("_elbow", "Elbow"),
    "Hand": ("_wrist", "Wrist"), "UpLeg": ("_hip", "Hip"), "Leg": ("_knee", "Knee"), "Foot": ("_ankle", "Ankle"),
    "ToeBase": ("_foot", "Toe"),
}  # fmt: skip
SPINE = ({"Hips": "Pelvis", "Spine": "Spine1", "Spine2": "Spine3"}, {"Spine2": "Chest"})
PROP = """ROOT Prop
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 30 0
  }
}
MOTION
"""


def renamed(convention: int) -> str:
    """The twin with other names of its joints."""
    names = SPINE[convention] | {
        f"{side}{joint}": f"{side}{words[convention]}" for side in ("Left", "Right") for joint, words in LIMBS.items()
    }
    return re.sub(r"(ROOT|JOINT) (\S+)", lambda m: f"{m[1]} {names.get(m[2], m[2])}", (DATA / "twin.bvh").read_text())


def with_prop() -> str:
    """The twin beside a prop, a root of its own that moves."""
    skeleton, rows = (DATA / "twin.bvh").read_text().split("MOTION\n")
    head, frames = rows.splitlines()[:2], rows.splitlines()[2:]
    moved = [f"{row} 200 {100 + k} {-5 * k} 0 0 0" for k, row in enumerate(frames)]
    return skeleton + PROP + "\n".join([*head, *moved]) + "\n"


def joint_frames(path: Path, take: Take | None = None) -> np.ndarray:
    return bone_frames(SKELETON, import_motion(path, SKELETON, take=take or Take()).dofs)


@pytest.mark.parametrize(
    ("name", "twin", "rotations"),
    [
        ("smpl_names", "twin", 1e-6),  # left_collar, left_shoulder, left_elbow: SMPL's names
        ("collar_shoulder_elbow", "twin", 1e-6),
        ("static_root", "static_root_twin", 1e-6),  # the path lies on the pelvis, below a root that stands still
        ("two_roots", "twin", 1e-6),  # a prop beside the person
        ("lafan_rest", "twin", 0.1),  # all bones rest along x: their directions are known, the twist is not
    ],
)
def test_a_foreign_bvh_gives_its_twin_s_motion(name: str, twin: str, rotations: float, tmp_path: Path) -> None:
    made = {"smpl_names": lambda: renamed(0), "collar_shoulder_elbow": lambda: renamed(1), "two_roots": with_prop}
    path = DATA / f"{name}.bvh"
    if name in made:
        path = tmp_path / "made.bvh"
        path.write_text(made[name]())
    foreign, expected = joint_frames(path), joint_frames(DATA / f"{twin}.bvh")
    np.testing.assert_allclose(foreign[..., :3, 3], expected[..., :3, 3], atol=1e-6)
    np.testing.assert_allclose(foreign[..., :3, :3], expected[..., :3, :3], atol=rotations)


def test_the_line_says_what_was_understood(tmp_path: Path) -> None:
    (tmp_path / "two_roots.bvh").write_text(with_prop())
    told = describe(read_motion_file(tmp_path / "two_roots.bvh", SKELETON, fps=12.0, take=Take()))
    assert "25 frames at 30 per second, 10 taken at 12 per second; 21 of 21 joints matched" in told
    assert "without a partner: Prop; 2 roots, Hips taken, path 0.69 m" in told


def test_a_file_without_arms_is_refused_with_the_names(tmp_path: Path) -> None:
    text = (DATA / "twin.bvh").read_text().replace("LeftForeArm", "LeftThing")
    (tmp_path / "odd.bvh").write_text(text)
    with pytest.raises(InputError, match=r"no joint for forearm_left among .*LeftThing"):
        import_motion(tmp_path / "odd.bvh", SKELETON)
    named = joint_frames(tmp_path / "odd.bvh", Take(joints=(("forearm_left", "LeftThing"),)))
    np.testing.assert_allclose(named, joint_frames(DATA / "twin.bvh"), atol=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        {"mocap_framerate": None, "mocap_frame_rate": np.array(60.0)},
        {"mocap_framerate": np.array([60.0])},
        {"mocap_framerate": np.array("60")},
        {"mocap_framerate": None, "fps": np.array(60)},
        {"poses": SMPLX},
        {"poses": PARTS},
    ],
    ids=["frame_rate", "list", "text", "fps", "smplx", "parts"],
)
def test_spellings_of_amass_and_smplx_are_read(changes: dict, tmp_path: Path) -> None:
    plain = amass_file(tmp_path / "plain.npz")
    arrays = dict(np.load(plain))
    if changes.get("poses") is SMPLX:
        changes = {"poses": np.concatenate([arrays["poses"], np.zeros((5, 9))], axis=1)}
    elif changes.get("poses") is PARTS:
        changes = {"poses": None, "root_orient": arrays["poses"][:, :3], "pose_body": arrays["poses"][:, 3:66]}
    arrays = {name: value for name, value in (arrays | changes).items() if value is not None}
    np.savez(tmp_path / "other.npz", **arrays)
    np.testing.assert_array_equal(joint_frames(tmp_path / "other.npz"), joint_frames(plain))


def test_a_missing_rate_is_given_by_a_flag(tmp_path: Path) -> None:
    path = amass_file(tmp_path / "walk.npz")
    arrays = dict(np.load(path))
    del arrays["mocap_framerate"]
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=r"no frame rate .*--motion-fps"):
        import_motion(path, SKELETON)
    assert import_motion(path, SKELETON, take=Take(fps=60.0)).fps == 60


def test_a_rest_frame_stands_in_for_the_rest_pose(tmp_path: Path) -> None:
    """The first frame is made the file's T-pose: as rest frame it gives what the rest pose gave."""
    lines = (DATA / "twin.bvh").read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    width = len(lines[first].split())
    lines.insert(first, " ".join(["0", "95", "0", *["0"] * (width - 3)]))
    lines[first - 2] = "Frames: 26"
    (tmp_path / "with_rest.bvh").write_text("\n".join(lines) + "\n")
    frames = joint_frames(tmp_path / "with_rest.bvh", Take(rest_frame=0))
    np.testing.assert_allclose(frames[1:, :, :3, :3], joint_frames(DATA / "twin.bvh")[:, :, :3, :3], atol=1e-6)
    with pytest.raises(InputError, match="rest frame 26, expected 0 to 25"):
        joint_frames(tmp_path / "with_rest.bvh", Take(rest_frame=26))


def test_a_strip_replaces_no_other_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    mine = Path("twin.png")
    mine.write_bytes(b"my own picture")
    assert "there is another file, which is left alone" in refused(capsys, "motions", str(DATA / "twin.bvh"))
    assert mine.read_bytes() == b"my own picture"
    for _ in range(2):  # A strip of ours is replaced.
        assert cli.main(["motions", str(DATA / "twin.bvh"), "--out", "strip.png"]) == 0


def test_a_joint_map_still_counts(tmp_path: Path, capsys) -> None:
    path = tmp_path / "map.json"
    path.write_text(json.dumps({"forearm_left": "nowhere"}))
    told = refused(capsys, "motions", str(DATA / "twin.bvh"), "--joint-map", str(path))
    assert "the joint map gives forearm_left as 'nowhere'" in told
