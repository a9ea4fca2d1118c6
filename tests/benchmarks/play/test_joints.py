"""Joints turn about the axes that their sliders name, as far as people's do."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.figures import tube_skeleton

from ash.capture.dataset import Motion, Skeleton
from benchmarks.play.joints import FREE_DEG, RANGES, angles_of, ranges_of, with_angles
from synth.motion.clips import make_motion
from synth.motion.generators import GENERATORS
from synth.person import mannequin
from synth.posing import bone_frames, rotation_between, rotvec_to_rotmat
from synth.scene import Clip
from synth.skeleton import JOINTS, SIDES, SIGNS, make_skeleton

LEFT, UP, FRONT = np.eye(3)


@pytest.fixture(params=["straight arms", "bent elbows"])
def skeleton(request: pytest.FixtureRequest) -> Skeleton:
    """The mannequin's, and one that rests with its elbows bent by a quarter turn."""
    straight = make_skeleton(mannequin.heads())
    if request.param == "straight arms":
        return straight
    heads = straight.heads.copy()
    for side in SIDES:
        shoulder, elbow, hand = (straight.names.index(f"{part}_{side}") for part in ("upper_arm", "forearm", "hand"))
        arm = heads[elbow] - heads[shoulder]
        to_front = rotation_between(arm, FRONT)
        half_way = rotvec_to_rotmat(np.deg2rad(45) * np.cross(arm, FRONT) / np.linalg.norm(arm))
        assert np.allclose(half_way @ half_way, to_front)
        heads[hand] = heads[elbow] + half_way @ (heads[hand] - heads[elbow])
    return replace(straight, heads=heads)


def rest(skeleton: Skeleton) -> Motion:
    return Motion(dofs=np.zeros((1, 3 + 3 * len(skeleton.names))), sequence=np.zeros(1, dtype=np.int64), fps=25.0)


def neutral(skeleton: Skeleton) -> Motion:
    """Arms hanging, all joints at zero."""
    zeros = {joint: (0.0, 0.0, 0.0) for joint, name in enumerate(skeleton.names) if name != "pelvis"}
    return with_angles(rest(skeleton), skeleton, zeros)


def bone(skeleton: Skeleton, motion: Motion, start: str, end: str) -> np.ndarray:
    """Where a bone points, `[3]`."""
    heads = bone_frames(skeleton, motion.dofs)[0, :, :3, 3]
    along = heads[skeleton.names.index(end)] - heads[skeleton.names.index(start)]
    return along / np.linalg.norm(along)


@pytest.mark.parametrize(("side", "outwards"), list(zip(SIDES, (s * LEFT for s in SIGNS), strict=True)))
def test_at_zero_people_stand_with_hanging_arms_and_angles_go_where_their_names_say(
    skeleton: Skeleton, side: str, outwards: np.ndarray
) -> None:
    start = neutral(skeleton)
    chain = ("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot")
    for one, other in (pair for names in chain for pair in pairwise(names)):
        np.testing.assert_allclose(bone(skeleton, start, f"{one}_{side}", f"{other}_{side}"), -UP, atol=1e-9)
    for turned, degrees, of, wanted in (
        ("upper_arm", (90.0, 0.0, 0.0), ("upper_arm", "forearm"), FRONT),
        ("upper_arm", (0.0, 90.0, 0.0), ("upper_arm", "forearm"), outwards),
        ("upper_arm", (180.0, 0.0, 0.0), ("forearm", "hand"), UP),
        ("upper_arm", (-60.0, 0.0, 0.0), ("upper_arm", "forearm"), -np.sin(np.pi / 3) * FRONT - 0.5 * UP),
        ("forearm", (90.0, 0.0, 0.0), ("forearm", "hand"), FRONT),
        ("thigh", (90.0, 0.0, 0.0), ("thigh", "shin"), FRONT),
        ("thigh", (0.0, 90.0, 0.0), ("thigh", "shin"), outwards),
        ("shin", (90.0, 0.0, 0.0), ("shin", "foot"), -FRONT),
    ):
        joint = skeleton.names.index(f"{turned}_{side}")
        ends = [f"{name}_{side}" for name in of]
        np.testing.assert_allclose(
            bone(skeleton, with_angles(start, skeleton, {joint: degrees}), *ends), wanted, atol=1e-9
        )
    elbow, shoulder = (skeleton.names.index(f"{name}_{side}") for name in ("forearm", "upper_arm"))
    turned_in = with_angles(start, skeleton, {elbow: (90.0, 0.0, 0.0), shoulder: (0.0, 0.0, 90.0)})
    np.testing.assert_allclose(bone(skeleton, turned_in, f"forearm_{side}", f"hand_{side}"), -outwards, atol=1e-9)
    ankle = skeleton.names.index(f"foot_{side}")
    up = with_angles(start, skeleton, {ankle: (20.0, 0.0, 0.0)})
    assert (
        bone(skeleton, up, f"foot_{side}", f"toe_{side}")[1] > bone(skeleton, start, f"foot_{side}", f"toe_{side}")[1]
    )


