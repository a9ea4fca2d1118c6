"""Where methods fail: accuracy against severity, breakdown points, failure rates, spread over seeds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.cells import CellResult
from benchmarks.names import look_of
from benchmarks.statistics import Interval, mean_interval, wilson
from benchmarks.stress import AXES

TRIVIAL = "nearest"  # the training image of the nearest pose and camera: below half the way to it, a method is broken


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """A method at one severity: foreground PSNR over seeds (failed cells count with the worst score), and failures."""

    severity: float
    quality: Interval
    failures: int
    cells: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Course:
    """A method along one axis, from severity zero on."""

    method: str
    steps: tuple[Step, ...]
    midpoint: float | None  # half way from the clean score to the trivial baseline's; None: no baseline was run

    @property
    def title(self) -> str:
        """The method, for readers."""
        return look_of(self.method).title

    @property
    def breakdown(self) -> float | None:
        """The least severity whose upper confidence bound lies below the midpoint; None: it never does.

        A single seed has no bound: its score counts as one.
        """
        if self.midpoint is None:
            return None
        broken = [s.severity for s in self.steps[1:] if _upper(s.quality) < self.midpoint]
        return min(broken, default=None)

    @property
    def loss(self) -> float:
        """Decibels lost from the clean capture to the worst severity."""
        return self.steps[0].quality.mean - min(step.quality.mean for step in self.steps[1:])


@dataclass(frozen=True, kw_only=True, slots=True)
class Curve:
    """All methods along one axis on one scene and split."""

    scene: str
    split: str
    axis: str
    courses: tuple[Course, ...]
    trivial: float | None

    @property
    def title(self) -> str:
        """The axis, for readers."""
        return f"{AXES[self.axis].title} [{AXES[self.axis].unit}]"


@dataclass(frozen=True, kw_only=True, slots=True)
class Reliability:
    """How often a method came through, over all severities, and how far its seeds lie apart on the clean capture."""

    method: str
    cells: int
    failures: int
    diverged: int
    rate: tuple[float, float]  # Wilson's interval of the failure rate
    spread_db: float | None  # standard deviation over seeds, held-out views

    @property
    def title(self) -> str:
        """The method, for readers."""
        return look_of(self.method).title


def curves(results: Sequence[CellResult]) -> tuple[Curve, ...]:
    """A curve per scene, axis and split, for all axes that the results hold."""
    found = []
    for scene in dict.fromkeys(result.config.scene for result in results if result.config.axis):
        here = [result for result in results if result.config.scene == scene]
        for axis in [name for name in AXES if any(result.config.axis == name for result in here)]:
            found += [_curve(here, scene, axis, split) for split in ("novel_view", "novel_pose")]
    return tuple(found)


def reliability(results: Sequence[CellResult]) -> tuple[Reliability, ...]:
    """Per method, over all of the given results."""
    found = []
    for method in dict.fromkeys(result.config.method for result in results):
        own = [result for result in results if result.config.method == method]
        failures = sum(result.status != "done" for result in own)
        clean = [_quality(result, "novel_view") for result in own if not result.config.axis and result.status == "done"]
        found.append(
            Reliability(
                method=method,
                cells=len(own),
                failures=failures,
                diverged=sum(result.status == "diverged" for result in own),
                rate=wilson(failures, len(own)),
                spread_db=float(np.std(clean, ddof=1)) if len(clean) > 1 else None,
            )
        )
    return tuple(found)


def _curve(results: Sequence[CellResult], scene: str, axis: str, split: str) -> Curve:
    trivial = [_quality(r, split) for r in results if r.config.method == TRIVIAL and not r.config.axis]
    floor = float(np.mean(trivial)) if trivial else None
    courses = []
    for method in dict.fromkeys(result.config.method for result in results):
        own = [r for r in results if r.config.method == method and r.config.axis in ("", axis)]
        severities = sorted({r.config.severity for r in own})
        steps = tuple(
            _step([r for r in own if r.config.severity == severity], severity, split) for severity in severities
        )
        if len(steps) > 1 and severities[0] == 0:
            midpoint = None if floor is None or method == TRIVIAL else (steps[0].quality.mean + floor) / 2
            courses.append(Course(method=method, steps=steps, midpoint=midpoint))
    return Curve(scene=scene, split=split, axis=axis, courses=tuple(courses), trivial=floor)


def _step(results: Sequence[CellResult], severity: float, split: str) -> Step:
    quality = mean_interval([_quality(result, split) for result in results])
    failures = sum(result.status != "done" for result in results)
    return Step(severity=severity, quality=quality, failures=failures, cells=len(results))


def _quality(result: CellResult, split: str) -> float:
    value = result.value(split, "foreground", "psnr")
    return float("nan") if value is None else value


def _upper(quality: Interval) -> float:
    return quality.mean if quality.high is None else quality.high
