"""What the suite asks of a method, ours or anyone's."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from ash.dataset import Camera, Capture, Motion


class StageClock:
    """Collects the milliseconds that each named stage of one rendered frame took."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = defaultdict(float)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body and add it to the stage `name` (`stg1` .. `stg4`)."""
        start = time.perf_counter()
        yield
        self.ms[name] += (time.perf_counter() - start) * 1e3


class Avatar(Protocol):
    """An animatable avatar: learns from a capture, then renders any motion from any camera.

    A factory `make(capture: Capture, *, seed: int) -> Avatar` is registered under the entry-point group
    `ash_bench.methods`. The capture handed to the factory and to `fit` holds training views and training motion only.
    """

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Learn. Checkpoints and `log.jsonl` go to `folder`; called again there, it resumes to the same result."""

    def render(self, motion: Motion, frame: int, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """The avatar in frame `frame` of `motion`, float32 `[h, w, 4]`: colour premultiplied by alpha, sRGB in 0..1."""

    def parameter_count(self) -> int:
        """Numbers that training may change."""

    def gaussian_count(self) -> int:
        """Gaussians drawn per frame; 0 for a method without any."""

    def save(self, path: Path) -> None:
        """Write everything that `load` needs besides the capture, as safetensors."""

    def load(self, path: Path) -> None:
        """Read what `save` wrote."""
