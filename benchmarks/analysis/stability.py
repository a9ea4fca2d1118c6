"""Where methods fail: accuracy against the severity of a perturbation, breakdown points, failure rates."""

import math

import pandas as pd

from benchmarks.analysis.curves import FOOTAGE_AXIS
from benchmarks.analysis.results import RANKED_SPLITS, foreground, samples_of
from benchmarks.analysis.statistics import independent, mean_interval, spreads, wilson
from benchmarks.suites.stress import AXES

TRIVIAL = "nearest"  # shows the training image of the nearest pose and camera


def steps(rows: pd.DataFrame) -> pd.DataFrame:
    """Foreground PSNR by severity: scene, axis, split, method, severity, psnr, low, high; `rows`: all of a run.

    Failed cells count with the worst score. Cut training motion is no perturbation: see `curves.data_scaling`.
    """
    rows = _with_plain_scene(rows)
    records = []
    for scene, here in rows.groupby("scene", sort=False):
        for axis in [name for name in AXES if name != FOOTAGE_AXIS and (here["axis"] == name).any()]:
            along = here[here["axis"].isin(("", axis))]
            for split in RANKED_SPLITS:
                for severity, at in along.groupby("severity"):
                    for method, samples in samples_of(at, foreground(split)).items():
                        records.append((scene, axis, split, method, severity, *mean_interval(independent(samples))))
    columns = ["scene", "axis", "split", "method", "severity", "psnr", "low", "high"]
    table = pd.DataFrame(records, columns=columns)
    groups = table.groupby(["scene", "axis", "split", "method"])["severity"]
    return table[(groups.transform("min") == 0) & (groups.transform("size") > 1) | (table["method"] == TRIVIAL)]


def breakdowns(table: pd.DataFrame) -> pd.DataFrame:
    """Of `steps`: scene, axis, split, method, loss (dB at the worst severity), midpoint, breakdown (severity).

    A method is broken where the upper bound of its interval lies below the midpoint between its score on the clean
    capture and the trivial method's; midpoint NaN: that was not run; breakdown NaN: it never is.
    """
    records = []
    for (scene, axis, split), here in table.groupby(["scene", "axis", "split"], sort=False):
        floor = here[(here["method"] == TRIVIAL) & (here["severity"] == 0)]["psnr"]
        for method, curve in here[here["method"] != TRIVIAL].groupby("method", sort=False):
            clean, worse = curve.iloc[0]["psnr"], curve.iloc[1:]
            midpoint = math.nan if floor.empty else (clean + floor.item()) / 2
            broken = worse.loc[worse["high"].fillna(worse["psnr"]) < midpoint, "severity"]
            records.append((scene, axis, split, method, clean - worse["psnr"].min(), midpoint, broken.min()))
    return pd.DataFrame(records, columns=["scene", "axis", "split", "method", "loss", "midpoint", "breakdown"])


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
