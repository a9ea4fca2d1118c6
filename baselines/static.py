"""A reference: 3D Gaussians of one frame, skinned. What is lost against it is what other frames teach."""

from dataclasses import replace
from pathlib import Path

from ash.config import AshConfig, TemplateConfig
from ash.dataset import Capture
from ash.method import AshAvatar
from ash.presets import named
from baselines.nearest import central_frame


class StaticAvatar(AshAvatar):
    """ASH without motion, which sees every camera of a single training frame."""

    def __init__(self, config: AshConfig, capture: Capture) -> None:
        super().__init__(config, of_one_frame(capture))

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Train on the one frame."""
        super().fit(of_one_frame(capture), folder=folder)


def of_one_frame(capture: Capture) -> Capture:
    """The capture with one training frame: the one whose pose is nearest to all others."""
    train = capture.splits["train"]
    frame = central_frame(capture.motion, train.frames)
    return replace(capture, splits=capture.splits | {"train": replace(train, frames=(frame,))})


def static(capture: Capture, *, seed: int, preset: str) -> StaticAvatar:
    """One set of Gaussians from one frame, at the preset's budget."""
    config = named(preset)
    model = replace(config.model, motion=False, base=True)
    training = replace(config.training, warmup="none", warmup_steps=0)
    template = TemplateConfig(kind="skinned")  # One frame teaches no deformation.
    return StaticAvatar(replace(config, model=model, training=training, template=template, seed=seed), capture)
