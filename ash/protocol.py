"""What the suite asks of a method, ours or anyone's."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, runtime_checkable

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


@runtime_checkable
class Avatar(Protocol):
    """An animatable avatar: learns from a capture, then renders any motion from any camera.

    A factory `make(capture: Capture, *, seed: int, preset: str) -> Avatar` is registered under the entry-point group
    `ash_bench.methods`. A preset is a budget: every method knows at least `ci` (seconds), `brief` (half a minute) and
    `cpu` (minutes), and raises ValueError for one it does not know. The capture handed to the factory and to `fit`
    holds training views and training motion only, unless the suite lists the method among its oracles. A training that
    diverged raises FloatingPointError. `log.jsonl` holds one object per line; `seconds` with `train_psnr` (dB,
    foreground, of a few training views that the method kept from itself) or `loss` make the training curve of the
    report.
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


@runtime_checkable
class PosedGeometry(Protocol):
    """What an avatar may offer besides, so that its geometry can be compared with the truth."""

    def template_vertices(self, motion: Motion, frame: int) -> np.ndarray:
        """The posed template in frame `frame` of `motion`, float `[v, 3]` metres, vertices ordered as the capture's.

        `[0, 3]` where they are others than the capture's.
        """

    def gaussian_means(self, motion: Motion, frame: int) -> np.ndarray:
        """Centres of the posed Gaussians, float `[n, 3]` metres; `[0, 3]` for a method without any."""


@runtime_checkable
class LearnsTemplate(Protocol):
    """What an avatar may offer besides whose template is learned before it, in a job that methods share."""

    def template_seconds(self) -> float | None:
        """What the job took when it was done; None where the template was not learned."""


@runtime_checkable
class Drawn(Protocol):
    """Whatever draws frames: an avatar, or its display."""

    def render(self, motion: Motion, frame: int, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """As `Avatar.render`."""


@runtime_checkable
class Display(Drawn, Protocol):
    """Draws an avatar as it would be shown, which may be another way than the one it was trained with."""

    def close(self) -> None:
        """Free what the display holds."""


@runtime_checkable
class Displayed(Protocol):
    """What an avatar may offer besides: a display of its own, whose speed `ash-bench display` measures."""

    def open_display(self) -> Display:
        """Open the display, or raise an InputError that says what is missing on this machine."""
