"""Where methods fail: accuracy against severity, breakdown points, failure rates, spread over seeds."""

from dataclasses import dataclass
from itertools import product
from math import isnan

import pandas as pd

from benchmarks.analysis.data_scaling import AXIS as FOOTAGE
from benchmarks.analysis.scores import RANKED_SPLITS, Scores
from benchmarks.analysis.statistics import Interval, independent, mean_interval, wilson
from benchmarks.analysis.style import style_of
from benchmarks.suites.stress import AXES

TRIVIAL = "nearest"  # the training image of the nearest pose and camera: below half the way to it, a method is broken


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """A method at one severity: foreground PSNR (failed cells count with the worst score), and failures."""

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
        return style_of(self.method).title

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
    spread_db: float | None  # standard deviation over the seeds of a capture, held-out views

    @property
    def title(self) -> str:
        """The method, for readers."""
        return style_of(self.method).title


def curves(scores: Scores) -> tuple[Curve, ...]:
    """A curve per scene, axis and split, for all axes that the results hold; less footage spoils nothing."""
    found = []
    psnr = scores.rows.query("region == 'foreground' and metric == 'psnr'").assign(scene=_scene)
    stressed = psnr.loc[psnr["axis"] != "", ["scene", "axis"]].drop_duplicates()
    for scene in stressed["scene"].unique():
        axes = set(stressed.loc[stressed["scene"] == scene, "axis"]) - {FOOTAGE}
        for axis, split in product([name for name in AXES if name in axes], RANKED_SPLITS):
            here = psnr.query("scene == @scene and split == @split and axis in ('', @axis)")
            found.append(_curve(here, scene, axis, split))
    return tuple(found)


def reliability(scores: Scores, scene: str) -> tuple[Reliability, ...]:
    """Per method, over all severities on a scene."""
    here = scores.rows.assign(scene=_scene).query("scene == @scene")
    found = []
    for method, rows in here.groupby("method", sort=False):
        status = rows.drop_duplicates(["seed", "axis", "severity", "capture"])["status"]
        failures = int((status != "done").sum())
        good = rows.query("axis == '' and status == 'done' and region == 'foreground' and metric == 'psnr'")
        spread = good.query("split == 'novel_view'").groupby("capture")["value"].var().mean() ** 0.5
        found.append(
            Reliability(
                method=str(method),
                cells=len(status),
                failures=failures,
                diverged=int((status == "diverged").sum()),
                rate=wilson(failures, len(status)),
                spread_db=None if isnan(spread) else float(spread),
            )
        )
    return tuple(found)


def _scene(rows: pd.DataFrame) -> pd.Series:
    """The scene without how its capture was spoilt."""
    return rows["scene"].str.split(" ").str[0]


def _curve(rows: pd.DataFrame, scene: str, axis: str, split: str) -> Curve:
    trivial = rows.query("method == @TRIVIAL and axis == ''")["value"]
    floor = None if trivial.empty else float(trivial.mean())
    courses = []
    for method, own in rows.groupby("method", sort=False):
        steps = tuple(_step(float(severity), at) for severity, at in own.groupby("severity"))
        if len(steps) > 1 and steps[0].severity == 0:
            midpoint = None if floor is None or method == TRIVIAL else (steps[0].quality.mean + floor) / 2
            courses.append(Course(method=str(method), steps=steps, midpoint=midpoint))
    return Curve(scene=scene, split=split, axis=axis, courses=tuple(courses), trivial=floor)


def _step(severity: float, rows: pd.DataFrame) -> Step:
    failures = int((rows["status"] != "done").sum())
    return Step(
        severity=severity,
        quality=mean_interval(independent(rows.groupby("capture")["value"].agg(list).to_dict())),
        failures=failures,
        cells=len(rows),
    )


def _upper(quality: Interval) -> float:
    return quality.mean if quality.high is None else quality.high
