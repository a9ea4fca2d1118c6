"""A stand-in that trains in an avatar's place and notes what the training loop does with it, and when."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ash.capture.dataset import Camera
from ash.config import TrainingConfig
from ash.protocol import TrainingOutcome
from ash.training.batches import Batch, draw_step
from ash.training.images import TrainingImages
from ash.training.loop import fit

STEPS, SECONDS_PER_STEP = 7, 20.0  # so many steps are looked at, by a clock on which each takes so long


class FakeLearner:
    """Takes an avatar's place in the avatar's own `fit`: learns one number, and notes what the loop does and when."""

    def __init__(self) -> None:
        self.module = torch.nn.Linear(1, 1, bias=False)
        self.groups: list[dict[str, Any]] = [{"params": [self.module.weight], "lr": 1.0}]
        self.step = 0
        self.rates: list[float] = []
        self.shown: list[Batch] = []
        self.told: list[str] = []
        self.kept: list[tuple[int, str]] = []
        self.outcome: TrainingOutcome
        self.images: TrainingImages
        self.config: TrainingConfig  # by which views are compared
        self.before_start: Callable[[], None]

    def fit(
        self, learner: Any, images: TrainingImages, *arguments: Any, before_start: Any = lambda: None, **named: Any
    ) -> TrainingOutcome:
        """In place of `ash.training.loop.fit`; what comes before the first step is left to who wants it."""
        self.before_start, self.images = before_start, images
        self.outcome = fit(self, images, *arguments, **named)
        return self.outcome

    def parameter_groups(self) -> list[dict[str, Any]]:
        return self.groups

    def decode_together(self, frames: Sequence[int], step: int) -> list[None]:
        if torch.is_grad_enabled():  # Reserved views are drawn besides.
            self.step = step
            self.told.append(f"step {step}")
            self.rates.append(self.groups[0]["lr"])
        return [None] * len(frames)

    def draw_training_views(
        self, frame: int, cameras: list[Camera], background: Tensor, step: int, decoded: None
    ) -> Tensor:
        return self.module.weight.reshape(()).expand(len(cameras), cameras[0].height, cameras[0].width, 3)

    def draw_static_views(self, frame: int, cameras: list[Camera], background: Tensor) -> None:
        self.told.append("static")

    def end_warmup(self) -> None:
        self.told.append("warm-up ends")

    def decoder_residual(self, frame: int) -> None:
        return None

    def clock(self) -> float:
        return SECONDS_PER_STEP * self.step

    def draw_step(self, *arguments: Any) -> list[Batch]:
        batches = draw_step(*arguments)
        if self.step < STEPS:
            self.shown += batches
        return batches

    def view_loss(self, drawn: Sequence[Tensor], batches: Sequence[Batch], config: TrainingConfig) -> Tensor:
        self.config = config
        return torch.stack([views.mean() for views in drawn]).mean()

    def write(self, path: Path, content: bytes) -> None:
        if self.step < STEPS:
            self.kept.append((self.step, path.name))
