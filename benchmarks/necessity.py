"""What each scene needs: the loss when one part of ASH is taken away, scene by scene, with its certainty."""

from dataclasses import dataclass
from typing import Literal

from benchmarks.names import look_of
from benchmarks.scores import Scores
from benchmarks.statistics import welch

Verdict = Literal["needed", "not needed", "harmful", "unclear", "unknown"]

PARTS = ("wo_mot", "wo_disp", "mlp")  # ASH without one part, or with a plainer one in its place
MARGIN_DB = 0.2  # A loss below this is no need.


@dataclass(frozen=True, kw_only=True, slots=True)
class Loss:
    """Foreground PSNR in dB that a scene loses when a part is taken away; the interval needs two seeds."""

    method: str
    mean: float
    low: float | None
    high: float | None

    @property
    def verdict(self) -> Verdict:
        """What the interval allows to say, with `MARGIN_DB` as the least loss that counts."""
        if self.low is None or self.high is None:
            return "unknown"
        if self.low > MARGIN_DB:
            return "needed"
        if self.high < -MARGIN_DB:
            return "harmful"
        return "not needed" if self.high < MARGIN_DB else "unclear"

    @property
    def text(self) -> str:
        """The loss and its interval."""
        interval = "" if self.low is None else f" [{self.low:+.2f}, {self.high:+.2f}]"
        return f"{self.mean:+.2f}{interval}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Needs:
    """A row of the matrix: one scene, one loss per part (None: not run there)."""

    scene: str
    losses: tuple[Loss | None, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Matrix:
    """Scenes by parts for one split."""

    title: str
    parts: tuple[str, ...]
    rows: tuple[Needs, ...]


def matrix(scores: Scores, split: str, *, title: str) -> Matrix | None:
    """The necessity matrix of a run, or None where it has fewer than two scenes with ASH and an ablation of it."""
    parts = [part for part in PARTS if any(part in scores.methods(scene) for scene in scores.scenes)]
    scenes = [scene for scene in scores.scenes if "ash" in scores.methods(scene)]
    if len(scenes) < 2 or not parts:
        return None
    rows = [Needs(scene=scene, losses=tuple(_loss(scores, scene, part, split) for part in parts)) for scene in scenes]
    return Matrix(title=title, parts=tuple(look_of(part).title for part in parts), rows=tuple(rows))


def _loss(scores: Scores, scene: str, part: str, split: str) -> Loss | None:
    whole, without = (scores.values(scene, method, split, "foreground", "psnr") for method in ("ash", part))
    if not whole or not without or scores.failed(scene, part) or scores.failed(scene, "ash"):
        return None
    if len(whole) > 1 and len(without) > 1:
        test = welch(whole, without)
        return Loss(method=part, mean=test.mean, low=test.low, high=test.high)
    return Loss(method=part, mean=sum(whole) / len(whole) - sum(without) / len(without), low=None, high=None)
