"""A stand-in that trains in an avatar's place and notes what the training loop does with it, and when."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ash.capture.dataset import Camera
from ash.config import TrainingConfig
from ash.protocol import TrainingOutcome
from ash.training.batches import Batch, draw_step
from ash.training.images import TrainingImages
from ash.training.loop import Trainer

STEPS, SECONDS_PER_STEP = 7, 20.0  # so many steps are looked at, by a clock on which each takes so long


class FakeLearner:
    """Takes an avatar's place in the avatar's own `fit`: learns one number, and notes what the loop does and when."""

    def __init__(self) -> None:
        self.module = torch.nn.Linear(1, 1, bias=False)
        self.groups: list[dict[str, Any]] = [{"params": [self.module.weight], "lr": 1.0}]
        self.step = 0
        self.rates: list[float] = []
        self.shown: list[Batch] = []
        self.written: list[tuple[int, str]] = []
        self.outcome: TrainingOutcome
        self.images: TrainingImages
        self.config: TrainingConfig
        self.before_start: Callable[[], None]

    def trainer(self, learner: Any, config: TrainingConfig, images: TrainingImages, **options: Any) -> Any:
        """In place of `Trainer`; what comes before the first step is left to who wants it."""
        self.config, self.images = config, images
        trainer = Trainer(self, config, images, **options)

        def fit(before_start: Callable[[], None]) -> TrainingOutcome:
            self.before_start = before_start
            self.outcome = trainer.fit()
            return self.outcome

        return SimpleNamespace(fit=fit)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return self.groups

    def loss(self, batches: Sequence[Batch], step: int) -> Tensor:
        self.step = step
        self.rates.append(self.groups[0]["lr"])
        return self.module.weight.mean()

    def render_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Tensor:
        return self.module.weight.reshape(()).expand(len(cameras), cameras[0].height, cameras[0].width, 3)

    def clock(self) -> float:
        return SECONDS_PER_STEP * self.step

    def draw_step(self, *arguments: Any) -> list[Batch]:
        batches = draw_step(*arguments)
        if self.step < STEPS:
            self.shown += batches
        return batches

    def write(self, path: Path, content: bytes) -> None:
        if self.step < STEPS:
            self.written.append((self.step, path.name))
