"""How far a person's joints turn, and about which axes: what the player's joint sliders mean.

A joint's angles are counted from the neutral position in which clinics measure them: upright, arms hanging, thumbs to
the front. They are three turns in the order of Grood and Suntay (1983), each about an axis that the turns before have
moved along: about the side-to-side axis (forward and back), about the front-to-back axis (sideways), and about the
bone's length (twist). A rest pose with spread arms and bent elbows is not neutral: where its bones point says how far
it is from there.

Ranges are those of the American Academy of Orthopaedic Surgeons (Joint Motion: Method of Measuring and Recording,
1965), which Norkin and White tabulate (Measurement of Joint Motion, appendix A). It measures the trunk and the neck as
a whole, so each of the two joints that we have of either gets one half. The collar bone's are those of the
sternoclavicular joint (AccessPhysiotherapy, Range of Motion for Diarthrodial Joints of the Body). A joint with another
name turns by `FREE_DEG`, from its rest pose, about the world's axes.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Motion, Skeleton
from synth.posing import rotation_between

Angles = tuple[float, float, float]  # degrees: forward or back, sideways, twist
ORDER = "XZY"
FREE_DEG = 90.0  # either way


class JointRange(NamedTuple):
    """One of a joint's three turns, in degrees. With the axis times `sign`, of a left joint, positive is `more`."""

    more: str  # what a positive angle is called
    high: float
    less: str
    low: float
    sign: int


Ranges = tuple[JointRange | None, JointRange | None, JointRange | None]


def _half(*, forward: int, back: int, aside: int, twist: int) -> Ranges:
    return (
        JointRange("bent forward", forward / 2, "bent back", -back / 2, 1),
        JointRange("to the left", aside / 2, "to the right", -aside / 2, -1),
        JointRange("turned left", twist / 2, "turned right", -twist / 2, 1),
    )


TRUNK = _half(forward=80, back=25, aside=35, twist=45)
NECK = _half(forward=45, back=45, aside=45, twist=60)
RANGES: Mapping[str, Ranges] = {  # None: the joint does not turn that way
    "spine": TRUNK,
    "chest": TRUNK,
    "neck": NECK,
    "head": NECK,
    "clavicle": (None, JointRange("raised", 45, "lowered", -5, 1), JointRange("forward", 15, "back", -15, -1)),
    "upper_arm": (
        JointRange("raised forward", 180, "stretched back", -60, -1),
        JointRange("raised sideways", 180, "across the body", -75, 1),
        JointRange("turned in", 70, "turned out", -90, -1),
    ),
    "forearm": (JointRange("bent", 150, "straight", 0, -1), None, JointRange("palm back", 80, "palm forward", -80, -1)),
    "hand": (
        JointRange("towards the thumb", 20, "towards the little finger", -30, -1),
        JointRange("towards the back of the hand", 70, "towards the palm", -80, 1),
        None,
    ),
    "thigh": (
        JointRange("raised forward", 120, "stretched back", -30, -1),
        JointRange("spread", 45, "across the other", -30, 1),
        JointRange("turned in", 45, "turned out", -45, -1),
    ),
    "shin": (JointRange("bent", 135, "straight", 0, 1), None, None),
    "foot": (JointRange("toes up", 20, "toes down", -50, -1), JointRange("sole out", 15, "sole in", -35, 1), None),
    "toe": (JointRange("up", 70, "down", -45, -1), None, None),
}
FREE_X, FREE_Z, FREE_Y = (JointRange(f"about {axis}", FREE_DEG, "the other way", -FREE_DEG, 1) for axis in "xzy")
HANGING = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}  # straight down in neutral


def ranges_of(name: str) -> Ranges:
    """How far the joint of that name turns; by `FREE_DEG` about each of the world's axes where the name is unknown."""
    return RANGES.get(_without_side(name)[0], (FREE_X, FREE_Z, FREE_Y))


def angles_of(skeleton: Skeleton, joint: int, rotvec: np.ndarray) -> Angles:
    """A joint's angles in a pose: degrees, of its rotation vector `[3]`."""
    parent, own, signs = _neutral(skeleton, joint)
    turn = parent.inv() * Rotation.from_rotvec(rotvec) * own
    x, z, y = (signs * turn.as_euler(ORDER, degrees=True)).tolist()
    return x, z, y


def with_angles(motion: Motion, skeleton: Skeleton, angles: Mapping[int, Angles]) -> Motion:
    """The motion with joints fixed at angles (joint -> as `angles_of` gives them) in all frames."""
    dofs = motion.dofs.copy()
    for joint, degrees in angles.items():
        parent, own, signs = _neutral(skeleton, joint)
        turn = parent * Rotation.from_euler(ORDER, signs * np.asarray(degrees), degrees=True) * own.inv()
        dofs[:, 3 + 3 * joint : 6 + 3 * joint] = turn.as_rotvec()
    return replace(motion, dofs=dofs)


def _without_side(name: str) -> tuple[str, int]:
    """The name without its side, and the sign of that side."""
    stem, _, side = name.rpartition("_")
    return (stem, 1 if side == "left" else -1) if side in ("left", "right") else (name, 1)


def _neutral(skeleton: Skeleton, joint: int) -> tuple[Rotation, Rotation, np.ndarray]:
    """What turns the parent and the joint from neutral to rest, and the signs of the joint's axes, `[3]`."""
    stem, side = _without_side(skeleton.names[joint])
    mirrored = np.array([1, side, side]) if stem in RANGES else np.ones(3)
    signs = np.array([1 if each is None else each.sign for each in ranges_of(skeleton.names[joint])])
    parent = int(skeleton.parents[joint])
    return _neutral_to_rest(skeleton, parent), _neutral_to_rest(skeleton, joint), mirrored * signs


def _neutral_to_rest(skeleton: Skeleton, joint: int) -> Rotation:
    """What turns a joint from neutral to rest, by the smallest turn beyond its parent's that does."""
    stem = _without_side(skeleton.names[joint])[0] if joint >= 0 else ""
    if stem == "hand":
        return _neutral_to_rest(skeleton, int(skeleton.parents[joint]))
    end = skeleton.names[joint].replace(stem, HANGING[stem]) if stem in HANGING else ""
    if end not in skeleton.names:
        return Rotation.identity()  # Trunk and feet rest as they are measured.
    parent = _neutral_to_rest(skeleton, int(skeleton.parents[joint]))
    bone = parent.inv().apply(skeleton.heads[skeleton.names.index(end)] - skeleton.heads[joint])
    return parent * Rotation.from_matrix(rotation_between(np.array([0.0, -1.0, 0.0]), bone))
