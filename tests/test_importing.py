from pathlib import Path

import numpy as np
import pytest
from motion_files import amass_file, bvh_file

from ash.files import InputError
from synth.importing import import_motion
from synth.mannequin import heads
from synth.plans import make_skeleton
from synth.posing import bone_frames

SKELETON = make_skeleton(heads())


def _directions(dofs: np.ndarray) -> dict[str, np.ndarray]:
    """World direction of each bone, `[t, 3]`, named by the joint at its start."""
    frames = bone_frames(SKELETON, dofs)[:, :, :3, 3]
    result = {}
    for j, parent in enumerate(SKELETON.parents):
        if parent >= 0:
            bone = frames[:, j] - frames[:, parent]
            result[SKELETON.names[j]] = bone / np.linalg.norm(bone, axis=1, keepdims=True)
    return result


def test_amass_poses_become_our_directions(tmp_path: Path):
    motion = import_motion(amass_file(tmp_path / "walk.npz"), SKELETON)
    bones = _directions(motion.dofs)
    assert motion.fps == 60 and len(motion.dofs) == 5
    np.testing.assert_allclose(bones["forearm_left"][0], [1, 0, 0], atol=1e-9)  # T-pose, though ours rests in an A
    np.testing.assert_allclose(bones["hand_right"][0], [-1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(bones["shin_left"][0], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_left"][2], [0, -np.cos(1), -np.sin(1)], atol=1e-9)  # the shin swings back
    np.testing.assert_allclose(bones["forearm_left"][3], [np.cos(1.2), -np.sin(1.2), 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_right"][4], [0, -1, 0], atol=1e-9)
    path = bone_frames(SKELETON, motion.dofs)[:, 0, :3, 3]
    assert path[-1, 2] - path[0, 2] > 0.9 and abs(path[-1, 0] - path[0, 0]) < 1e-9  # -y there is forward (+z) here
    toes = [SKELETON.names.index(f"toe_{side}") for side in ("left", "right")]
    lowest = (bone_frames(SKELETON, motion.dofs)[:, toes, 1, 3] - SKELETON.heads[toes, 1]).min()
    assert abs(lowest) < 1e-9


def test_frames_are_taken_at_the_wanted_rate(tmp_path: Path):
    motion = import_motion(amass_file(tmp_path / "walk.npz"), SKELETON, fps=30.0)
    assert motion.fps == 30 and len(motion.dofs) == 3


def test_bvh_turns_and_bends_what_it_says(tmp_path: Path):
    motion = import_motion(bvh_file(tmp_path / "turn.bvh"), SKELETON)
    assert motion.fps == pytest.approx(25)
    bones = _directions(motion.dofs)
    np.testing.assert_allclose(bones["shin_left"][0], [0, -1, 0], atol=1e-9)
    # The pelvis faces +x after a quarter turn about y, so a knee bent by 60 degrees points the shin to -x.
    np.testing.assert_allclose(bones["foot_left"][1], [-np.sin(np.pi / 3), -0.5, 0], atol=1e-9)
    np.testing.assert_allclose(bones["foot_right"][1], [0, -1, 0], atol=1e-9)
    hip, ankle = (SKELETON.heads[SKELETON.names.index(name)] for name in ("thigh_left", "foot_left"))
    leg = np.linalg.norm(ankle - hip)
    np.testing.assert_allclose(motion.dofs[1, 2] - motion.dofs[0, 2], 40 * leg / 80, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "BVH"),
        ("HIERARCHY ROOT", "BVH"),
        ("HIERARCHY ROOT Hips { OFFSET 0 0", "BVH"),
        ("HIERARCHY } } MOTION", "BVH"),
        ("HIERARCHY ROOT Hips { OFFSET 0 0 nan CHANNELS 0 } MOTION", "finite"),
        ("HIERARCHY ROOT Hips { CHANNELS 1000000000 } MOTION", "channels"),
        ("HIERARCHY ROOT A { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0.1 0", "no joint"),
        ("\x00\x01\x02 binary", "HIERARCHY"),
    ],
)  # fmt: skip
def test_broken_bvh_is_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "broken.bvh"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        import_motion(path, SKELETON)


def test_bvh_that_promises_too_much_is_refused(tmp_path: Path):
    path = bvh_file(tmp_path / "short.bvh", frames="0 0 0\n")
    with pytest.raises(InputError, match="3 numbers found"):
        import_motion(path, SKELETON)
    path.write_text(path.read_text().replace("Frames: 2", "Frames: 1000000000"))
    with pytest.raises(InputError, match="1000000000 frames"):
        import_motion(path, SKELETON)
    path.write_text("HIERARCHY " + "JOINT a { " * 600)
    with pytest.raises(InputError, match="more than 512 joints"):
        import_motion(path, SKELETON)


def test_hostile_npz_is_refused(tmp_path: Path):
    poses = np.zeros((5, 156))
    bad = {
        "finite": {"poses": np.full((5, 156), np.nan)},
        "shape": {"poses": poses[:, :60]},
        "trans": {"trans": np.zeros((4, 3))},
        "mocap_framerate": {"mocap_framerate": np.array(-1.0)},
        "allow_pickle|Object arrays|npz": {"trans": np.array([{"a": 1}] * 5, dtype=object)},
    }
    for message, changes in bad.items():
        with pytest.raises(InputError, match=message):
            import_motion(amass_file(tmp_path / "bad.npz", **changes), SKELETON)
    whole = amass_file(tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="npz"):
        import_motion(tmp_path / "cut.npz", SKELETON)
    with pytest.raises(InputError, match="cannot be read"):
        import_motion(tmp_path / "absent.bvh", SKELETON)
    with pytest.raises(InputError, match=r"\.bvh or an AMASS"):
        import_motion(tmp_path / "dance.fbx", SKELETON)
