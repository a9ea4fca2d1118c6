"""Steps of a training by hand."""

from typing import Any

from torch import Tensor

from ash.capture.dataset import Camera


def training_views(avatar: Any, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
    """What a step of training draws of one frame."""
    (decoded,) = avatar.decode_together([frame], step)
    return avatar.draw_training_views(frame, cameras, background, step, decoded)
