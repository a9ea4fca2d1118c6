"""Quality against the error of the template that methods are given, and ASH minus DDC: where the two cross.

A fixed mesh with the best texture stands beside them: what geometry of such an error is worth by itself.
"""

import math
from dataclasses import dataclass
from itertools import product

from benchmarks.analysis.contrasts import difference
from benchmarks.analysis.names import SPLIT_NAMES
from benchmarks.analysis.scores import Quantity, Scores, foreground
from benchmarks.analysis.statistics import Interval, mean_interval
from benchmarks.cell.methods import ON_EXACT, WRONG_BY_MM

# ASH (CVPR 2024), Table 1: PSNR of ASH minus DDC, tight and loose clothes.
PAPER_DB = {"novel_view": {"tight": 4.6, "loose": 7.4}, "novel_pose": {"tight": 1.1, "loose": 0.7}}
LEVEL_TITLES = dict(zip(ON_EXACT, ("ASH", "DDC", "fixed mesh, best texture"), strict=True))


@dataclass(frozen=True, kw_only=True, slots=True)
class Margin:
    """Foreground PSNR of ASH minus DDC in dB on templates of one error; the interval needs two seeds."""

    error_mm: float  # root mean square
    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Level:
    """Foreground PSNR in dB of one method on templates of known error, least error first."""

    method: str  # its name on the exact surface
    qualities: tuple[tuple[float, Interval], ...]  # error in mm rms, mean over seeds


@dataclass(frozen=True, kw_only=True, slots=True)
class MarginCurve:
    """A scene and split: margins on templates of known error, least error first, and on the methods' own template."""

    scene: str
    split: str
    levels: tuple[Level, ...]
    known: tuple[Margin, ...]
    honest: Margin | None
    paper_db: float | None  # the paper's margin on such clothes

    @property
    def crossing_mm(self) -> float | None:
        """The error at which the two are equal, between measured ones; None: one leads throughout."""
        return self.error_at(0.0)

    def error_at(self, margin_db: float) -> float | None:
        """The least error at which the margin is reached, linear between measured errors."""
        for a, b in zip(self.known, self.known[1:], strict=False):
            if (a.mean - margin_db) * (b.mean - margin_db) <= 0 and a.mean != b.mean:
                return a.error_mm + (margin_db - a.mean) / (b.mean - a.mean) * (b.error_mm - a.error_mm)
        return None


def margin_curves(scores: Scores) -> tuple[MarginCurve, ...]:
    """A curve per scene and split, for scenes on which both methods ran with two errors or more."""
    found = []
    for scene, split in product(scores.scenes, PAPER_DB):
        known = [_margin(scores, scene, split, ash, ddc, float(mm)) for mm, (ash, ddc, _) in WRONG_BY_MM.items()]
        there = tuple(margin for margin in known if margin is not None)
        if len(there) > 1:
            template = scores.get(scene, "ash", Quantity(split, "", "template_mm"))
            found.append(
                MarginCurve(
                    scene=scene,
                    split=split,
                    levels=_levels(scores, scene, split),
                    known=there,
                    honest=_margin(scores, scene, split, "ash", "ddc", template.mean) if template else None,
                    paper_db=PAPER_DB[split].get(scene),
                )
            )
    return tuple(found)


def sentence(curve: MarginCurve) -> str:
    """The finding in one sentence."""
    first, last = curve.known[0], curve.known[-1]
    text = f"On {curve.scene}, {SPLIT_NAMES[curve.split].words}: "
    text += f"ASH minus DDC goes from {first.mean:+.1f} dB at {first.error_mm:g} mm"
    text += f" to {last.mean:+.1f} dB at {last.error_mm:g} mm of template error"
    crossing = curve.crossing_mm
    text += f"; the two are equal at {crossing:.1f} mm" if crossing is not None else "; one leads throughout"
    if curve.paper_db is not None:
        at = curve.error_at(curve.paper_db)
        reached = "is not reached" if at is None else f"is reached at {at:.1f} mm"
        text += f"; the paper's {curve.paper_db:+.1f} dB {reached}"
    if curve.honest is not None:
        text += f"; with the honest template ({curve.honest.error_mm:.1f} mm) it is {curve.honest.mean:+.1f} dB"
    return text + "."


def _levels(scores: Scores, scene: str, split: str) -> tuple[Level, ...]:
    """A level per method; of failed ones nothing."""
    found = []
    for column, method in enumerate(ON_EXACT):
        names = {float(mm): row[column] for mm, row in WRONG_BY_MM.items() if scores.whole(scene, row[column])}
        values = {mm: scores.values(scene, name, foreground(split)) for mm, name in names.items()}
        qualities = tuple((mm, mean_interval(quality)) for mm, quality in values.items() if quality)
        if qualities:
            found.append(Level(method=method, qualities=qualities))
    return tuple(found)


def _margin(scores: Scores, scene: str, split: str, ash: str, ddc: str, error_mm: float) -> Margin | None:
    test = difference(scores, scene, ash, ddc, split)
    if test is None:
        return None
    low, high = (None, None) if math.isnan(test.low) else (test.low, test.high)
    return Margin(error_mm=error_mm, mean=test.mean, low=low, high=high)
