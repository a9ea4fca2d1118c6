"""Where methods fail: accuracy against the severity of a perturbation, breakdown points, failure rates."""

import math
from collections.abc import Iterator
from statistics import fmean

import pandas as pd

from benchmarks.analysis.curves import FOOTAGE_AXIS
from benchmarks.analysis.results import RANKED_SPLITS, Quantity, foreground, samples_of
from benchmarks.analysis.statistics import (
    Interval,
    Samples,
    compare_samples,
    independent,
    intervals,
    mean_interval,
    spreads,
    wilson,
)
from benchmarks.suites.stress import AXES, TRIVIAL

COURSE = ["scene", "axis", "split", "method"]


def steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Foreground PSNR by severity: scene, axis, split, method, severity, psnr, low, high; `rows`: all of a run.

    Intervals leave out how people differ; of a single person they are over seeds. Failed cells count with the worst
    score. Cut training motion is no perturbation: see `curves.data_scaling`.
    """
    records = [
        (*place, *step, *interval) for place, samples in _courses(rows) for step, interval in intervals(samples).items()
    ]
    table = pd.DataFrame(records, columns=[*COURSE, "severity", "psnr", "low", "high"])
    groups = table.groupby(COURSE)["severity"]
    return table[(groups.transform("min") == 0) & (groups.transform("size") > 1) | (table["method"] == TRIVIAL)]


def losses(rows: pd.DataFrame, region: str = "foreground") -> pd.DataFrame:
    """PSNR lost to the clean capture, in pairs over people: scene, axis, split, method, severity, mean, low, high, and
    `distance`: the upper bound of the score minus the midpoint between the person's clean score and the trivial
    method's (NaN: that was not run). All in dB, of images of `region` (`benchmarks.cell.metrics`).
    """
    records = []
    for place, samples in _courses(rows, region):
        trivial = samples.get((TRIVIAL, 0.0), {})
        for (method, severity), scores in samples.items():
            clean = samples.get((method, 0.0), {})
            test = compare_samples(clean, scores)
            if severity and method != TRIVIAL and test is not None:
                midpoints = {c: (fmean(clean[c]) + fmean(trivial[c])) / 2 for c in clean if c in trivial}
                distances = {c: [score - midpoints[c] for score in scores[c]] for c in scores if c in midpoints}
                bound = mean_interval(independent(distances)) if distances else Interval(math.nan)
                upper = bound.mean if math.isnan(bound.high) else bound.high
                records.append((*place, method, severity, test.mean, test.low, test.high, upper))
    return pd.DataFrame(records, columns=[*COURSE, "severity", "mean", "low", "high", "distance"])


def breakdowns(table: pd.DataFrame) -> pd.DataFrame:
    """Of `losses`: scene, axis, split, method and `breakdown`, the least severity at which the method is broken, its
    distance below zero (NaN: none).
    """
    broken = table.assign(breakdown=table["severity"].where(table["distance"] < 0))
    return broken.groupby(COURSE, sort=False)["breakdown"].min().reset_index()


def reliability(rows: pd.DataFrame, scene: str) -> pd.DataFrame:
    """Per method over all severities: method, cells, failures, diverged, low and high of the failure rate, and
    spread_db: standard deviation over the seeds of a clean capture on novel views (NaN: unknown).
    """
    rows = _with_plain_scene(rows)
    records = []
    for method, here in rows[rows["scene"] == scene].groupby("method", sort=False):
        status = here.drop_duplicates(["seed", "axis", "severity", "capture"])["status"]
        failures = int((status != "done").sum())
        good = here[(here["axis"] == "") & (here["status"] == "done")]
        spread = spreads(samples_of(good, foreground()).get(method, {}))[1]
        low, high = wilson(failures, len(status))
        records.append((method, len(status), failures, int((status == "diverged").sum()), low, high, spread))
    columns = ["method", "cells", "failures", "diverged", "low", "high", "spread_db"]
    return pd.DataFrame(records, columns=columns).astype({"spread_db": float})


def _with_plain_scene(rows: pd.DataFrame) -> pd.DataFrame:
    """The scene without how its capture was perturbed."""
    return rows.assign(scene=rows["scene"].str.split(" ").str[0])


def _courses(
    rows: pd.DataFrame, region: str = "foreground"
) -> Iterator[tuple[tuple[str, str, str], dict[tuple[str, float], Samples]]]:
    """PSNR along each axis from the clean capture on: scene, axis and split; then by method and severity."""
    rows = _with_plain_scene(rows)
    rows = rows.assign(capture=rows["subject"])  # A perturbed capture has a name of its own.
    for scene, here in rows.groupby("scene", sort=False):
        for axis in [name for name in AXES if name != FOOTAGE_AXIS and (here["axis"] == name).any()]:
            along = here[here["axis"].isin(("", axis))]
            for split in RANKED_SPLITS:
                samples = {
                    (method, float(severity)): own
                    for severity, at in along.groupby("severity")
                    for method, own in samples_of(at, Quantity(split, region, "psnr")).items()
                }
                yield (str(scene), axis, split), samples
