"""What each scene needs: the loss when one part of ASH is taken away, scene by scene, against what should be needed.

The parts are the rows that a run has. Few people tell little about how far a loss spreads over people, so the cells of
a matrix lend each other their variances (Smyth 2004). Significance is corrected over all of them (Benjamini and
Hochberg 1995), so that one in twenty of what is called needed, at most, is so by chance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from scipy import stats

from benchmarks.analysis.contrasts import difference
from benchmarks.analysis.scores import Scores
from benchmarks.analysis.statistics import Difference, moderated
from benchmarks.analysis.style import style_of
from benchmarks.cell.methods import is_oracle
from synth.presets import RUNGS

Verdict = Literal["needed", "not needed", "harmful", "unclear", "unknown"]

WHOLE = "ash"  # the row that has every part
REFERENCES = ("static", "nearest")  # They are less than ASH without one part.
RIVAL = "ddc"  # a column of its own: what a mesh would lose in ASH's place
# Of spherical harmonics ASH has degree 0 in our presets: what a degree is worth is told against the highest that ran.
COLOUR = "sh_3"  # what the part is called, whichever degree was the highest
DEGREES = {COLOUR: 3, "sh_2": 2, "sh_1": 1}
# The expected diagonal: which rows lack what the one phenomenon of a scene asks for. Who lacks all motion lacks its
# window as well; decoders are off without motion, which `skinned` should not effect.
EXPECTED = {
    "splats": (),
    "still": (),
    "skinned": (),
    "wrinkles": ("wo_mot", "wo_disp", "wo_offset"),
    "swing": ("wo_mot", "window_1", "unlearned"),
    "lit": ("wo_phi", "wo_light", "wo_phi_and_light"),
    "glossy": (COLOUR,),
    "turning": ("wo_heading",),
    "loose": ("unlearned",),
}
# Where a surprise has an experiment: the scene that shows why, and what is different there.
OVERCAST = ("overcast", "under an even sky, where no lamp casts shadows")
EXPERIMENTS = {
    **{(scene, "wo_mot"): OVERCAST for scene in ("skinned", "lit", "turning")},
    ("turning", "wo_heading"): ("turned_wrinkles", "with wrinkles to decode at headings never seen"),
    ("wrinkles", "wo_disp"): ("wrinkles_twice", "with wrinkles twice as large"),
}
ON_TRIAL = tuple(dict.fromkeys(row for rows in EXPECTED.values() for row in rows))  # Of others nothing is expected.
ZERO_DOSE = "skinned"  # A rung of strength 0 has its images, bit for bit.
DOSES = {"_half": 0.5, "": 1.0, "_twice": 2.0}  # how a scene's name ends, times the rung's strength
MARGIN_DB = 0.2  # A loss below this is no effect.
LEVEL = 0.05


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """A column: what is lost from the row that has the part to the row that has not."""

    row: str  # by which a scene asks for it
    within: str
    without: str

    @property
    def title(self) -> str:
        """What is missing, for readers."""
        if self.row not in DEGREES:
            return style_of(self.row).title
        return f"SH {DEGREES.get(self.without, 0)}, not {DEGREES[self.within]}"


@dataclass(frozen=True, kw_only=True, slots=True)
class AblationEffect:
    """A cell: foreground PSNR lost without the part in dB (None: not run there), with p corrected over all cells."""

    scene: str
    part: Part
    loss: Difference | None
    p_adjusted: float = math.nan
    elsewhere: Difference | None = None  # the same loss in the experiment of `EXPERIMENTS`

    @property
    def expected(self) -> bool:
        """Whether the scene's phenomenon asks for the part."""
        return self.part.row in EXPECTED.get(self.scene, ())

    @property
    def verdict(self) -> Verdict:
        """What the numbers allow to say, with `MARGIN_DB` as the least loss that counts."""
        if self.loss is None or math.isnan(self.loss.low):
            return "unknown"
        if self.p_adjusted < LEVEL and abs(self.loss.mean) > MARGIN_DB:
            return "needed" if self.loss.mean > 0 else "harmful"
        return "not needed" if self.loss.high < MARGIN_DB else "unclear"

    @property
    def surprise(self) -> str:
        """How the cell contradicts the expected diagonal; empty where it does not."""
        if self.loss is None or self.scene not in EXPECTED or self.part.row not in ON_TRIAL:
            return ""
        what = f"{self.scene}, {self.part.title}: {told(self.loss)}"
        if self.expected and self.verdict in ("not needed", "harmful"):
            return f"{what}, {self.verdict} where it should be needed.{self._experiment}"
        if not self.expected and self.verdict in ("needed", "harmful"):
            return f"{what}, {self.verdict} though nothing in the scene asks for it.{self._experiment}"
        return ""

    @property
    def _experiment(self) -> str:
        if self.elsewhere is None:
            return ""
        scene, differs = EXPERIMENTS[self.scene, self.part.row]
        return f" By experiment, {differs} ({scene}): {told(self.elsewhere)}."


