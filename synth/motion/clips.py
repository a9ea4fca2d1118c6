"""Motions: clips of generators or of files, in order, solved for a skeleton, each from its own random stream."""

from pathlib import Path

import numpy as np

from ash.capture.dataset import Motion, Skeleton
from ash.files import InputError, sha256_of
from synth.motion.generators import GENERATORS, in_a_manner
from synth.motion.importing import WHOLE, import_motion
from synth.motion.plans import continuous, solve
from synth.posing import rotmat_to_rotvec, rotvec_to_rotmat
from synth.scene import GIVEN, Clip, Take


def turned(skeleton: Skeleton, dofs: np.ndarray, yaw: float) -> np.ndarray:
    """The same motion `[t, 3 + 3 j]` seen by a world turned by `yaw` radians about the vertical through its origin."""
    turn = rotvec_to_rotmat(np.array([0.0, yaw, 0.0]))
    result = dofs.copy()
    result[:, :3] = (dofs[:, :3] + skeleton.heads[0]) @ turn.T - skeleton.heads[0]
    root = rotmat_to_rotvec(turn @ rotvec_to_rotmat(dofs[:, 3:6]))
    result[:, 3:6] = continuous(root[:, None])[:, 0]
    return result


FLOOR = 1.2  # metres from the middle of the floor that a motion from a file may reach


def make_motion(skeleton: Skeleton, clips: tuple[Clip, ...], *, fps: float, seed: int) -> Motion:
    """Generate the clips in order, each from its own random stream; each of their runs is a sequence of its own."""
    runs = []
    for index, clip in enumerate(clips):
        if clip.generator == GIVEN:
            clip_dofs = _from_file(skeleton, clip, fps=fps)
        else:
            rng = np.random.default_rng([seed, index])
            plan = GENERATORS[clip.generator](np.arange(clip.span or clip.frames) / fps, rng)
            clip_dofs = solve(skeleton, plan if clip.generator == "stand" else in_a_manner(plan, rng))
        clip_dofs = turned(skeleton, clip_dofs, clip.yaw) if clip.yaw else clip_dofs
        clip_dofs[:, [0, 2]] += clip.shift
        runs += [clip_dofs[start : start + clip.frames] for start in clip.starts]
    sequence = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
    return Motion(dofs=np.concatenate(runs), sequence=sequence, fps=fps)


def clip_from_file(path: Path, skeleton: Skeleton, *, fps: float, most: int, take: Take = WHOLE) -> Clip:
    """The frames that `take` wants of a BVH or AMASS file at `fps`, at most `most` of them.

    Raises:
        InputError: the file is damaged or hostile, too slow or too short, or leaves the floor that cameras see.
    """
    path = path.resolve()
    motion = import_motion(path, skeleton, fps=fps, most=most, take=take)
    if motion.fps < fps * 0.999:
        raise InputError(f"{path}: {motion.fps:.3g} frames per second, expected at least {fps:g}")
    frames = max(2, min(most, len(motion.dofs)))
    clip = Clip(generator=GIVEN, frames=frames, given=sha256_of(path), take=take, path=str(path))
    _from_file(skeleton, clip, fps=fps)
    return clip


def _from_file(skeleton: Skeleton, clip: Clip, *, fps: float) -> np.ndarray:
    """Degrees of freedom of a given clip `[t, 3 + 3 j]`, its path centred on the middle of the floor."""
    path = Path(clip.path)
    if not path.is_file() or sha256_of(path) != clip.given:
        raise InputError(f"{path}: expected the motion file with SHA-256 {clip.given[:12]}")
    dofs = import_motion(path, skeleton, fps=fps, most=clip.frames, take=clip.take).dofs.copy()
    if len(dofs) < clip.frames:
        raise InputError(f"{path}: {len(dofs)} frames at {fps:g} per second, expected at least {clip.frames}")
    root = dofs[:, [0, 2]] + skeleton.heads[0, [0, 2]]
    middle = (root.min(axis=0) + root.max(axis=0)) / 2
    dofs[:, [0, 2]] -= middle
    reach = float(np.linalg.norm(root - middle, axis=1).max())
    if reach > FLOOR:
        raise InputError(f"{path}: the motion goes {reach:.2f} m from its middle, expected at most {FLOOR} m")
    return dofs
