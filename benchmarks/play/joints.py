"""How far a person's joints turn, and about which axes: what the player's joint sliders mean.

A joint's angles are counted from the neutral position in which clinics measure them: upright, arms hanging, thumbs to
the front. They are three turns in the order of Grood and Suntay (1983), each about an axis that the turns before have
moved along: about the side-to-side axis (forward and back), about the front-to-back axis (sideways), and about the
bone's length (twist). A rest pose with spread arms and bent elbows is not neutral: where its bones point says how far
it is from there.

Ranges are those of the American Academy of Orthopaedic Surgeons (Joint Motion: Method of Measuring and Recording,
1965), which Norkin and White tabulate (Measurement of Joint Motion, appendix A). It measures the trunk and the neck as
a whole, so each of the two joints that we have of either gets one half. The collar bone's are those of the
sternoclavicular joint (AccessPhysiotherapy, Range of Motion for Diarthrodial Joints of the Body). A joint without a
name that is known turns by `UNKNOWN`, from its rest pose, about the world's axes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Motion, Skeleton
from synth.posing import rotation_between

Angles = tuple[float, float, float]  # degrees: forward or back, sideways, twist
ORDER = "XZY"
UNKNOWN = 90.0  # degrees either way


@dataclass(frozen=True, kw_only=True, slots=True)
class JointRange:
    """One of a joint's three turns. `sign` is that of the axis, of a left joint: a positive angle is `more`."""

    more: str  # what a positive angle is called
    less: str
    low: float  # degrees
    high: float
    sign: int


def _range(more: str, high: float | int, less: str, low: float | int, *, sign: int) -> JointRange:
    return JointRange(more=more, less=less, low=-float(low), high=float(high), sign=sign)


Ranges = tuple[JointRange | None, JointRange | None, JointRange | None]


def _half(*, forward: int, back: int, aside: int, twist: int) -> Ranges:
    return (
        _range("bent forward", forward / 2, "bent back", back / 2, sign=1),
        _range("to the left", aside / 2, "to the right", aside / 2, sign=-1),
        _range("turned left", twist / 2, "turned right", twist / 2, sign=1),
    )


TRUNK = _half(forward=80, back=25, aside=35, twist=45)
NECK = _half(forward=45, back=45, aside=45, twist=60)
RANGES: Mapping[str, Ranges] = {  # None: the joint does not turn that way
    "spine": TRUNK,
    "chest": TRUNK,
    "neck": NECK,
    "head": NECK,
    "clavicle": (
        None,
        _range("raised", 45, "lowered", 5, sign=1),
        _range("forward", 15, "back", 15, sign=-1),
    ),
    "upper_arm": (
        _range("raised forward", 180, "stretched back", 60, sign=-1),
        _range("raised sideways", 180, "across the body", 75, sign=1),
        _range("turned in", 70, "turned out", 90, sign=-1),
    ),
    "forearm": (
        _range("bent", 150, "straight", 0, sign=-1),
        None,
        _range("palm back", 80, "palm forward", 80, sign=-1),
    ),
    "hand": (
        _range("towards the thumb", 20, "towards the little finger", 30, sign=-1),
        _range("towards the back of the hand", 70, "towards the palm", 80, sign=1),
        None,
    ),
    "thigh": (
        _range("raised forward", 120, "stretched back", 30, sign=-1),
        _range("spread", 45, "across the other", 30, sign=1),
        _range("turned in", 45, "turned out", 45, sign=-1),
    ),
    "shin": (_range("bent", 135, "straight", 0, sign=1), None, None),
    "foot": (
        _range("toes up", 20, "toes down", 50, sign=-1),
        _range("sole out", 15, "sole in", 35, sign=1),
        None,
    ),
    "toe": (_range("up", 70, "down", 45, sign=-1), None, None),
}
FREELY: Ranges = tuple(  # type: ignore[assignment]
    _range(f"about {axis}", UNKNOWN, "the other way", UNKNOWN, sign=1) for axis in ORDER.lower()
)
HANGING = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}  # straight down in neutral


def ranges_of(name: str) -> Ranges:
    """How far the joint of that name turns; by `UNKNOWN` about each of the world's axes where the name says nothing."""
    return RANGES.get(_part(name)[0], FREELY)


def angles_of(skeleton: Skeleton, joint: int, rotvec: np.ndarray) -> Angles:
    """A joint's angles in a pose: degrees, of its rotation vector `[3]`."""
    parent, own, signs = _neutral(skeleton, joint)
    turn = parent.inv() * Rotation.from_rotvec(rotvec) * own
    x, z, y = (signs * turn.as_euler(ORDER, degrees=True)).tolist()
    return x, z, y


def held(motion: Motion, skeleton: Skeleton, angles: Mapping[int, Angles]) -> Motion:
    """The motion with joints held at angles (joint -> as `angles_of` gives them) in all frames."""
    dofs = motion.dofs.copy()
    for joint, degrees in angles.items():
        parent, own, signs = _neutral(skeleton, joint)
        turn = parent * Rotation.from_euler(ORDER, signs * np.asarray(degrees), degrees=True) * own.inv()
        dofs[:, 3 + 3 * joint : 6 + 3 * joint] = turn.as_rotvec()
    return replace(motion, dofs=dofs)


def _part(name: str) -> tuple[str, int]:
    """The name without its side, and the sign of that side."""
    part, _, side = name.rpartition("_")
    return (part, 1 if side == "left" else -1) if side in ("left", "right") else (name, 1)


def _neutral(skeleton: Skeleton, joint: int) -> tuple[Rotation, Rotation, np.ndarray]:
    """What turns the parent and the joint from neutral to rest, and the signs of the joint's axes, `[3]`."""
    part, side = _part(skeleton.names[joint])
    mirrored = np.array([1, side, side]) if part in RANGES else np.ones(3)
    signs = np.array([1 if each is None else each.sign for each in ranges_of(skeleton.names[joint])])
    parent = int(skeleton.parents[joint])
    return _to_rest(skeleton, parent), _to_rest(skeleton, joint), mirrored * signs


def _to_rest(skeleton: Skeleton, joint: int) -> Rotation:
    """What turns a joint from neutral to rest, by the smallest turn beyond its parent's that does."""
    part = _part(skeleton.names[joint])[0] if joint >= 0 else ""
    if part == "hand":
        return _to_rest(skeleton, int(skeleton.parents[joint]))
    if part not in HANGING:
        return Rotation.identity()  # Trunk and feet rest as they are measured.
    end = skeleton.names[joint].replace(part, HANGING[part])
    if end not in skeleton.names:
        return Rotation.identity()
    parent = _to_rest(skeleton, int(skeleton.parents[joint]))
    bone = parent.inv().apply(skeleton.heads[skeleton.names.index(end)] - skeleton.heads[joint])
    return parent * Rotation.from_matrix(rotation_between(np.array([0.0, -1.0, 0.0]), bone))
