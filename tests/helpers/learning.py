"""Small methods, and steps of their training by hand."""

from dataclasses import replace
from typing import Any

from helpers.captures import tiny_plus
from torch import Tensor

from ash.capture.dataset import Camera
from ash.config import TemplateConfig
from baselines.ddc import DdcConfig, ddc_config


def tiny_mesh(*arguments: Any, refine: str = "static", **steps: int) -> DdcConfig:
    """The mesh baseline with the budget of `tiny_plus`, on the skinned template."""
    config = ddc_config(tiny_plus(*arguments, **steps), seed=0, template=TemplateConfig())
    return replace(config, texture=32, refine=refine)


def training_views(avatar: Any, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
    """What a step of training draws of one frame."""
    inputs = avatar._inputs_of(frame)
    (decoded,) = avatar._decode_step([inputs], step)
    return avatar._draw(decoded, inputs, cameras, background, step)
