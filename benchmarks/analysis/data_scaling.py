"""Held-out motion against the number of training frames: from how many on does learning from motion pay?"""

from collections.abc import Sequence

import pandas as pd

from benchmarks.analysis.scores import HELD_OUT_SPLITS
from benchmarks.analysis.statistics import independent, mean_interval
from benchmarks.analysis.style import style_of
from benchmarks.cell.cells import CellResult
from benchmarks.suites.stress import FOOTAGE_FRAMES

AXIS, STATIC = "footage", "wo_mot"


def curves(results: Sequence[CellResult]) -> pd.DataFrame:
    """Scene, split, method, frames, psnr with its 95 % interval (NaN for one seed), of captures of growing length."""
    rows = []
    scenes = {result.config.scene for result in results if result.config.axis == AXIS}
    used = [r for r in results if r.config.scene in scenes and r.config.axis in ("", AXIS) and r.status == "done"]
    places = dict.fromkeys((r.config.scene, r.config.method, r.config.severity) for r in used)
    for scene, method, severity in places:
        own = [r for r in used if (r.config.scene, r.config.method, r.config.severity) == (scene, method, severity)]
        for split in HELD_OUT_SPLITS:
            samples: dict[str, list[float]] = {}
            for result in own:
                if (score := result.value(split, "foreground", "psnr")) is not None:
                    samples.setdefault(result.config.capture, []).append(score)
            if samples:
                interval = mean_interval(independent(samples))
                frames = FOOTAGE_FRAMES - int(severity)
                rows.append((scene, split, method, frames, interval.mean, interval.low, interval.high))
    table = pd.DataFrame(rows, columns=["scene", "split", "method", "frames", "psnr", "low", "high"])
    return table.astype({"low": float, "high": float}).sort_values(
        ["scene", "split", "method", "frames"], key=_in_order
    )


def _in_order(column: pd.Series) -> pd.Series:
    """Splits as they are told everywhere, from held-out views to far motion."""
    return column.map(HELD_OUT_SPLITS.index) if column.name == "split" else column


def pays_at(table: pd.DataFrame, method: str) -> dict[str, pd.Series]:
    """Whether a method is above static Gaussians on held-out motion, by number of training frames, per scene."""
    found = {}
    for scene, here in table[table.split == "novel_pose"].groupby("scene", sort=False):
        wide = here.pivot(index="frames", columns="method", values="psnr")
        if {method, STATIC} <= set(wide.columns):
            found[str(scene)] = wide[method] > wide[STATIC]
    return found


def sentences(table: pd.DataFrame) -> list[str]:
    """When motion pays, for every method that learns from it."""
    rest = f"{style_of(STATIC).title} on held-out motion"
    return [
        f"On {scene}, {style_of(method).title} is above {rest} {_when(ahead)}."
        for method in dict.fromkeys(table.method)
        if method != STATIC
        for scene, ahead in pays_at(table, method).items()
    ]


def _when(ahead: pd.Series) -> str:
    """At which numbers of training frames, in words."""
    if ahead.all():
        return f"at every number of training frames that was tried, {ahead.index.min()} to {ahead.index.max()}"
    if not ahead.any():
        return "at no number of training frames that was tried"
    if ahead.iloc[-1]:
        last_behind = ahead.index[~ahead].max()
        return f"from {ahead.index[ahead.index > last_behind].min()} training frames on"
    return f"at {', '.join(map(str, ahead.index[ahead]))} training frames, and no more at {ahead.index.max()}"
