"""Steps of a training by hand."""

from typing import Any

from torch import Tensor

from ash.capture.dataset import Camera


def training_views(avatar: Any, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
    """What a step of training draws of one frame."""
    inputs = avatar._inputs_of(frame)
    (decoded,) = avatar._decode_step([inputs], step)
    return avatar._draw(decoded, inputs, cameras, background, step)
