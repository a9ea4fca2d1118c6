"""Quality against the error of the template that methods are given, and ASH minus DDC: where the two cross.

A fixed mesh with the best texture stands beside them: what geometry of such an error is worth by itself.
"""

import math
from dataclasses import dataclass
from itertools import pairwise, product

from benchmarks.analysis.contrasts import difference
from benchmarks.analysis.scores import Quantity, Scores, foreground
from benchmarks.analysis.statistics import Interval, mean_interval
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.methods import ON_EXACT, WRONG_BY_MM

# ASH (CVPR 2024), Table 1: PSNR of ASH minus DDC, tight and loose clothes.
PAPER_DB = {"novel_view": {"tight": 4.6, "loose": 7.4}, "novel_pose": {"tight": 1.1, "loose": 0.7}}
# Templates that both methods learned: from what, and the rows that stand on it.
LEARNED = {"images": ("ash", "ddc"), "scans": ("by_scans", "ddc_by_scans")}
# Rows of ASH that differ from each other in the template alone.
PLACED = ("ash", "by_scans", "by_graph", "unlearned")
LEVEL_TITLES = dict(zip(ON_EXACT, ("ASH", "DDC", "fixed mesh, best texture"), strict=True))


@dataclass(frozen=True, kw_only=True, slots=True)
class Margin:
    """Foreground PSNR of ASH minus DDC in dB on templates of one error; the interval needs two seeds or captures."""

    error_mm: float  # root mean square
    template: str  # "planted", or what it was learned from
    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Level:
    """Foreground PSNR in dB of one method on templates of known error, least error first."""

    method: str  # its name on the exact surface
    qualities: tuple[tuple[float, Interval], ...]  # error in mm rms, mean over seeds


@dataclass(frozen=True, kw_only=True, slots=True)
class PlacedTemplate:
    """ASH on a template of its own, beside what planted errors of that size and of learned templates' kind allow."""

    method: str
    error_mm: float
    psnr: float
    planted_psnr: float | None  # between the planted errors around it; None: beyond all of them


@dataclass(frozen=True, kw_only=True, slots=True)
class MarginCurve:
    """A scene and split: margins on templates of planted error, least error first, and on learned templates.

    Planted errors are of the kind that learned templates have: `ash.config.TemplateConfig` says how static and how
    lasting, as measured in canonical space. So a learned template has its place on the curve.
    """

    scene: str
    split: str
    levels: tuple[Level, ...]
    known: tuple[Margin, ...]
    learned: tuple[Margin, ...]
    placed: tuple[PlacedTemplate, ...]
    paper_db: float | None  # the paper's margin on such clothes

    @property
    def crossing_mm(self) -> float | None:
        """The error at which the two are equal, between measured ones; None: one leads throughout."""
        return self.error_at(0.0)

    def margin_at(self, error_mm: float) -> float | None:
        """The margin on planted errors of a size, linear between measured ones; None beyond them."""
        return _between([(margin.error_mm, margin.mean) for margin in self.known], error_mm)

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
        known = [
            _margin(scores, scene, split, (ash, ddc), float(mm), "planted") for mm, (ash, ddc, _) in WRONG_BY_MM.items()
        ]
        there = tuple(margin for margin in known if margin is not None)
        if len(there) > 1:
            levels = _levels(scores, scene, split)
            found.append(
                MarginCurve(
                    scene=scene,
                    split=split,
                    levels=levels,
                    known=there,
                    learned=_learned(scores, scene, split),
                    placed=_placed(scores, scene, split, levels),
                    paper_db=PAPER_DB[split].get(scene),
                )
            )
    return tuple(found)


def _learned(scores: Scores, scene: str, split: str) -> tuple[Margin, ...]:
    found = []
    for template, rows in LEARNED.items():
        error = scores.get(scene, rows[0], Quantity(split, "", "template_mm"))
        margin = _margin(scores, scene, split, rows, error.mean, template) if error else None
        found += [margin] if margin else []
    return tuple(found)


def _placed(scores: Scores, scene: str, split: str, levels: tuple[Level, ...]) -> tuple[PlacedTemplate, ...]:
    curve = [(mm, psnr.mean) for level in levels if level.method == ON_EXACT[0] for mm, psnr in level.qualities]
    found = []
    for method in PLACED:
        error = scores.get(scene, method, Quantity(split, "", "template_mm"))
        psnr = scores.get(scene, method, foreground(split))
        if error and psnr and scores.whole(scene, method):
            planted = _between(curve, error.mean)
            found.append(PlacedTemplate(method=method, error_mm=error.mean, psnr=psnr.mean, planted_psnr=planted))
    return tuple(found)


def _between(points: list[tuple[float, float]], place: float) -> float | None:
    """The value at a place, linear between points in rising order; None beyond them."""
    for (a, low), (b, high) in pairwise(points):
        if a <= place <= b:
            return low + (place - a) / (b - a) * (high - low)
    return None


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
    for margin in curve.learned:
        text += (
            f"; on the template learned from {margin.template} ({margin.error_mm:.1f} mm) it is {margin.mean:+.1f} dB"
        )
        planted = curve.margin_at(margin.error_mm)
        text += "" if planted is None else f", on a planted error of that size {planted:+.1f} dB"
    return text + "."


def placement(curve: MarginCurve) -> str:
    """Where ASH stands on templates of its own, in one sentence; empty where it has none."""
    said = []
    for placed in curve.placed:
        text = f"{style_of(placed.method).title} {placed.psnr:.1f} dB at {placed.error_mm:.1f} mm"
        said.append(text if placed.planted_psnr is None else f"{text} ({placed.planted_psnr:.1f})")
    if not said:
        return ""
    where = f"On {curve.scene}, {SPLIT_NAMES[curve.split].words}"
    return f"{where}, by template (in brackets: a planted error of that size): {'; '.join(said)}."


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


def _margin(
    scores: Scores, scene: str, split: str, rows: tuple[str, str], error_mm: float, template: str
) -> Margin | None:
    test = difference(scores, scene, *rows, split)
    if test is None:
        return None
    low, high = (None, None) if math.isnan(test.low) else (test.low, test.high)
    return Margin(error_mm=error_mm, template=template, mean=test.mean, low=low, high=high)
