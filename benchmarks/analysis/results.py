"""The results of a run as tables: `load` gives the one of results.csv, on which every analysis is computed.

A row is a number of a cell. What results.csv does not hold (scores of single images, training curves, how trainings
ended) has a table each.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ash.files import InputError
from benchmarks.analysis.statistics import Comparison, Samples, compare_samples, independent, mean_interval
from benchmarks.analysis.style import is_ours
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import CellConfig, CellResult
from benchmarks.suites.suites import capture_name
from synth.person.cast import VALIDATION

COLUMNS = (
    *("scene", "method", "seed", "split", "region", "metric", "value", "unit", "direction", "protocol"),
    *("subject", "capture"),
)
KEYS = ["scene", "method", "split", "region", "metric"]
CaptureNames = Mapping[str, str] | None  # of captures' folders by the cell's key; by default those that suites give
PLACE = re.compile(r"(?P<scene>\S+)(?: (?P<axis>\w+)=(?P<severity>\S+))?")  # `CellConfig.place`


class Quantity(NamedTuple):
    """Which number of a cell."""

    split: str
    region: str
    metric: str


RANKED_SPLITS = ("novel_view", "novel_pose")
MOTION_SPLITS = ("near_pose", "novel_pose", "far_pose")  # nearest to the training motion first
HELD_OUT_SPLITS = ("novel_view", *MOTION_SPLITS)
FRAME_MS = Quantity("speed", "", "frame_ms")
ONE_CORE = "one core"  # of the CPU, where times compare with those of other rows


def foreground(split: str = "novel_view", metric: str = "psnr") -> Quantity:
    """A quality on the foreground; by default PSNR in dB."""
    return Quantity(split, "foreground", metric)


def load(results: Sequence[CellResult], captures: CaptureNames = None) -> pd.DataFrame:
    """One row per number of every cell: `COLUMNS`, then `axis`, `severity` and `status` of the cell."""
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
            "capture": _capture_of(config, captures),
            "axis": config.axis,
            "severity": config.severity,
            "status": result.status,
        }
        for result in results
        for config in (result.config,)
        for row in result.summary
    ]
    return pd.DataFrame(rows, columns=[*COLUMNS, "axis", "severity", "status"])


def _capture_of(config: CellConfig, captures: CaptureNames) -> str:
    name = capture_name(config.scene, config.size, config.capture_seed, config.subject)
    return name if captures is None else captures.get(config.key, name)


def csv_of(table: pd.DataFrame) -> str:
    """`results.csv`, numbers in full."""
    return table.to_csv(index=False, columns=list(COLUMNS), lineterminator="\n")


def read_csv(path: Path) -> pd.DataFrame:
    """The table back from `results.csv`; it tells that a cell failed, not how.

    Raises:
        InputError: a column is missing.
    """
    table = pd.read_csv(path, keep_default_na=False, dtype={"protocol": str})
    if missing := set(COLUMNS[:10]) - set(table.columns):
        raise InputError(f"{path}: expected the columns of results.csv, {', '.join(sorted(missing))} missing")
    defaults = {"subject": 0, "capture": table["scene"].str.split(" ").str[0]}
    table = table.assign(**{name: value for name, value in defaults.items() if name not in table})
    place = table["scene"].str.extract(PLACE)
    table["axis"], table["severity"] = place["axis"].fillna(""), pd.to_numeric(place["severity"]).fillna(0.0)
    says_so = table["metric"].eq("failed") & table["value"].gt(0)
    failed = says_so.groupby([table[name] for name in ("scene", "method", "seed", "capture")]).transform("any")
    return table.assign(status=failed.map({True: "crashed", False: "done"}))


def load_images(results: Sequence[CellResult], captures: CaptureNames = None) -> pd.DataFrame:
    """One row per scored image: its cell, `split`, `camera`, `frame`, and foreground scores.

    `novelty_deg`: that of its pose, NaN where the result has none.
    """
    rows = [
        {
            **_cell(result, captures),
            "split": view.split,
            "camera": view.camera,
            "frame": view.frame,
            **{metric: value for (region, metric), value in view.scores.items() if region in ("foreground", "")},
        }
        for result in results
        for view in result.views
    ]
    columns = ["scene", "method", "capture", "seed", "split", "camera", "frame", "psnr"]
    table = pd.DataFrame(rows, columns=None if rows else columns)
    return table if "novelty_deg" in table else table.assign(novelty_deg=math.nan)


def load_curves(results: Sequence[CellResult], captures: CaptureNames = None) -> pd.DataFrame:
    """One row per point of the training logs that has a PSNR: its cell, `seconds` of training, `psnr` in dB."""
    rows = [
        {**_cell(result, captures), "seconds": point.seconds, "psnr": point.psnr}
        for result in results
        for point in result.curve
        if point.psnr is not None and point.seconds > 0
    ]
    return pd.DataFrame(rows, columns=["scene", "method", "capture", "seed", "seconds", "psnr"])


def load_snapshots(results: Sequence[CellResult], captures: CaptureNames = None) -> pd.DataFrame:
    """One row per snapshot and split of the trainings that left any, their ends included: cell, `seconds`, `psnr`."""
    rows = []
    for result in results:
        if result.status == "done" and result.snapshots:
            end = result.training.seconds if result.training else result.value("speed", "", "train_s")
            points = [(point.split, point.seconds, point.psnr) for point in result.snapshots]
            points += [(split, end, result.value(*foreground(split))) for split in HELD_OUT_SPLITS]
            named = (dict(zip(("split", "seconds", "psnr"), point, strict=True)) for point in points)
            rows += [{**_cell(result, captures), **point} for point in named if None not in point.values()]
    return pd.DataFrame(rows, columns=["scene", "method", "capture", "seed", "split", "seconds", "psnr"])


def load_outcomes(results: Sequence[CellResult], captures: CaptureNames = None) -> pd.DataFrame:
    """One row per cell that says how its training ended: at a `plateau` or not, with `dead` decoders (the same output
    in every frame), and what its `template` was learned from.
    """
    rows = [
        {
            **_cell(result, captures),
            "plateau": end.ended_by == "plateau",
            "dead": end.carries_nothing,
            "template": end.template or "",
        }
        for result in results
        if (end := result.training) is not None
    ]
    names = ["scene", "method", "capture", "seed", "plateau", "dead", "template"]
    return pd.DataFrame(rows, columns=names)


def _place(device: str) -> str:
    return ONE_CORE if device == "cpu" else device


def alike(methods: Iterable[str], places: Mapping[str, str]) -> tuple[str, ...]:
    """The methods whose times compare: those of one core, or where there are none, of the first one's device.

    `places`: `RunTables.drawn_on` for frames, `trained_on` for trainings.
    """
    there = {method: places[method] for method in methods}
    place = ONE_CORE if ONE_CORE in there.values() else next(iter(there.values()), "")
    return tuple(method for method in there if there[method] == place)


def _cell(result: CellResult, captures: CaptureNames) -> dict[str, Any]:
    config = result.config
    capture = _capture_of(config, captures)
    return {"scene": config.scene, "method": config.method, "capture": capture, "seed": config.seed}


def of_quantity(rows: pd.DataFrame, quantity: Quantity) -> pd.DataFrame:
    """The rows of one quantity."""
    return rows[
        (rows["metric"] == quantity.metric) & (rows["split"] == quantity.split) & (rows["region"] == quantity.region)
    ]


def samples_of(rows: pd.DataFrame, quantity: Quantity) -> dict[str, Samples]:
    """A quantity by method and capture, a value for each seed; `rows`: of one scene."""
    chosen = of_quantity(rows, quantity)
    samples: dict[str, dict[str, list[float]]] = {}
    for method, capture, value in zip(chosen["method"], chosen["capture"], chosen["value"], strict=True):
        samples.setdefault(method, {}).setdefault(capture, []).append(value)
    return dict(samples)


def compare(rows: pd.DataFrame, a: str, b: str, quantity: Quantity) -> Comparison | None:
    """Method `a` against method `b` on one scene; None where either was not run there, or a cell of it failed."""
    both = rows[rows["method"].isin((a, b))]
    if (both["status"] != "done").any():
        return None
    samples, metric = samples_of(both, quantity), METRICS[quantity.metric]
    return compare_samples(
        samples.get(a, {}),
        samples.get(b, {}),
        margin=metric.abs_tol,
        higher_is_better=metric.direction == "up",
    )


def methods_of(rows: pd.DataFrame, *, oracles: bool = True) -> tuple[str, ...]:
    """Methods that have rows: the user's first, then ours in the order of the suite."""
    names = sorted(map(str, rows["method"].unique()), key=is_ours)
    return tuple(name for name in names if oracles or not is_oracle(name))