def test_the_trunk_bends_forward_to_the_left_and_turns_left(skeleton: Skeleton) -> None:
    start = neutral(skeleton)
    spine = skeleton.names.index("spine")
    assert bone(skeleton, with_angles(start, skeleton, {spine: (40.0, 0.0, 0.0)}), "spine", "head")[2] > 0.6
    assert bone(skeleton, with_angles(start, skeleton, {spine: (0.0, 17.5, 0.0)}), "spine", "head")[0] > 0.29
    shoulders = bone(
        skeleton, with_angles(start, skeleton, {spine: (0.0, 0.0, 22.5)}), "upper_arm_right", "upper_arm_left"
    )
    np.testing.assert_allclose(shoulders, [np.cos(np.pi / 8), 0, -np.sin(np.pi / 8)], atol=1e-9)


def test_angles_that_are_held_are_read_back(skeleton: Skeleton) -> None:
    draw = np.random.default_rng(0)
    for joint in range(len(skeleton.names)):
        wanted = tuple(draw.uniform([-170, -80, -170], [170, 80, 170]).tolist())
        motion = with_angles(rest(skeleton), skeleton, {joint: wanted})
        at = slice(3 + 3 * joint, 6 + 3 * joint)
        np.testing.assert_allclose(angles_of(skeleton, joint, motion.dofs[0, at]), wanted, atol=1e-6)
        others = np.delete(motion.dofs, np.arange(at.start, at.stop), axis=1)
        assert not others.any(), "other joints go on as the motion has them"


def test_a_resting_elbow_is_as_bent_as_it_looks(skeleton: Skeleton) -> None:
    shoulder, elbow = (skeleton.names.index(f"{part}_left") for part in ("upper_arm", "forearm"))
    arm = skeleton.heads[elbow] - skeleton.heads[shoulder]
    forearm = skeleton.heads[skeleton.names.index("hand_left")] - skeleton.heads[elbow]
    bend = np.rad2deg(np.arccos(arm @ forearm / np.linalg.norm(arm) / np.linalg.norm(forearm)))
    np.testing.assert_allclose(angles_of(skeleton, elbow, np.zeros(3)), (bend, 0, 0), atol=1e-4)
    spread = np.rad2deg(np.arctan2(arm[0], -arm[1]))
    np.testing.assert_allclose(angles_of(skeleton, shoulder, np.zeros(3)), (0, spread, 0), atol=1e-4)


@pytest.mark.parametrize("name", GENERATORS)
def test_motions_of_people_keep_knees_and_elbows_within_their_ranges(skeleton: Skeleton, name: str) -> None:
    """Measured in the data, and not by what set them: an axis with the wrong sign would be seen at once."""
    motion = make_motion(skeleton, (Clip(generator=name, frames=40),), fps=25.0, seed=3)
    for joint, joint_name in enumerate(skeleton.names):
        if joint_name.rpartition("_")[0] in ("shin", "forearm", "thigh"):
            rotvecs = motion.dofs[::8, 3 + 3 * joint : 6 + 3 * joint]
            angles = np.array([angles_of(skeleton, joint, rotvec) for rotvec in rotvecs])
            bends = ranges_of(joint_name)[0]
            assert bends is not None
            assert angles[:, 0].min() > bends.low - 5 and angles[:, 0].max() < bends.high + 5, joint_name


def test_every_joint_of_ours_has_ranges_and_unknown_ones_the_default() -> None:
    names = {name.removesuffix("_left").removesuffix("_right") for name, _ in JOINTS}
    assert names - set(RANGES) == {"pelvis"} and set(RANGES) <= names
    for name in ("pelvis", *tube_skeleton().names, "knee_left"):
        assert [(each.low, each.high) for each in ranges_of(name) if each] == [(-FREE_DEG, FREE_DEG)] * 3
    assert ranges_of("shin_left") == ranges_of("shin_right")
    (knee, *stiff), elbow = ranges_of("shin_left"), ranges_of("forearm_right")
    assert knee and (knee.low, knee.high) == (0, 135) and stiff == [None, None]
    assert elbow[0] and (elbow[0].low, elbow[0].high) == (0, 150) and elbow[1] is None
    assert sum(each.high for name in ("spine", "chest") if (each := ranges_of(name)[0])) == 80
