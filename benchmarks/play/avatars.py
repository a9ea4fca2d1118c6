"""Trained avatars in Python: three lines load one and draw a frame of any motion from any camera.

    from benchmarks.play.avatars import load_avatar
    avatar = load_avatar("runs/ci/cells/0123456789abcdef")
    image = avatar.draw(avatar.motion, frame=12, camera=avatar.cameras["cam000"])

`docs/draw_a_frame.py` does this, with a motion from a file if one is given.
"""

import weakref
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Capture, Motion, Pose
from ash.capture.formats import load_capture
from ash.files import InputError
from ash.protocol import Avatar, StageClock
from benchmarks.cell.cells import is_trained, read_cell
from benchmarks.cell.process import load_avatar as opened_avatar
from benchmarks.play.motions import act_named


class TrainedAvatar:
    """An avatar as its cell trained it."""

    def __init__(self, avatar: Avatar, capture: Capture) -> None:
        self.avatar = avatar  # the method's object; `ash.protocol` says what it can do
        self.capture = capture  # what it was trained on, held-out views included

    @property
    def motion(self) -> Motion:
        """The motion of its capture: the training sequences, then the test sequences."""
        return self.capture.motion

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras of its capture by name."""
        return self.capture.cameras

    def read_motion(self, path: Path | str) -> Motion:
        """A BVH or AMASS file on the avatar's skeleton, at the rate of its capture.

        Raises:
            InputError: the file cannot be read.
        """
        return act_named(self.capture, str(path)).motion

    def draw(self, motion: Motion, *, frame: int, camera: Camera) -> np.ndarray:
        """The avatar in a frame of a motion, seen by a camera: uint8 `[h, w, 4]`, sRGB, straight alpha.

        Raises:
            ValueError: the motion lacks the frame, is of another skeleton, or holds NaN
                (`ash.capture.dataset.require_pose`).
        """
        drawn = self.avatar.render(Pose(motion, frame), camera, clock=StageClock())
        colour = drawn[..., :3] / np.maximum(drawn[..., 3:], 1e-3)
        straight = np.concatenate([colour, drawn[..., 3:]], axis=-1)
        return np.rint(np.clip(straight, 0, 1) * 255).astype(np.uint8)


def load_avatar(folder: Path | str, *, trust: bool = False) -> TrainedAvatar:
    """The trained avatar of a cell's folder. What it needs on disk is freed with it.

    The method's code runs in this process, and can do what you can: one that is not ours wants `trust`.

    Raises:
        InputError: the folder holds no trained cell, its capture is gone or another one, or its method is of others
            and not trusted.
    """
    folder = Path(folder)
    if not (folder / "config.json").is_file():
        inside = sorted(path.parent for path in folder.glob("cells/*/model.safetensors"))
        known = f"; trained ones are {', '.join(map(str, inside[:4]))}" if inside else ""
        raise InputError(f"{folder}: expected the folder of a cell{known}")
    cell = read_cell(folder)
    if not is_trained(cell):
        raise InputError(f"{folder}: {cell.config.title} left no avatar that could be loaded")
    capture = load_capture(cell.capture_folder)
    with ExitStack() as opened:
        avatar, _ = opened.enter_context(opened_avatar(cell, capture, trust=trust))
        trained = TrainedAvatar(avatar, capture)
        weakref.finalize(trained, opened.pop_all().close)
    return trained