@dataclass(frozen=True, kw_only=True, slots=True)
class Matrix:
    """Scenes by parts for one split, scene after scene."""

    split: str
    scenes: tuple[str, ...]
    parts: tuple[Part, ...]
    effects: tuple[AblationEffect, ...]

    @property
    def has_intervals(self) -> bool:
        """Whether a cell has one; without any, nothing can be told."""
        return any(effect.verdict != "unknown" for effect in self.effects)


@dataclass(frozen=True, kw_only=True, slots=True)
class Dose:
    """What one expected part is worth on one rung, by its strength: times that of the ladder, and the loss."""

    scene: str
    part: Part
    losses: tuple[tuple[float, Difference], ...]

    @property
    def rises(self) -> bool:
        """Whether the loss grows with every dose."""
        means = [loss.mean for _, loss in self.losses]
        return all(a < b for a, b in pairwise(means))


def matrix(scores: Scores, split: str) -> Matrix | None:
    """The necessity matrix of a run, or None where it has fewer than two scenes with ASH and an ablation of it."""
    scenes = tuple(scene for scene in _scenes(scores) if not _is_dose(scene))
    parts = parts_of(scores)
    if len(scenes) < 2 or all(part.row == RIVAL for part in parts):
        return None
    found = losses(scores, split)
    effects = [
        AblationEffect(
            scene=scene,
            part=part,
            loss=found.get((scene, part)),
            elsewhere=found.get((EXPERIMENTS.get((scene, part.row), ("", ""))[0], part)),
        )
        for scene in scenes
        for part in parts
    ]
    return Matrix(split=split, scenes=scenes, parts=parts, effects=corrected(effects))


def losses(scores: Scores, split: str) -> dict[tuple[str, Part], Difference]:
    """What every scene loses without every part that was tried there, with variances that these lend each other.

    The rival's column spreads over people by causes of its own, and neither lends nor borrows.
    """
    parts = parts_of(scores)
    found = {
        (scene, part): loss
        for scene in _scenes(scores)
        for part in parts
        if (loss := difference(scores, scene, part.within, part.without, split)) is not None
    }
    lenders = [place for place in found if place[1].row != RIVAL]
    return found | dict(zip(lenders, moderated([found[place] for place in lenders]), strict=True))


def _scenes(scores: Scores) -> tuple[str, ...]:
    return tuple(scene for scene in scores.scenes if WHOLE in scores.methods(scene))


def told(loss: Difference) -> str:
    """A loss with its interval, where one is known."""
    interval = "" if math.isnan(loss.low) else f" [{loss.low:+z.2f}, {loss.high:+z.2f}]"
    return f"{loss.mean:+z.2f} dB{interval}"


def parts_of(scores: Scores) -> tuple[Part, ...]:
    """The columns: every row that competes with ASH somewhere, those of the expected diagonal first."""
    rows = dict.fromkeys(row for scene in _scenes(scores) for row in scores.methods(scene))
    highest = next((row for row in DEGREES if row in rows), "")
    parts = []
    for row in sorted(rows, key=_column):
        if row == WHOLE or row in REFERENCES or is_oracle(row):
            continue
        if row == highest:
            parts.append(Part(row=COLOUR, within=highest, without=WHOLE))
        elif (within := highest if row in DEGREES else WHOLE) in rows:
            parts.append(Part(row=row, within=within, without=row))
    return tuple(parts)


def _column(row: str) -> tuple[int, int]:
    """Where a row stands: in the order of the expected diagonal, degrees from the highest on, all others behind."""
    beside = COLOUR if row in DEGREES else row
    return ON_TRIAL.index(beside) if beside in ON_TRIAL else len(ON_TRIAL), -DEGREES.get(row, 0)


def corrected(effects: Sequence[AblationEffect]) -> tuple[AblationEffect, ...]:
    """The cells with their p corrected for how many of them there are."""
    known = [effect.loss.p for effect in effects if effect.loss is not None and not math.isnan(effect.loss.p)]
    adjusted = iter(stats.false_discovery_control(known) if known else ())
    return tuple(
        effect
        if effect.loss is None or math.isnan(effect.loss.p)
        else replace(effect, p_adjusted=float(next(adjusted)))
        for effect in effects
    )


def doses(scores: Scores, split: str) -> tuple[Dose, ...]:
    """A course per rung and expected part, for rungs of which a run has two strengths or more."""
    found = losses(scores, split)
    parts = {part.row: part for part in parts_of(scores)}
    courses = []
    for rung in RUNGS:
        places = {0.0: ZERO_DOSE} | {dose: f"{rung}{ending}" for ending, dose in DOSES.items()}
        for part in [parts[row] for row in EXPECTED[rung] if row in parts]:
            course = tuple(
                (dose, found[places[dose], part]) for dose in sorted(places) if (places[dose], part) in found
            )
            if len(course) > 1 and any(dose == 1 for dose, _ in course):
                courses.append(Dose(scene=rung, part=part, losses=course))
    return tuple(courses)


def _is_dose(scene: str) -> bool:
    """Whether a scene is a rung at another strength than its own."""
    return any(scene == f"{rung}{ending}" for rung in RUNGS for ending, dose in DOSES.items() if dose != 1)
