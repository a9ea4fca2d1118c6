"""What the suite asks of a method, ours or anyone's."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from ash.capture.dataset import Camera, Capture, Pose

if TYPE_CHECKING:  # torch takes more than a second, and the harness needs none of it.
    from ash.gaussians.gaussians import Gaussians

# Raw parameters and texture values alike are visible from a hundredth on; dead decoders differ by nothing at all.
NO_CORRECTION = 1e-3


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


@dataclass(frozen=True, kw_only=True, slots=True)
class DressedMesh:
    """A textured mesh in one frame, as any viewer can show it."""

    vertices: np.ndarray  # [v, 3] float32, metres, world
    normals: np.ndarray  # [v, 3] float32, unit, world
    faces: np.ndarray  # [f, 3] int64 into vertices
    uvs: np.ndarray  # [u, 2] float32, u to the right, v up
    uv_faces: np.ndarray  # [f, 3] int64 into uvs
    texture: np.ndarray  # [t, t, 3] uint8 sRGB, first row at v = 1


@runtime_checkable
class Avatar(Protocol):
    """An animatable avatar: learns from a capture, then renders any motion from any camera.

    A factory `make(capture: Capture, *, seed: int, preset: str) -> Avatar` is registered under the entry-point group
    `ash_bench.methods`. A preset is a budget: every method knows at least `ci` (seconds), `brief` (half a minute) and
    `cpu` (minutes), and raises ValueError for one it does not know. The capture handed to the factory and to `fit`
    holds training views and training motion only, unless the suite lists the method among its oracles. A training that
    diverged raises FloatingPointError. `log.jsonl` holds one object per line; `seconds` with `train_psnr` (dB,
    foreground, of a few training views that the method kept from itself) or `loss` make the training curve of the
    report. Files `snapshots/SECONDS.safetensors` in the folder of `fit`, which `load` reads, make its chart of accuracy
    against training seconds.
    """

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Learn. Checkpoints and `log.jsonl` go to `folder`; called again there, it resumes to the same result."""

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
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
class Configurable(Protocol):
    """What a factory may offer besides: a configuration, each field of which is a flag and a key of a suite's file.

    `factory.config(preset)` is a frozen dataclass, of dataclasses if need be, that checks itself in `__post_init__`;
    the comments beside its fields are their documentation. Called with the keyword `config`, the factory takes that in
    place of what the preset says. The seed stays an argument of its own: it overrules a field `seed`.
    """

    config: Callable[[str], Any]

    def __call__(self, capture: Capture, *, seed: int, preset: str, config: Any = None) -> Avatar:
        """Make the avatar, untrained."""


@runtime_checkable
class PosedGeometry(Protocol):
    """What an avatar may offer besides, so that its geometry can be compared with the truth."""

    def template_vertices(self, pose: Pose) -> np.ndarray:
        """The posed template in frame `frame` of `motion`, float `[v, 3]` metres, vertices ordered as the capture's.

        `[0, 3]` where they are others than the capture's.
        """

    def gaussian_means(self, pose: Pose) -> np.ndarray:
        """Centres of the posed Gaussians, float `[n, 3]` metres; `[0, 3]` for a method without any."""


@runtime_checkable
class PosesGaussians(Protocol):
    """What an avatar made of Gaussians may offer besides, so that it can be played from any side and exported."""

    dilation: float  # px^2 that its pictures add to both axes of every projected Gaussian

    def gaussians(self, pose: Pose) -> "Gaussians":
        """The posed Gaussians in frame `frame` of `motion`: world, metres, colours as seen from anywhere.

        On any device.
        """


@runtime_checkable
class DressesMesh(Protocol):
    """What an avatar made of a textured mesh may offer besides, so that it can be exported."""

    def dressed_mesh(self, pose: Pose) -> DressedMesh:
        """The posed mesh in frame `frame` of `motion`, with the texture of that frame."""


@runtime_checkable
class LearnsTemplate(Protocol):
    """What an avatar may offer besides whose template is learned before it, in a job that methods share."""

    def template_seconds(self) -> float | None:
        """What the job took when it was done; None where the template was not learned."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingOutcome:
    """How a training ended. Scores are foreground PSNR, dB, of training views that no step saw."""

    steps: int
    seconds: float  # CPU time
    ended_by: str  # "steps", "seconds": a limit was met; "plateau": the last third had gained less than 0.1 dB by then
    gained: float | None = None  # over the last third of the steps, dB; None: too short to tell
    reserved_psnr: float | None = None  # at the end; None: the capture is too small to reserve views
    template: str = ""  # what the template was learned from, and what that settled on; empty where it was not learned
    correction_spread: float | None = None  # of what decoders add, between frames, rms; None: there are no decoders
    cameras: int = 0  # that training saw; 0: unknown
    frames: int = 0
    precision: str = "float32"  # in which the decoders learned, whatever was wished for

    @property
    def carries_nothing(self) -> bool:
        """Whether there are decoders whose output is the same in every frame: the avatar is then a static one."""
        return self.correction_spread is not None and self.correction_spread < NO_CORRECTION


@runtime_checkable
class TellsOutcome(Protocol):
    """What an avatar may offer besides that knows how its training ended."""

    def outcome(self) -> TrainingOutcome | None:
        """How `fit` ended; None before it did."""


@runtime_checkable
class Drawn(Protocol):
    """Whatever draws frames: an avatar, or its display."""

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
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
