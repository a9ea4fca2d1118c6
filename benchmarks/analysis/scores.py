"""The results of a run as tidy tables, and what is asked of them: a quantity of a method on a scene, with its spread.

`tidy` makes the one table that everything is computed from, a row per number, in the columns of results.csv. `Scores`
groups it: first by capture and seed, then over those, and answers look-ups.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from ash.files import InputError
from benchmarks.analysis.statistics import independent, mean_interval
from benchmarks.analysis.style import is_ours
from benchmarks.cell.cells import CellConfig, CellResult
from benchmarks.cell.metrics import METRICS
from benchmarks.suites.suites import capture_name
from synth.person.cast import VALIDATION

COLUMNS = (
    "scene",
    "method",
    "seed",
    "split",
    "region",
    "metric",
    "value",
    "unit",
    "direction",
    "protocol",
    "subject",
    "capture",
)
KEYS = ["scene", "method", "split", "region", "metric"]
PLACE = re.compile(r"(?P<scene>\S+)(?: (?P<axis>\w+)=(?P<severity>\S+))?")  # `CellConfig.place`, taken apart


class Quantity(NamedTuple):
    """Where a number stands in the results."""

    split: str
    region: str
    metric: str


RANKED_SPLITS = ("novel_view", "novel_pose")
MOTION_SPLITS = ("near_pose", "novel_pose", "far_pose")  # held-out motion, nearest first
HELD_OUT_SPLITS = ("novel_view", *MOTION_SPLITS)
FRAME_MS = Quantity("speed", "", "frame_ms")


def foreground(split: str = "novel_view", metric: str = "psnr") -> Quantity:
    """A quality on the foreground; PSNR in dB is the number to look at."""
    return Quantity(split, "foreground", metric)


def tidy(results: Sequence[CellResult], captures: Mapping[str, str] | None = None) -> pd.DataFrame:
    """One row per number of every cell: `COLUMNS`, then `axis`, `severity` and `status` of the cell.

    `captures`: the capture's folder name by the cell's key; the name that suites give it where it is not told.
    """
    rows = [
        {
            "scene": config.place,
            "method": config.method,
            "seed": config.seed,
            "split": row.split,
            "region": row.region,
            "metric": row.metric,
            "value": row.value,
            "unit": METRICS[row.metric].unit,
            "direction": METRICS[row.metric].direction,
            "protocol": config.protocol,
            "subject": config.subject,
            "capture": (captures or {}).get(config.key, _capture_name(config)),
            "axis": config.axis,
            "severity": config.severity,
            "status": result.status,
        }
        for result in results
        for config in (result.config,)
        for row in result.summary
    ]
    return pd.DataFrame(rows, columns=[*COLUMNS, "axis", "severity", "status"])


def _capture_name(config: CellConfig) -> str:
    return capture_name(config.scene, config.size, config.capture_seed, config.subject)


def csv_of(table: pd.DataFrame) -> str:
    """`results.csv`: numbers in full, so that nothing is lost on the way to another tool."""
    return table.to_csv(index=False, columns=list(COLUMNS), lineterminator="\n")


def read_csv(path: Path) -> pd.DataFrame:
    """The table back from `results.csv`; how a cell failed is not in it, only that it did.

    Raises:
        InputError: a column is missing.
    """
    table = pd.read_csv(path, keep_default_na=False, dtype={"protocol": str})
    if missing := set(COLUMNS[:10]) - set(table.columns):
        raise InputError(f"{path}: expected the columns of results.csv, {', '.join(sorted(missing))} missing")
    known = {"subject": 0, "capture": table["scene"].str.split(" ").str[0]}
    table = table.assign(**{name: value for name, value in known.items() if name not in table})
    place = table["scene"].str.extract(PLACE)
    table["axis"], table["severity"] = place["axis"].fillna(""), pd.to_numeric(place["severity"]).fillna(0.0)
    failed = table.groupby(["scene", "method", "seed", "capture"])["metric"].transform(
        lambda names: "failed" in set(names)
    )
    return table.assign(status=failed.map({True: "crashed", False: "done"}))


def images_of(results: Sequence[CellResult]) -> pd.DataFrame:
    """One row per scored image of unspoilt captures: its cell, `split`, `camera`, `frame`, foreground scores, and
    `novelty_deg` of its pose where the result tells it.
    """
    rows = [
        {
            "scene": result.config.scene,
            "method": result.config.method,
            "seed": result.config.seed,
            "capture": result.config.capture,
            "split": view.split,
            "camera": view.camera,
            "frame": view.frame,
            **{metric: value for (region, metric), value in view.scores.items() if region in ("foreground", "")},
        }
        for result in results
        if not result.config.axis
        for view in result.views
    ]
    columns = ["scene", "method", "seed", "capture", "split", "camera", "frame", "psnr", "novelty_deg"]
    found = pd.DataFrame(rows, columns=None if rows else columns)
    return found if "novelty_deg" in found else found.assign(novelty_deg=math.nan)


def curves_of(results: Sequence[CellResult]) -> pd.DataFrame:
    """One row per point of the training logs that has a PSNR: its cell, `seconds` of training, `psnr` in dB."""
    rows = [
        (
            result.config.scene,
            result.config.method,
            result.config.capture,
            result.config.seed,
            point.seconds,
            point.psnr,
        )
        for result in results
        if not result.config.axis
        for point in result.curve
        if point.psnr is not None and point.seconds > 0
    ]
    return pd.DataFrame(rows, columns=["scene", "method", "capture", "seed", "seconds", "psnr"])


def outcomes_of(results: Sequence[CellResult]) -> pd.DataFrame:
    """One row per cell that tells how its training ended: `scene`, `method`, whether it `finished` learning, whether
    its decoders carry nothing (are `dead`), and what its `template` was learned from.
    """
    rows = [
        (
            result.config.scene,
            result.config.method,
            end.ended_by == "plateau",
            end.carries_nothing,
            end.template or "",
        )
        for result in results
        if not result.config.axis and (end := result.training) is not None
    ]
    return pd.DataFrame(rows, columns=["scene", "method", "finished", "dead", "template"])


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """Mean over seeds (over captures, where a scene has several), least and greatest value, and how many.

    `half_width` is that of the 95 % interval of the mean: None for a single value.
    """

    mean: float
    half_width: float | None
    least: float
    greatest: float
    seeds: int


class Scores:
    """The tidy table of a run, grouped."""

    def __init__(
        self, rows: pd.DataFrame, images: pd.DataFrame | None = None, outcomes: pd.DataFrame | None = None
    ) -> None:
        self.rows = rows
        self.images = images_of(()) if images is None else images
        self.outcomes = outcomes_of(()) if outcomes is None else outcomes
        self.clean = rows[rows["axis"] == ""]  # Spoilt captures: stability.py.
        self.scenes = tuple(self.clean["scene"].unique())
        self.seeds = int(self.clean["seed"].nunique())

    @cached_property
    def _cells(self) -> dict[str, dict[str, list[str]]]:
        """How the cells of each scene and method ended."""
        cells = self.clean.drop_duplicates(["scene", "method", "seed", "capture"])
        found: dict[str, dict[str, list[str]]] = {}
        for scene, method, status in zip(cells["scene"], cells["method"], cells["status"], strict=True):
            found.setdefault(scene, {}).setdefault(method, []).append(status)
        return found

    @cached_property
    def _captures(self) -> dict[str, int]:
        return {str(scene): int(count) for scene, count in self.clean.groupby("scene")["capture"].nunique().items()}

    @cached_property
    def _samples(self) -> dict[tuple[str, ...], dict[str, list[float]]]:
        found: dict[tuple[str, ...], dict[str, list[float]]] = {}
        for key, values in self.clean.groupby([*KEYS, "capture"], sort=False)["value"].agg(list).items():
            found.setdefault(key[:-1], {})[key[-1]] = values
        return found

    @cached_property
    def _scores(self) -> dict[tuple[str, ...], Score]:
        return {key: _score(self.values(key[0], key[1], Quantity(*key[2:]))) for key in self._samples}

    def methods(self, scene: str) -> tuple[str, ...]:
        """Methods on a scene: the user's own first, then ours in the suite's order."""
        return tuple(sorted(self._cells.get(scene, ()), key=is_ours))

    def cells(self, scene: str, method: str) -> int:
        """How many cells a method has on a scene."""
        return len(self._cells.get(scene, {}).get(method, ()))

    def captures(self, scene: str) -> int:
        """How many captures a scene has."""
        return self._captures.get(scene, 0)

    def for_choosing(self, scene: str) -> bool:
        """Whether the people of a scene are those for validation and tuning."""
        return bool((self.clean.loc[self.clean["scene"] == scene, "subject"] >= VALIDATION).any())

    def unit(self, scene: str) -> str:
        """What intervals of a scene are taken over."""
        return "captures" if self.captures(scene) > 1 else "seeds"

    def repeated(self, scene: str) -> bool:
        """Whether a scene has what intervals need: several captures or several seeds."""
        return self.captures(scene) > 1 or self.seeds > 1

    def failed(self, scene: str, method: str) -> int:
        """How many cells of a method on a scene failed."""
        return sum(status != "done" for status in self._cells.get(scene, {}).get(method, ()))

    def samples(self, scene: str, method: str, quantity: Quantity) -> dict[str, list[float]]:
        """The quantity for each seed, by capture."""
        return self._samples.get((scene, method, *quantity), {})

    def values(self, scene: str, method: str, quantity: Quantity) -> list[float]:
        """What the quantity's spread is taken over: its seeds, or where the scene has several captures, their means."""
        return independent(self.samples(scene, method, quantity))

    def get(self, scene: str, method: str, quantity: Quantity) -> Score | None:
        """The quantity with its spread, or None where no cell has it."""
        return self._scores.get((scene, method, *quantity))

    def whole(self, scene: str, *methods: str) -> bool:
        """Whether all of the methods were run on the scene and none of their cells failed."""
        return all(method in self.methods(scene) and not self.failed(scene, method) for method in methods)

    def per_image(self, scene: str, method: str, split: str) -> pd.DataFrame:
        """Foreground PSNR in dB: a row per seed, a column per image."""
        mine = self.images.query("scene == @scene and method == @method and split == @split")
        return mine.pivot_table("psnr", ["capture", "seed"], ["camera", "frame"], sort=False)


def scores_of(results: Sequence[CellResult], captures: Mapping[str, str] | None = None) -> Scores:
    """The tables of a run's results, grouped."""
    return Scores(tidy(results, captures), images_of(results), outcomes_of(results))


def _score(values: Sequence[float]) -> Score:
    interval = mean_interval(values)
    half_width = None if interval.high is None else interval.high - interval.mean
    return Score(mean=interval.mean, half_width=half_width, least=min(values), greatest=max(values), seeds=len(values))
