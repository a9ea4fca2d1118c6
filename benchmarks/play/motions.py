"""Motions that an avatar can be played through: its capture's, generated ones, and those of files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ash.capture.dataset import Capture, Motion
from ash.files import InputError
from synth.motion.clips import make_motion
from synth.motion.generators import GENERATORS
from synth.motion.importing import import_motion
from synth.scene import Clip

# Motions of a capture: name -> split, title.
CAPTURED = {
    "train": ("train", "Training motion"),
    "test": ("novel_pose", "Novel pose"),
    "near": ("near_pose", "Novel pose, near"),
    "far": ("far_pose", "Novel pose, far"),
}
GENERATED_SECONDS, GENERATED_SEED = 5.0, 7  # another walk than that of any capture
MAX_FRAMES = 20_000  # of a file: half an hour


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionClip:
    """A motion to play. `frames` are indices into `motion`; a captured clip shares its motion with the capture."""

    name: str
    title: str
    motion: Motion
    frames: tuple[int, ...]
    captured: bool

    def __len__(self) -> int:
        return len(self.frames)


def motion_clips(capture: Capture, more: Sequence[str] = ()) -> tuple[MotionClip, ...]:
    """The capture's motions, then others as `motion_clip` takes them.

    Raises:
        InputError: an unknown motion, or a file that cannot be read.
    """
    own = [
        MotionClip(name=name, title=title, motion=capture.motion, frames=_frames(capture, split), captured=True)
        for name, (split, title) in CAPTURED.items()
        if split in capture.splits
    ]
    names = dict.fromkeys(name for name in more if name not in [clip.name for clip in own])
    return (*own, *(motion_clip(capture, name) for name in names))


def first_clip(clips: Sequence[MotionClip], asked: Sequence[str]) -> int:
    """The clip on which a player opens: the first that was asked for, else one that was not trained on."""
    return [clip.name for clip in clips].index(asked[0]) if asked else min(1, len(clips) - 1)


def motion_clip(capture: Capture, name: str) -> MotionClip:
    """`train`, `test`, `near`, `far`, a generated motion (`walk`, `dance`, ...), or the path of a motion file.

    Raises:
        InputError: none of these; or a file that cannot be read.
    """
    own = {clip.name: clip for clip in motion_clips(capture)}
    if name in own:
        return own[name]
    if name in GENERATORS:
        if "pelvis" not in capture.skeleton.names:
            raise InputError(f"motion: {name} expects a person's skeleton, which {capture.folder} does not have")
        clip = Clip(generator=name, frames=round(GENERATED_SECONDS * capture.motion.fps))
        motion = make_motion(capture.skeleton, (clip,), fps=capture.motion.fps, seed=GENERATED_SEED)
        return _other(name, name.replace("_", " ").capitalize(), motion)
    if Path(name).suffix.lower() not in (".bvh", ".npz"):
        known = ", ".join((*own, *GENERATORS))
        raise InputError(f"motion: expected {known}, a .bvh or an AMASS .npz file, got {name!r}")
    motion = import_motion(Path(name), capture.skeleton, fps=capture.motion.fps)
    dofs = motion.dofs[:MAX_FRAMES].copy()
    root = dofs[:, [0, 2]] + capture.skeleton.heads[0, [0, 2]]
    dofs[:, [0, 2]] -= (root.min(axis=0) + root.max(axis=0)) / 2  # The cameras look at the middle of the floor.
    return _other(name, Path(name).name, replace(motion, dofs=dofs, sequence=motion.sequence[: len(dofs)]))


def _other(name: str, title: str, motion: Motion) -> MotionClip:
    frames = tuple(range(len(motion.dofs)))
    return MotionClip(name=name, title=title, motion=motion, frames=frames, captured=False)


def _frames(capture: Capture, split: str) -> tuple[int, ...]:
    """The frames of a split; of near and far motion, some of whose frames have images, the whole sequences."""
    frames = capture.splits[split].frames
    if split not in ("near_pose", "far_pose"):
        return frames
    sequence = capture.motion.sequence
    return tuple(np.flatnonzero(np.isin(sequence, sequence[list(frames)])).tolist())


def frames_in(clip: MotionClip, text: str | None) -> tuple[int, ...]:
    """The frames of a clip that `A:B` means (B not included), counted from its start; None: all.

    Raises:
        InputError: no such frames.
    """
    if text is None:
        return clip.frames
    first, colon, last = text.partition(":")
    try:
        start = int(first or 0)
        stop = int(last or len(clip)) if colon else start + 1
    except ValueError:
        raise InputError(f"frames: expected A:B or one number, got {text!r}") from None
    if not 0 <= start < stop <= len(clip):
        raise InputError(f"frames: expected A:B within 0:{len(clip)}, got {text}")
    return clip.frames[start:stop]
