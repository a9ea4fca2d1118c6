"""Skeleton and motion as BVH: metres, degrees, y up, rotations applied as Z, X, Y (the format's usual order)."""

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Motion, Skeleton

ORDER = "Zrotation Xrotation Yrotation"
TIP = (0.0, 0.05, 0.0)  # metres: a joint without children needs an end to be drawn at all


def bvh_bytes(skeleton: Skeleton, motion: Motion) -> bytes:
    """The rest pose as the hierarchy's offsets, then a line per frame."""
    rotations = Rotation.from_rotvec(motion.dofs[:, 3:].reshape(-1, 3))
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # Where x is a right angle, y is zero.
        angles = rotations.as_euler("ZXY", degrees=True).reshape(len(motion.dofs), -1, 3)
    order = _depth_first(skeleton)
    root = skeleton.heads[0] + motion.dofs[:, :3]
    rows = np.concatenate([root, angles[:, order].reshape(len(angles), -1)], axis=1)
    lines = ["HIERARCHY", *_joint(skeleton, 0), "MOTION", f"Frames: {len(rows)}"]
    lines += [f"Frame Time: {1 / motion.fps:.9f}", *(" ".join(f"{value:.6f}" for value in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


def _children(skeleton: Skeleton, joint: int) -> list[int]:
    return [int(child) for child in np.flatnonzero(skeleton.parents == joint)]


def _depth_first(skeleton: Skeleton, joint: int = 0) -> list[int]:
    """Joints in the order in which the hierarchy names them, which is that of a frame's numbers."""
    return [joint, *(below for child in _children(skeleton, joint) for below in _depth_first(skeleton, child))]


def _joint(skeleton: Skeleton, joint: int) -> list[str]:
    parent = skeleton.parents[joint]
    offset = skeleton.heads[joint] - (skeleton.heads[parent] if parent >= 0 else skeleton.heads[joint])
    channels = f"3 {ORDER}" if parent >= 0 else f"6 Xposition Yposition Zposition {ORDER}"
    children = _children(skeleton, joint)
    inner = [f"OFFSET {_numbers(offset)}", f"CHANNELS {channels}"]
    for child in children:
        inner += _joint(skeleton, child)
    if not children:
        inner += ["End Site", "{", f"  OFFSET {_numbers(TIP)}", "}"]
    return [f"{'JOINT' if parent >= 0 else 'ROOT'} {skeleton.names[joint]}", "{", *(f"  {line}" for line in inner), "}"]


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{value:.6f}" for value in values)
