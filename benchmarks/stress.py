"""The stress axes: what can go wrong with a capture, each with a scale of severities that starts at zero."""

from collections.abc import Callable
from dataclasses import dataclass

from ash.dataset import Capture
from ash.files import InputError
from synth.perturb import Perturbation


@dataclass(frozen=True, kw_only=True, slots=True)
class Axis:
    """One way to spoil a capture. `severities` are the steps that the suite takes after zero, in `unit`."""

    title: str
    unit: str
    severities: tuple[float, ...]
    perturbation: Callable[[Capture, float], Perturbation]


def _left(count: int, missing_percent: float) -> int:
    return max(1, round(count * (1 - missing_percent / 100)))


AXES = {
    "cameras": Axis(
        title="training cameras missing",
        unit="%",
        severities=(25.0, 50.0, 75.0),
        perturbation=lambda capture, s: Perturbation(cameras=_left(len(capture.splits["train"].cameras), s)),
    ),
    "frames": Axis(
        title="training frames missing",
        unit="%",
        severities=(50.0, 80.0, 95.0),
        perturbation=lambda capture, s: Perturbation(frames=_left(len(capture.splits["train"].frames), s)),
    ),
    "tracking": Axis(
        title="wrong joint angles",
        unit="deg",
        severities=(1.0, 3.0, 10.0),
        perturbation=lambda _, s: Perturbation(tracking_deg=s),
    ),
    "root": Axis(
        title="wrong root position",
        unit="mm",
        severities=(5.0, 15.0, 50.0),
        perturbation=lambda _, s: Perturbation(tracking_mm=s),
    ),
    "calibration": Axis(
        title="wrong calibration",
        unit="px",
        severities=(0.5, 2.0, 8.0),
        perturbation=lambda _, s: Perturbation(calibration_px=s),
    ),
    "mask_grown": Axis(
        title="masks too large",
        unit="px",
        severities=(1.0, 3.0, 8.0),
        perturbation=lambda _, s: Perturbation(mask_px=round(s)),
    ),
    "mask_shrunk": Axis(
        title="masks too small",
        unit="px",
        severities=(1.0, 2.0, 4.0),
        perturbation=lambda _, s: Perturbation(mask_px=-round(s)),
    ),
    "exposure": Axis(
        title="exposure drift between cameras",
        unit="stops",
        severities=(0.1, 0.3, 1.0),
        perturbation=lambda _, s: Perturbation(exposure_stops=s),
    ),
    "noise": Axis(
        title="more noise in the training images",
        unit="dB",
        severities=(6.0, 12.0, 24.0),
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
            raise InputError(f"unknown stress axis {self.axis!r}, expected one of {', '.join(AXES)}")
        if not 0 < self.severity < float("inf"):
            raise InputError(f"stress {self.axis}: expected a severity above zero, got {self.severity}")

    @property
    def title(self) -> str:
        """For progress lines and tables."""
        return f"{AXES[self.axis].title} {self.severity:g} {AXES[self.axis].unit}"

    def perturbation(self, capture: Capture) -> Perturbation:
        """What it does to a capture."""
        return AXES[self.axis].perturbation(capture, self.severity)


ALL_STRESSES = tuple(Stress(axis=name, severity=s) for name, axis in AXES.items() for s in axis.severities)
