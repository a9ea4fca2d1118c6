"""The stress axes: what can go wrong with a capture, each with a scale of severities from zero."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from ash.capture.dataset import Capture
from ash.fields import suggest
from ash.files import InputError
from synth.perturbation.perturb import Perturbation

TRIVIAL = "nearest"  # Shows the training image of the nearest pose and camera; judges others by its clean score.
FOOTAGE_FRAMES = 320  # Training frames of size `long`, whose motion the axis `footage` cuts short.


class StressAxis(NamedTuple):
    """One defect of a capture, by a severity in `unit`."""

    title: str
    unit: str
    perturbation: Callable[[Capture, float], Perturbation]


def _fewer_cameras(capture: Capture, missing_percent: float) -> Perturbation:
    return Perturbation(cameras=_left(len(capture.splits["train"].cameras), missing_percent))


def _fewer_frames(capture: Capture, missing_percent: float) -> Perturbation:
    return Perturbation(frames=_left(len(capture.splits["train"].frames), missing_percent))


def _shorter_motion(capture: Capture, missing_frames: float) -> Perturbation:
    return Perturbation(first_frames=len(capture.splits["train"].frames) - round(missing_frames))


def _left(count: int, missing_percent: float) -> int:
    return max(1, round(count * (1 - missing_percent / 100)))


AXES = {
    "cameras": StressAxis("training cameras missing", "%", _fewer_cameras),
    "frames": StressAxis("training frames missing", "%", _fewer_frames),
    "footage": StressAxis("end of the training motion missing", "frames", _shorter_motion),
    "tracking": StressAxis("wrong joint angles", "deg", lambda _, s: Perturbation(tracking_deg=s)),
    "root": StressAxis("wrong root position", "mm", lambda _, s: Perturbation(tracking_mm=s)),
    "calibration": StressAxis("wrong calibration", "px", lambda _, s: Perturbation(calibration_px=s)),
    "lens": StressAxis("lens distortion that the calibration lacks", "px", lambda _, s: Perturbation(lens_px=s)),
    "mask_grown": StressAxis("masks too large", "px", lambda _, s: Perturbation(mask_px=round(s))),
    "mask_shrunk": StressAxis("masks too small", "px", lambda _, s: Perturbation(mask_px=-round(s))),
    "exposure": StressAxis("exposure drift between cameras", "stops", lambda _, s: Perturbation(exposure_stops=s)),
    "noise": StressAxis(
        "more noise in the training images", "dB", lambda _, s: Perturbation(noise_factor=10 ** (s / 10))
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

    def perturbation(self, capture: Capture) -> Perturbation:
        """What it does to a capture."""
        return AXES[self.axis].perturbation(capture, self.severity)
