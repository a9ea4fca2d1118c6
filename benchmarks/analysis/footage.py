"""Held-out motion against the number of training frames: from how many on does learning from motion pay?"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from benchmarks.analysis.names import look_of
from benchmarks.analysis.scores import HELD_OUT_SPLITS
from benchmarks.analysis.statistics import independent, mean_interval
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
    return table.astype({"low": float, "high": float}).sort_values(["scene", "split", "method", "frames"])


def pays_from(table: pd.DataFrame, method: str) -> pd.DataFrame:
    """The least number of frames from which on a method is above static Gaussians on held-out motion, per scene.

    NaN: at no number that was tried.
    """
    rows = []
    for scene, here in table[table.split == "novel_pose"].groupby("scene", sort=False):
        wide = here.pivot(index="frames", columns="method", values="psnr")
        if not {method, STATIC} <= set(wide.columns):
            continue
        ahead = (wide[method] > wide[STATIC])[::-1].cumprod().astype(bool)
        rows.append((scene, float(ahead[ahead].index.min()) if ahead.any() else np.nan))
    return pd.DataFrame(rows, columns=["scene", "frames"])


def sentences(table: pd.DataFrame) -> list[str]:
    """When motion pays, for every method that learns from it."""
    found = []
    for method in [m for m in dict.fromkeys(table.method) if m != STATIC]:
        for row in pays_from(table, method).itertuples():
            name, rest = look_of(method).title, f"{look_of(STATIC).title} on held-out motion"
            if np.isnan(row.frames):
                found.append(f"On {row.scene}, {name} is above {rest} at no number of training frames that was tried.")
            else:
                found.append(f"On {row.scene}, {name} is above {rest} from {row.frames:.0f} training frames on.")
    return found
