"""Motions: clips of the generators in order, solved for a skeleton, each from its own random stream."""

from dataclasses import dataclass

import numpy as np

from ash.dataset import Motion, Skeleton
from ash.files import InputError
from synth.generators import GENERATORS
from synth.plans import continuous, solve
from synth.posing import rotmat_to_rotvec, rotvec_to_rotmat


def turned(skeleton: Skeleton, dofs: np.ndarray, yaw: float) -> np.ndarray:
    """The same motion `[t, 3 + 3 j]` seen by a world turned by `yaw` radians about the vertical through its origin."""
    turn = rotvec_to_rotmat(np.array([0.0, yaw, 0.0]))
    result = dofs.copy()
    result[:, :3] = (dofs[:, :3] + skeleton.heads[0]) @ turn.T - skeleton.heads[0]
    root = rotmat_to_rotvec(turn @ rotvec_to_rotmat(dofs[:, 3:6]))
    result[:, 3:6] = continuous(root[:, None])[:, 0]
    return result


@dataclass(frozen=True, kw_only=True, slots=True)
class Clip:
    """A generator, how many frames of it to take, and where on the floor and facing where."""

    generator: str
    frames: int
    yaw: float = 0.0  # radians that the whole clip is turned by about the vertical
    shift: tuple[float, float] = (0.0, 0.0)  # metres, x and z, that it is then moved by

    def __post_init__(self) -> None:
        if self.generator not in GENERATORS:
            raise InputError(f"unknown motion {self.generator!r}, expected one of {', '.join(GENERATORS)}")
        if not 2 <= self.frames <= 100_000:
            raise InputError(f"a clip of {self.frames} frames, expected 2 to 100000")


def make_motion(skeleton: Skeleton, clips: tuple[Clip, ...], *, fps: float, seed: int) -> Motion:
    """Generate the clips in order, each a sequence of its own, each from its own random stream."""
    dofs, sequence = [], []
    for index, clip in enumerate(clips):
        rng = np.random.default_rng([seed, index])
        clip_dofs = solve(skeleton, GENERATORS[clip.generator](np.arange(clip.frames) / fps, rng))
        clip_dofs = turned(skeleton, clip_dofs, clip.yaw) if clip.yaw else clip_dofs
        clip_dofs[:, [0, 2]] += clip.shift
        dofs.append(clip_dofs)
        sequence.append(np.full(clip.frames, index))
    return Motion(dofs=np.concatenate(dofs), sequence=np.concatenate(sequence), fps=fps)


def pose_novelty(motion: Motion, *, train: tuple[int, ...], test: tuple[int, ...]) -> float:
    """How far test poses are from the nearest training pose: mean over test frames, degrees rms over joints.

    The root is left out: heading and place are not pose.
    """
    rotations = rotvec_to_rotmat(motion.dofs[:, 6:].reshape(len(motion.dofs), -1, 3))
    known = rotations[list(train)]
    nearest = []
    for frame in test:
        trace = np.einsum("tjab,jab->tj", known, rotations[frame])
        angles = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        nearest.append(np.sqrt(np.mean(angles**2, axis=1)).min())
    return float(np.rad2deg(np.mean(nearest)))
