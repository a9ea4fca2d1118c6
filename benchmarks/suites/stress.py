"""The stress axes: what can go wrong with a capture, each with a scale of severities from zero."""

from collections.abc import Callable
from dataclasses import dataclass

from ash.capture.dataset import Capture
from ash.fields import suggest
from ash.files import InputError
from synth.perturbation.perturb import Perturbation


@dataclass(frozen=True, kw_only=True, slots=True)
class StressAxis:
    """One defect of a capture, by a severity in `unit`."""

    title: str
    unit: str
    perturbation: Callable[[Capture, float], Perturbation]


FOOTAGE_FRAMES = 320  # Training frames of size `long`, whose motion the axis `footage` cuts short.


def _left(count: int, missing_percent: float) -> int:
    return max(1, round(count * (1 - missing_percent / 100)))


AXES = {
    "cameras": StressAxis(
        title="training cameras missing",
        unit="%",
        perturbation=lambda capture, s: Perturbation(cameras=_left(len(capture.splits["train"].cameras), s)),
    ),
    "frames": StressAxis(
        title="training frames missing",
        unit="%",
        perturbation=lambda capture, s: Perturbation(frames=_left(len(capture.splits["train"].frames), s)),
    ),
    "footage": StressAxis(
        title="end of the training motion missing",
        unit="frames",
        perturbation=lambda capture, s: Perturbation(first_frames=len(capture.splits["train"].frames) - round(s)),
    ),
    "tracking": StressAxis(
        title="wrong joint angles",
        unit="deg",
        perturbation=lambda _, s: Perturbation(tracking_deg=s),
    ),
    "root": StressAxis(
        title="wrong root position",
        unit="mm",
        perturbation=lambda _, s: Perturbation(tracking_mm=s),
    ),
    "calibration": StressAxis(
        title="wrong calibration",
        unit="px",
        perturbation=lambda _, s: Perturbation(calibration_px=s),
    ),
    "lens": StressAxis(
        title="lens distortion that the calibration lacks",
        unit="px",
        perturbation=lambda _, s: Perturbation(lens_px=s),
    ),
    "mask_grown": StressAxis(
        title="masks too large",
        unit="px",
        perturbation=lambda _, s: Perturbation(mask_px=round(s)),
    ),
    "mask_shrunk": StressAxis(
        title="masks too small",
        unit="px",
        perturbation=lambda _, s: Perturbation(mask_px=-round(s)),
    ),
    "exposure": StressAxis(
        title="exposure drift between cameras",
        unit="stops",
        perturbation=lambda _, s: Perturbation(exposure_stops=s),
    ),
    "noise": StressAxis(
        title="more noise in the training images",
        unit="dB",
        perturbation=lambda _, s: Perturbation(noise_factor=10 ** (s / 10)),
    ),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Stress:
    """A step of an axis; severity zero is the clean capture and has no `Stress`."""

    axis: str
    severity: float

    def __post_init__(self) -> None:
        if self.axis not in AXES:
            raise InputError(f"unknown stress axis {self.axis!r}, {suggest(self.axis, tuple(AXES))}")
        if not 0 < self.severity < float("inf"):
            raise InputError(f"stress {self.axis}: expected a severity above zero, got {self.severity}")

    @property
    def title(self) -> str:
        """For progress lines and tables."""
        return f"{AXES[self.axis].title} {self.severity:g} {AXES[self.axis].unit}"

    def perturbation(self, capture: Capture) -> Perturbation:
        """What it does to a capture."""
        return AXES[self.axis].perturbation(capture, self.severity)