def fewer_captures(rows: pd.DataFrame) -> dict[str, str]:
    """Methods that have fewer captures than others, with what their means are of, such as "3 of 5 people".

    `rows`: of one scene.
    """
    whom = rows.groupby("capture")["subject"].first()
    counts = rows.groupby("method", sort=False)["capture"].nunique()
    unit = "people" if whom.is_unique else "captures"
    return {str(method): f"{count} of {len(whom)} {unit}" for method, count in counts.items() if count < len(whom)}


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Every quantity of every method and scene (the index): `value` (mean), `half_width` of its 95 % interval (NaN for
    a single value), `least`, `greatest` and `n`; over captures, or the seeds of a single one.
    """
    by_key: dict[tuple[str, ...], dict[str, list[float]]] = {}
    for key, values in rows.groupby([*KEYS, "capture"], sort=False)["value"].agg(list).items():
        by_key.setdefault(key[:-1], {})[key[-1]] = values
    records = []
    for samples in by_key.values():
        values = independent(samples)
        interval = mean_interval(values)
        records.append((interval.mean, interval.high - interval.mean, min(values), max(values), len(values)))
    index = pd.MultiIndex.from_tuples(by_key, names=KEYS) if by_key else pd.MultiIndex.from_arrays([[]] * 5, names=KEYS)
    return pd.DataFrame(records, index=index, columns=["value", "half_width", "least", "greatest", "n"])


class RunTables:
    """The tables of a run, and look-ups in them."""

    def __init__(self, results: Sequence[CellResult], captures: CaptureNames = None) -> None:
        self.all_rows = load(results, captures)
        self.rows = self.all_rows[self.all_rows["axis"] == ""]  # of unperturbed captures
        plain = [result for result in results if not result.config.axis]
        self.images, self.outcomes = load_images(plain, captures), load_outcomes(plain, captures)
        self.curves, self.snapshots = load_curves(plain, captures), load_snapshots(plain, captures)
        self.brought = frozenset(result.config.method for result in results if result.brought is not None)
        # Where a method trained and where its frames were timed: `ONE_CORE`, or a device such as `cuda`.
        self.trained_on = {each.config.method: _place(each.config.device) for each in results}
        self.drawn_on = {each.config.method: _place(each.drawn_on or each.config.device) for each in results}
        self.scenes = tuple(self.rows["scene"].unique())

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Of every quantity: see `summarise`."""
        return summarise(self.rows)

    @cached_property
    def _by_scene(self) -> dict[str, pd.DataFrame]:
        return {str(scene): rows for scene, rows in self.rows.groupby("scene", sort=False)}

    @cached_property
    def cells(self) -> pd.DataFrame:
        """By scene and method: how many `cells` there are, and how many of them `failed`."""
        cells = self.rows.drop_duplicates(["scene", "method", "seed", "capture"])
        ended = cells.assign(failed=cells["status"] != "done").groupby(["scene", "method"], sort=False)["failed"]
        return ended.agg(cells="size", failed="sum")

    def of(self, scene: str) -> pd.DataFrame:
        """The rows of a scene."""
        return self._by_scene[scene] if scene in self._by_scene else self.rows.head(0)

    def methods(self, scene: str, *, oracles: bool = True) -> tuple[str, ...]:
        """Methods on a scene: the user's first, then ours in the order of the suite."""
        return methods_of(self.of(scene), oracles=oracles)

    def get(self, scene: str, method: str, quantity: Quantity) -> Any:
        """The row of `summary`, or None where no cell has the quantity."""
        key = (scene, method, *quantity)
        return self.summary.loc[key] if key in self.summary.index else None

    def values(self, scene: str, quantity: Quantity, methods: Iterable[str]) -> dict[str, float]:
        """Means by method, of those that have the quantity."""
        rows = {method: self.get(scene, method, quantity) for method in methods}
        return {method: float(row.value) for method, row in rows.items() if row is not None}

    def failed(self, scene: str, method: str) -> int:
        """How many cells of a method on a scene failed."""
        return int(self.cells["failed"].get((scene, method), 0))

    def whole(self, scene: str, *methods: str) -> bool:
        """Whether all of the methods were run on the scene and none of their cells failed."""
        return all((scene, method) in self.cells.index and not self.failed(scene, method) for method in methods)

    def captures(self, scene: str) -> int:
        """How many captures a scene has."""
        return int(self.of(scene)["capture"].nunique())

    def seeds(self, scene: str) -> int:
        """With how many seeds methods were trained on a scene."""
        return int(self.of(scene)["seed"].nunique())

    def unit(self, scene: str) -> str:
        """What intervals of a scene are taken over; empty where it has a single value."""
        return "captures" if self.captures(scene) > 1 else "seeds" if self.seeds(scene) > 1 else ""

    def for_validation(self, scene: str) -> bool:
        """Whether the subjects of a scene are those for validation and tuning."""
        return bool((self.of(scene)["subject"] >= VALIDATION).any())
