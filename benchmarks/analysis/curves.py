"""Quality against what was spent and against how far a test is from training: curves with intervals, and sentences.

`during_training`, `time_to_quality`: training seconds. `data_scaling`: training frames. `novelty`: distance of a
pose from training.
"""

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pandas as pd

from benchmarks.analysis.results import HELD_OUT_SPLITS, foreground, samples_of
from benchmarks.analysis.statistics import intervals
from benchmarks.analysis.style import SPLIT_NAMES, listed, reference_of, style_of
from benchmarks.suites.stress import FOOTAGE_FRAMES

FOOTAGE_AXIS, STATIC = "footage", "wo_mot"
BINS, LEAST = 5, 3  # at most so many bins of motion, of so many frames or more
NARROW_DEG = 1.0  # Motion that stays within it makes no curve.


def _table(rows: list[tuple], *columns: str) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=[*columns, "psnr", "low", "high"])


def during_training(curves: pd.DataFrame) -> pd.DataFrame:
    """Scene, method, seconds, psnr: the mean over a method's trainings (captures, seeds), from where the last of them
    has its first score to where the first of them ends. Between two scores a training's changes linearly.
    """
    rows = []
    for (scene, method), trainings in curves.groupby(["scene", "method"], sort=False):
        runs = [run.sort_values("seconds") for _, run in trainings.groupby(["capture", "seed"])]
        start, end = (pick(run["seconds"].iloc[place] for run in runs) for pick, place in ((max, 0), (min, -1)))
        marks = runs[0]["seconds"] if len(runs) == 1 else np.geomspace(start, end, min(map(len, runs)))
        scores = [np.interp(marks, run["seconds"], run["psnr"]) for run in runs]
        rows += [(scene, method, *point) for point in zip(marks, np.mean(scores, axis=0), strict=True)]
    return pd.DataFrame(rows, columns=["scene", "method", "seconds", "psnr"])


