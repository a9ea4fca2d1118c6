"""Accuracy against training seconds: one curve per method out of the snapshots that its trainings left."""

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np
import pandas as pd

from benchmarks.analysis.scores import HELD_OUT_SPLITS
from benchmarks.analysis.statistics import independent, mean_interval
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.cells import CellResult

COLUMNS = ("scene", "split", "method", "seconds", "capture", "seed", "psnr")


def snapshots(results: Sequence[CellResult]) -> pd.DataFrame:
    """One row per snapshot, split and seed, the end of training among them.

    A training that ended earlier than others keeps its last score: more time would have changed nothing.
    """
    rows = []
    for result in results:
        if result.status != "done" or not result.snapshots or result.config.axis:
            continue
        end = result.training.seconds if result.training else result.value("speed", "", "train_s")
        config = result.config
        points = [(row.split, row.seconds, row.psnr) for row in result.snapshots]
        final = [(split, end, result.value(split, "foreground", "psnr")) for split in HELD_OUT_SPLITS]
        for split, seconds, psnr in points + [point for point in final if None not in point]:
            rows.append((config.scene, split, config.method, seconds, config.capture, config.seed, psnr))
    return pd.DataFrame(rows, columns=list(COLUMNS))


def curves(results: Sequence[CellResult]) -> pd.DataFrame:
    """Mean over seeds with its 95 % interval: scene, split, method, seconds, psnr, low, high (NaN for one seed).

    Over captures, where the scene has several: then seeds within a capture are averaged.

    Seconds are those of the snapshots of any method on the scene; before its own first snapshot a method has no row.
    """
    found = snapshots(results)
    rows = []
    for (scene, split), here in found.groupby(["scene", "split"], sort=False):
        marks = np.unique(here.seconds.round())
        for method, own in here.groupby("method", sort=False):
            for mark in marks:
                scores = own.groupby(["capture", "seed"]).apply(_at, mark, include_groups=False)
                if scores.notna().all():
                    interval = mean_interval(independent(scores.groupby("capture").agg(list).to_dict()))
                    rows.append((scene, split, method, mark, interval.mean, interval.low, interval.high))
    table = pd.DataFrame(rows, columns=["scene", "split", "method", "seconds", "psnr", "low", "high"])
    return table.astype({"low": float, "high": float})


def _at(run: pd.DataFrame, seconds: float) -> float:
    """The score of the latest snapshot that was there by then; NaN where none was."""
    there = run[run.seconds.round() <= seconds].sort_values("seconds")
    return float(there.psnr.iloc[-1]) if len(there) else np.nan


def crossings(table: pd.DataFrame) -> pd.DataFrame:
    """Where two methods change places: scene, split, seconds, who leads from there on, and who no longer does.

    Between two snapshots the difference is taken to change linearly in the logarithm of the seconds.
    """
    rows = []
    for (scene, split), here in table.groupby(["scene", "split"], sort=False):
        wide = here.pivot(index="seconds", columns="method", values="psnr")
        for first, second in combinations(dict.fromkeys(here.method), 2):
            margin = (wide[first] - wide[second]).dropna()
            for seconds, sign in _sign_changes(margin):
                leader, other = (first, second) if sign > 0 else (second, first)
                rows.append((scene, split, seconds, leader, other))
    return pd.DataFrame(rows, columns=["scene", "split", "seconds", "leader", "other"])


def _sign_changes(margin: pd.Series) -> list[tuple[float, int]]:
    """Seconds at which a margin passes through zero, and its sign from there on."""
    found = []
    points = [(float(s), float(m)) for s, m in margin.items() if m != 0]
    for (before, low), (after, high) in pairwise(points):
        if low * high < 0:
            share = low / (low - high)
            found.append((float(np.exp((1 - share) * np.log(before) + share * np.log(after))), int(np.sign(high))))
    return found


def sentences(table: pd.DataFrame) -> list[str]:
    """The crossings in words; and pairs that never cross, by who leads throughout."""
    crossed = crossings(table)
    found = [
        f"On {row.scene}, {SPLIT_NAMES[row.split].words}, {style_of(row.leader).title} is ahead of"
        f" {style_of(row.other).title} from {row.seconds:.0f} s of training on."
        for row in crossed.itertuples()
    ]
    for (scene, split), here in table.groupby(["scene", "split"], sort=False):
        wide = here.pivot(index="seconds", columns="method", values="psnr")
        for first, second in combinations(dict.fromkeys(here.method), 2):
            margin = (wide[first] - wide[second]).dropna()
            if len(margin) and ((margin > 0).all() or (margin < 0).all()):
                ahead, behind = (first, second) if margin.iloc[0] > 0 else (second, first)
                found.append(
                    f"On {scene}, {SPLIT_NAMES[split].words}, {style_of(ahead).title} is ahead of"
                    f" {style_of(behind).title} at every time,"
                    f" by {abs(margin).min():.1f} to {abs(margin).max():.1f} dB."
                )
    return found
