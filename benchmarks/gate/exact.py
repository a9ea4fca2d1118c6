"""What can be seen without statistics, because trainings and pictures are deterministic.

- The protocol: stored pictures have their stored scores.
- Frozen avatars: trained avatars of the baseline, loaded by today's code, draw the pictures that they drew.
- First steps: today's training begins with the losses and gradients of the baseline's.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Capture
from ash.files import open_regular
from benchmarks.cell.evaluation import agreement, image_summary, scored_views
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import CellResult, View, stored_prediction
from benchmarks.gate.baseline import LARGEST_LOG, LOG_LINES, Entry, stored_views
from benchmarks.gate.checks import GATED, Check, of_exact_change

SAME_SCORE = 1e-5  # as a share of a score: rounding of another instruction set
SAME_DB = 50.0  # PSNR between two pictures that differ by rounding alone
SAME_STEP = 1e-4  # as a share of a loss or gradient norm of a first step: another order of summation


def protocol_check(row: str, entry: Entry, capture: Capture) -> Check:
    """Whether the stored pictures of a frozen avatar have their stored scores, one by one and on average."""
    cell, result = entry.cell, entry.result
    before = {(v.split, v.camera, v.frame): v for v in result.views}
    now = scored_views(cell, capture, stored_views(result), alpha=result.has_alpha)
    wrong = [
        f"{region} {metric} of {_place(view)} is {value:.6g}, was {old:.6g}"
        for view in now
        for (region, metric), old in before[view.split, view.camera, view.frame].scores.items()
        if (value := view.scores.get((region, metric), math.nan if metric != "lpips" else old)) != old
        and not math.isclose(value, old, rel_tol=SAME_SCORE)
    ]
    means = {(r.split, r.region, r.metric): r.value for r in image_summary(list(result.views))}
    wrong += [
        f"mean {metric} of {split} is {value:.6g}, was {old:.6g}"
        for (split, region, metric), value in means.items()
        if (old := result.value(split, region, metric)) is not None and not math.isclose(value, old, rel_tol=SAME_SCORE)
    ]
    if wrong:
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        return Check(row, "protocol", "worse", f"the protocol changed: {wrong[0]}{more}")
    return Check(row, "protocol", "unchanged", f"{len(now)} stored pictures have their scores")


@dataclass(frozen=True, slots=True)
class Worst:
    """The picture of a frozen avatar that changed most: both, uint8 RGBA on black, and the PSNR between them."""

    view: View
    before: np.ndarray
    after: np.ndarray
    psnr: float


def rendering_checks(row: str, before: Entry, after: Entry, capture: Capture) -> tuple[list[Check], Worst | None]:
    """Whether a frozen avatar draws the same pictures; where not, by how much each gated score changed.

    These changes are exact: the same weights were drawn twice. Also returns the stored picture that changed most.
    """
    old, new = ({(v.split, v.camera, v.frame): v.prediction for v in e.result.views} for e in (before, after))
    if old == new:
        return [Check(row, "rendering", "unchanged", f"the frozen avatar draws the same {len(old)} pictures")], None
    changed = []
    for view in stored_views(before.result):
        one, two = (stored_prediction(entry.cell, capture, view) for entry in (before, after))
        if not np.array_equal(one, two):
            changed.append(Worst(view, one, two, agreement(two, one)))
    worst = min(changed, key=lambda each: each.psnr, default=None)
    far = "" if worst is None else f"; {worst.psnr:.1f} dB to before at the worst, {_place(worst.view)}"
    different = sum(new.get(place) != digest for place, digest in old.items())
    detail = f"rendering changed: {different} of {len(old)} pictures{far}"
    scores = [check for name in GATED if (check := _score_check(row, name, before.result, after.result)) is not None]
    alike = worst is None or worst.psnr >= SAME_DB  # None: the pictures that changed are not among those stored
    if alike and all(score.verdict == "unchanged" for score in scores):
        return [Check(row, "rendering", "unchanged", f"equal within rounding: {detail}"), *scores], worst
    return [Check(row, "rendering", "not worse", detail), *scores], worst


def _score_check(row: str, name: tuple[str, str, str], before: CellResult, after: CellResult) -> Check | None:
    """The change of one mean score of the same avatar."""
    old, new = before.value(*name), after.value(*name)
    if old is None or new is None:
        return None
    metric = METRICS[name[2]]
    verdict = of_exact_change(new - old, metric.abs_tol, higher_is_better=metric.direction == "up")
    detail = f"{old:.4g} -> {new:.4g}{metric.unit and ' ' + metric.unit} ({new - old:+.3g}, exact)"
    return Check(row, "rendering", verdict, detail, "/".join(name))


def first_steps_check(row: str, before: Path, after: Path) -> Check | None:
    """Where the training log of `after` first differs from that of `before`; None where there is nothing to compare."""
    old, new = _steps(before), _steps(after)
    if not (count := min(len(old), len(new))):
        return None
    for one, two in zip(old[:count], new[:count], strict=True):
        for what in ("step", "loss", "gradient", "train_psnr"):
            if one.get(what) != two.get(what):
                return _first_difference(row, one, two, what)
    return Check(row, "training", "unchanged", f"the first {count} lines of its log are equal")


def _first_difference(row: str, old: Mapping[str, Any], new: Mapping[str, Any], what: str) -> Check:
    step, before, after = old.get("step", "?"), old.get(what), new.get(what)
    where = {
        "loss": f"from the loss of step {step} on" + ("" if step == 1 else ", so in the update before it"),
        "gradient": f"from the gradient of step {step} on, whose loss is equal",
    }.get(what, f"from step {step} on")
    near = isinstance(before, float) and isinstance(after, float) and math.isclose(before, after, rel_tol=SAME_STEP)
    difference = f"{what} {before} -> {after}{'; it may be rounding' if near else ''}"
    return Check(row, "training", "not worse", f"training changed {where} ({difference})")


def _steps(path: Path) -> list[dict[str, Any]]:
    """The first lines of a training log that hold a loss or a score."""
    if not path.exists():
        return []
    lines: list[dict[str, Any]] = []
    with open_regular(path, most=LARGEST_LOG) as file:
        for line in file:
            try:
                content = json.loads(line)
            except (ValueError, RecursionError):
                break
            if isinstance(content, dict) and ({"loss", "train_psnr"} & content.keys()):
                lines.append(content)
            if len(lines) == LOG_LINES:
                break
    return lines


def seeds_check(row: str, before: Sequence[Entry], after: Sequence[Entry]) -> Check | None:
    """A check that fails where two seeds drew the same pictures and those of the baseline did not; else None."""
    if _has_equal_pictures(before) or not _has_equal_pictures(after):
        return None
    detail = "two seeds draw the same pictures, and those of the baseline do not: the seed is ignored"
    return Check(row, "training", "worse", detail, "seeds")


def _has_equal_pictures(seeds: Sequence[Entry]) -> bool:
    return len({tuple(view.prediction for view in entry.result.views) for entry in seeds}) < len(seeds)


def _place(view: View) -> str:
    return f"{view.split.replace('_', ' ')}, {view.camera}, frame {view.frame}"