def on_equal_captures(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows (scene, method, capture, ...) in which all methods of a scene have the same captures.

    Methods that lack some of a scene's captures stand, with all that have theirs, in a scene of its own, such as
    "loose, 1 of 3 captures"; where others have as many of other captures, in "loose, 1 of 3 captures (2)".
    """
    parts = [rows.head(0)]
    for scene, here in rows.groupby("scene", sort=False):
        total = here["capture"].nunique()
        captures_of = here.groupby("method", sort=False)["capture"].agg(frozenset)
        alike: Counter[int] = Counter()
        for captures in sorted(dict.fromkeys(captures_of), key=len, reverse=True):
            alike[len(captures)] += 1
            methods = [method for method, own in captures_of.items() if captures <= own]
            part = here[here["method"].isin(methods) & here["capture"].isin(captures)]
            number = f" ({alike[len(captures)]})" if alike[len(captures)] > 1 else ""
            name = scene if len(captures) == total else f"{scene}, {len(captures)} of {total} captures{number}"
            parts.append(part.assign(scene=name))
    return pd.concat(parts)


def time_to_quality(snapshots: pd.DataFrame) -> pd.DataFrame:
    """Scene, split, method, seconds, psnr, low, high, at the seconds of snapshots and at the last end of a training.

    A training that ended earlier keeps its last score; before its first snapshot a method has no row.
    """
    rows = []
    for (scene, split), here in snapshots.groupby(["scene", "split"], sort=False):
        ends = here.groupby(["method", "capture", "seed"])["seconds"].transform("max")
        marks = here["seconds"][here["seconds"].lt(ends) | here["seconds"].eq(ends.max())].round()
        for mark in np.unique(marks):
            samples = {}
            for method, runs in here.groupby("method", sort=False):
                scores = runs.groupby(["capture", "seed"]).apply(_score_at, mark, include_groups=False)
                if scores.notna().all():
                    samples[str(method)] = scores.groupby("capture").agg(list).to_dict()
            rows += [(scene, split, method, mark, *each) for method, each in intervals(samples).items()]
    return _table(rows, "scene", "split", "method", "seconds")


def _score_at(run: pd.DataFrame, seconds: float) -> float:
    """The score of the latest snapshot up to then; NaN where there is none."""
    earlier = run[run["seconds"].round() <= seconds].sort_values("seconds")
    return float(earlier["psnr"].iloc[-1]) if len(earlier) else np.nan


def crossings(table: pd.DataFrame) -> list[str]:
    """Sentences on every method and the one that it is compared with: from when on one is ahead, or that it always is.

    Between two snapshots the difference is taken to change linearly in the logarithm of the seconds.
    """
    crossed, never = [], []
    for (scene, split), here in table.groupby(["scene", "split"], sort=False):
        wide = here.pivot(index="seconds", columns="method", values="psnr")
        methods = tuple(map(str, here["method"].unique()))
        for method in methods:
            reference = reference_of(method, methods)
            if reference is None:
                continue
            lead = (wide[reference] - wide[method]).dropna()
            where = f"On {scene}, {SPLIT_NAMES[split].words}, "
            changes = list(_sign_changes(lead))
            if changes:
                seconds, value = changes[-1]
                before = " The lead had changed before." if changes[1:] else ""
                crossed.append(
                    f"{where}{_ahead(reference, method, value)} from {seconds:.0f} s of training on.{before}"
                )
            elif len(lead) and ((lead > 0).all() or (lead < 0).all()):
                span = f"{abs(lead).min():.1f} to {abs(lead).max():.1f}"
                never.append(f"{where}{_ahead(reference, method, lead.iloc[0])} at every time, by {span} dB.")
    return crossed + never


def _ahead(first: str, second: str, lead: float) -> str:
    names = (first, second) if lead > 0 else (second, first)
    return " is ahead of ".join(style_of(name).title for name in names)


def _sign_changes(lead: pd.Series) -> Iterator[tuple[float, float]]:
    """Seconds at which a lead passes through zero, and the lead after them."""
    points = [(float(seconds), float(value)) for seconds, value in lead.items() if value != 0]
    for (before, low), (after, high) in pairwise(points):
        if low * high < 0:
            share = low / (low - high)
            yield float(np.exp((1 - share) * np.log(before) + share * np.log(after))), high


def data_scaling(rows: pd.DataFrame) -> pd.DataFrame:
    """Scene, split, method, frames, psnr, low, high, of captures whose training motion was cut; `rows`: all."""
    rows = rows[rows["axis"].isin(("", FOOTAGE_AXIS)) & (rows["status"] == "done")]
    rows = rows.assign(scene=rows["scene"].str.split(" ").str[0])
    scenes = rows.loc[rows["axis"] == FOOTAGE_AXIS, "scene"].unique()
    records = []
    for (scene, severity), here in rows[rows["scene"].isin(scenes)].groupby(["scene", "severity"], sort=False):
        counts = here[here["metric"] == "train_frames"].groupby("method")["value"].max()
        for split in HELD_OUT_SPLITS:
            for method, interval in intervals(samples_of(here, foreground(split))).items():
                frames = int(counts.get(method, FOOTAGE_FRAMES - severity))
                records.append((scene, split, method, frames, *interval))
    table = _table(records, "scene", "split", "method", "frames")
    order = table["split"].map(HELD_OUT_SPLITS.index)
    return table.assign(order=order).sort_values(["scene", "order", "method", "frames"]).drop(columns="order")


def frames_needed(table: pd.DataFrame) -> list[str]:
    """Sentences: at how many training frames a method is above static Gaussians on new poses."""
    sentences = []
    for method in dict.fromkeys(table["method"]):
        for scene, here in table[table["split"] == "novel_pose"].groupby("scene", sort=False):
            wide = here.pivot(index="frames", columns="method", values="psnr")
            if method != STATIC and {method, STATIC} <= set(wide.columns):
                rest = f"{style_of(STATIC).title} on {SPLIT_NAMES['novel_pose'].words}"
                ahead = _when(wide[method] > wide[STATIC])
                sentences.append(f"On {scene}, {style_of(method).title} is above {rest} {ahead}.")
    return sentences


def _when(ahead: pd.Series) -> str:
    frames = ahead.index
    if ahead.all():
        return f"at every number of training frames, {frames.min()} to {frames.max()}"
    if not ahead.any():
        return "at no number of training frames"
    if ahead.iloc[-1]:
        return f"from {frames[frames > frames[~ahead].max()].min()} training frames on"
    return f"at {', '.join(map(str, frames[ahead]))} training frames, but not at {frames.max()}"


def novelty(images: pd.DataFrame) -> pd.DataFrame:
    """Scene, method, novelty_deg, psnr, low, high: mean foreground PSNR by bins of novelty.

    Novel views of training poses stand at zero degrees; the frames of all novel poses are sorted by novelty into bins
    of equal number. Scenes whose frames fill fewer than two bins, or lie within a degree, have no curve.
    """
    if "psnr" not in images:  # All pictures were brought without alpha.
        return _table([], "scene", "method", "novelty_deg")
    scored = images["novelty_deg"].notna() & images["psnr"].notna()
    with_novelty = images[images["split"].isin(HELD_OUT_SPLITS) & scored]
    rows = [row for scene, here in with_novelty.groupby("scene", sort=False) for row in _novelty_of(str(scene), here)]
    return _table(rows, "scene", "method", "novelty_deg")


def _novelty_of(scene: str, images: pd.DataFrame) -> Iterator[tuple]:
    frames = images.drop_duplicates(["capture", "frame"])
    moved = frames.loc[frames["split"] != "novel_view", "novelty_deg"]
    count = min(BINS, len(moved) // LEAST)
    if count < 2 or moved.max() < NARROW_DEG:
        return
    edges = np.quantile(moved, np.linspace(0, 1, count + 1)[1:-1])
    of_image = pd.Series(1 + np.searchsorted(edges, images["novelty_deg"], side="right"), index=images.index)
    of_image[images["split"] == "novel_view"] = 0
    degrees = frames["novelty_deg"].groupby(of_image[frames.index]).mean()
    means = images.groupby(["method", of_image, "capture", "seed"], sort=False)["psnr"].mean()
    for index, mean_deg in degrees.items():
        here = means[means.index.get_level_values(1) == index]
        samples = {
            str(method): seeds.groupby("capture").agg(list).to_dict()
            for method, seeds in here.groupby("method", sort=False)
        }
        for method, interval in intervals(samples).items():
            yield scene, method, float(mean_deg), *interval


def losses_by_novelty(table: pd.DataFrame) -> list[str]:
    """A sentence per scene: what each method loses from training poses to the most novel ones, least loss first."""
    sentences = []
    for scene, here in table.groupby("scene", sort=False):
        ends = here.sort_values("novelty_deg").groupby("method", sort=False)
        losses = {
            str(method): curve["psnr"].iloc[0] - curve["psnr"].iloc[-1] for method, curve in ends if len(curve) > 1
        }
        ranked = sorted(losses.items(), key=lambda pair: pair[1])
        names = listed([f"{style_of(method).title} {loss:.1f} dB" for method, loss in ranked])
        first, last = here["novelty_deg"].min(), here["novelty_deg"].max()
        sentences.append(
            f"On {scene}, from {first:.0f} to {last:.0f} degrees from the training poses, PSNR falls: {names}."
        )
    return sentences
