"""Motions that an avatar can be played through: those of its capture, and those of files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ash.capture.dataset import Capture, Motion, Pose
from ash.files import InputError
from synth.motion.clips import make_motion
from synth.motion.generators import GENERATORS
from synth.motion.importing import import_motion
from synth.scene import Clip

TRAIN, TEST, NEAR, FAR = "train", "test", "near", "far"
TITLES = {TRAIN: "Training motion", TEST: "Held-out motion", NEAR: "Held-out motion, near", FAR: "Held-out motion, far"}
SPLIT_OF = {TRAIN: "train", TEST: "novel_pose", NEAR: "near_pose", FAR: "far_pose"}
MADE_SECONDS, MADE_SEED = 5.0, 7  # Another walk than that of any capture.
MOST_FRAMES = 20_000  # of a file: half an hour


@dataclass(frozen=True, kw_only=True, slots=True)
class Act:
    """A motion to play. `frames` are indices into `motion`; a captured one shares its motion with the capture."""

    name: str
    title: str
    motion: Motion
    frames: tuple[int, ...]
    captured: bool

    def __len__(self) -> int:
        return len(self.frames)


def acts_of(capture: Capture, more: Sequence[str] = ()) -> tuple[Act, ...]:
    """The capture's motions, then others as `act_named` knows them.

    Raises:
        InputError: an unknown motion, or a file that cannot be read.
    """
    own = [
        Act(name=name, title=TITLES[name], motion=capture.motion, frames=_frames(capture, split), captured=True)
        for name, split in SPLIT_OF.items()
        if split in capture.splits
    ]
    names = dict.fromkeys(name for name in more if name not in [act.name for act in own])
    return (*own, *(act_named(capture, name) for name in names))


def first_act(acts: Sequence[Act], asked: Sequence[str]) -> int:
    """Which of the acts a player opens on: the first that was asked for, else one that was not learned from."""
    return [act.name for act in acts].index(asked[0]) if asked else min(1, len(acts) - 1)


def _frames(capture: Capture, split: str) -> tuple[int, ...]:
    """The frames of a split; of near and far motion, some of which have images, the whole clips."""
    frames = capture.splits[split].frames
    if split not in ("near_pose", "far_pose"):
        return frames
    sequence = capture.motion.sequence
    return tuple(np.flatnonzero(np.isin(sequence, sequence[list(frames)])).tolist())


def _from_file(capture: Capture, name: str) -> Act:
    path = Path(name)
    motion = import_motion(path, capture.skeleton, fps=capture.motion.fps)
    dofs = motion.dofs[:MOST_FRAMES].copy()
    root = dofs[:, [0, 2]] + capture.skeleton.heads[0, [0, 2]]
    dofs[:, [0, 2]] -= (root.min(axis=0) + root.max(axis=0)) / 2  # Our cameras look at the middle of the floor.
    motion = replace(motion, dofs=dofs, sequence=motion.sequence[: len(dofs)])
    return Act(name=name, title=path.name, motion=motion, frames=tuple(range(len(dofs))), captured=False)


def act_named(capture: Capture, name: str) -> Act:
    """`train`, `test`, a motion that is made for the occasion (`walk`, `dance`, ...), or the path of a motion file.

    Raises:
        InputError: none of these; or a file that cannot be read.
    """
    own = {act.name: act for act in acts_of(capture)}
    if name in own:
        return own[name]
    if name in GENERATORS:
        return _made(capture, name)
    if Path(name).suffix.lower() not in (".bvh", ".npz"):
        known = ", ".join((*own, *GENERATORS))
        raise InputError(f"motion: expected {known}, a .bvh or an AMASS .npz file, got {name!r}")
    return _from_file(capture, name)


def _made(capture: Capture, name: str) -> Act:
    frames = round(MADE_SECONDS * capture.motion.fps)
    if "pelvis" not in capture.skeleton.names:
        raise InputError(f"motion: {name} is made for a person's skeleton, which {capture.folder} has not")
    clip = Clip(generator=name, frames=frames)
    motion = make_motion(capture.skeleton, (clip,), fps=capture.motion.fps, seed=MADE_SEED)
    title = name.replace("_", " ").capitalize()
    return Act(name=name, title=title, motion=motion, frames=tuple(range(frames)), captured=False)


def frames_in(act: Act, text: str | None) -> tuple[int, ...]:
    """The frames of an act that `A:B` means (B not included), counted from its start; None: all.

    Raises:
        InputError: no such frames.
    """
    if text is None:
        return act.frames
    first, colon, last = text.partition(":")
    try:
        start = int(first or 0)
        stop = int(last or len(act)) if colon else start + 1
    except ValueError:
        raise InputError(f"frames: expected A:B or one number, got {text!r}") from None
    if not 0 <= start < stop <= len(act):
        raise InputError(f"frames: expected A:B within 0:{len(act)}, got {text}")
    return act.frames[start:stop]


def joint_heads(capture: Capture, pose: Pose) -> np.ndarray:
    """Where the joints are in a frame, `[j, 3]` metres."""
    from synth.posing import bone_frames

    return np.asarray(bone_frames(capture.skeleton, pose.motion.dofs[pose.frame : pose.frame + 1])[0, :, :3, 3])
