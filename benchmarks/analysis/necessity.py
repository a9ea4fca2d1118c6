"""What each scene needs: the loss when one part of ASH is taken away, scene by scene, with its certainty."""

import math
from dataclasses import dataclass
from typing import Literal

from benchmarks.analysis.contrasts import difference
from benchmarks.analysis.names import look_of
from benchmarks.analysis.scores import Scores
from benchmarks.analysis.statistics import Difference

Verdict = Literal["needed", "not needed", "harmful", "unclear", "unknown"]

PARTS = ("wo_mot", "wo_disp", "mlp")  # ASH without one part, or with a plainer one in its place
MARGIN_DB = 0.2  # A loss below this is no need.


@dataclass(frozen=True, kw_only=True, slots=True)
class Needs:
    """A row of the matrix: the dB that one scene loses without each part (None: not run there)."""

    scene: str
    losses: tuple[Difference | None, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Matrix:
    """Scenes by parts for one split."""

    split: str
    parts: tuple[str, ...]
    rows: tuple[Needs, ...]


def matrix(scores: Scores, split: str) -> Matrix | None:
    """The necessity matrix of a run, or None where it has fewer than two scenes with ASH and an ablation of it."""
    parts = [part for part in PARTS if any(part in scores.methods(scene) for scene in scores.scenes)]
    scenes = [scene for scene in scores.scenes if "ash" in scores.methods(scene)]
    if len(scenes) < 2 or not parts:
        return None
    rows = [
        Needs(scene=scene, losses=tuple(difference(scores, scene, "ash", part, split) for part in parts))
        for scene in scenes
    ]
    return Matrix(split=split, parts=tuple(look_of(part).title for part in parts), rows=tuple(rows))


def verdict(loss: Difference) -> Verdict:
    """What the interval allows to say, with `MARGIN_DB` as the least loss that counts."""
    if math.isnan(loss.low):
        return "unknown"
    if loss.low > MARGIN_DB:
        return "needed"
    if loss.high < -MARGIN_DB:
        return "harmful"
    return "not needed" if loss.high < MARGIN_DB else "unclear"
