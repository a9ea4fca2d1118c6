"""Accuracy against cost: who is beaten by nobody, how much the whole field covers, and what would have sufficed.

Qualities are larger-is-better (dB), costs smaller-is-better (ms). Oracles take no part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.analysis.statistics import Difference, Samples, compared, redrawn

SUFFICIENT_DB = 0.5  # A loss that readers of images do not see, and three seeds can establish.
REFERENCE_MS, REFERENCE_DB = 1000.0, 10.0  # The hypervolume's fixed corner: a frame per second of noise.


@dataclass(frozen=True, kw_only=True, slots=True)
class Contender:
    """A method with its quality for each seed, by capture, and its cost."""

    name: str
    samples: Samples
    cost: float

    @property
    def quality(self) -> float:
        """Mean over captures of their seeds' means."""
        return float(np.mean([np.mean(own) for own in self.samples.values()]))


@dataclass(frozen=True, kw_only=True, slots=True)
class Sufficient:
    """The cheapest candidate that is not inferior to the best, and the bound of its loss that says so."""

    name: str
    best: str
    loss_bound_db: float


def front(candidates: Sequence[Contender]) -> tuple[str, ...]:
    """Names of those that no other beats in both quality and cost, cheapest first."""
    kept = [c for c in candidates if not any(_dominates(other, c) for other in candidates)]
    return tuple(c.name for c in sorted(kept, key=lambda c: c.cost))


def hypervolume(candidates: Sequence[Contender]) -> float:
    """Area that the front covers up to the fixed corner, in dB times decades of time."""
    return _area([c.quality for c in candidates], [c.cost for c in candidates])


def hypervolume_interval(
    candidates: Sequence[Contender], *, rng: np.random.Generator, resamples: int = 1000
) -> tuple[float, float]:
    """95 % interval of the hypervolume by drawing captures anew, or of a single one, seeds."""
    samples, costs = [c.samples for c in candidates], [c.cost for c in candidates]
    areas = [_area(redrawn(samples, rng=rng), costs) for _ in range(resamples)]
    low, high = np.quantile(areas, [0.025, 0.975])
    return float(low), float(high)


def smallest_sufficient(candidates: Sequence[Contender], *, margin: float = SUFFICIENT_DB) -> Sufficient | None:
    """The cheapest candidate whose loss to the best has an upper 95 % bound (one-sided) below the margin.

    Captures are compared in pairs; on a single one, seeds. None where there is one of each, for it bounds nothing. The
    best itself loses nothing and always qualifies.
    """
    if not candidates:
        return None
    best = max(candidates, key=lambda c: c.quality)
    for candidate in sorted(candidates, key=lambda c: c.cost):
        loss = compared(best.samples, candidate.samples, level=0.90)
        if loss is None or math.isnan(loss.high):
            return None
        if candidate is best or loss.high < margin:
            return Sufficient(name=candidate.name, best=best.name, loss_bound_db=loss.high)
    return None


@dataclass(frozen=True, kw_only=True, slots=True)
class Confirmation:
    """What choosing the smallest sufficient costs on captures that had no say in it."""

    loss_db: float  # mean over the captures left out: the choice against the best, both found on the others
    same: int  # of how many captures left out the others choose what all choose
    captures: int


def confirmed(candidates: Sequence[Contender]) -> Confirmation | None:
    """Choose on all captures but one, look at that one, and so for each in turn; None of fewer than three."""
    chosen = smallest_sufficient(candidates)
    captures = list(candidates[0].samples) if candidates else []
    if chosen is None or len(captures) < 3:
        return None
    losses, same = [], 0
    for capture in captures:
        others = [replace(c, samples={k: own for k, own in c.samples.items() if k != capture}) for c in candidates]
        found = smallest_sufficient(others)
        if found is None:
            return None
        here = {c.name: float(np.mean(c.samples[capture])) for c in candidates}
        losses.append(here[found.best] - here[found.name])
        same += found.name == chosen.name
    return Confirmation(loss_db=float(np.mean(losses)), same=same, captures=len(captures))


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """A choice that other captures made, judged on these: what the chosen row loses to the one that was best there."""

    name: str
    best: str
    loss: Difference  # on these captures; 90 % interval, whose upper bound is the one-sided one of the choice

    @property
    def verdict(self) -> Literal["suffices", "too little", "unclear"]:
        """Whether the loss is surely below the margin here, too, or surely above it."""
        if self.loss.high < SUFFICIENT_DB:
            return "suffices"
        return "too little" if self.loss.low > SUFFICIENT_DB else "unclear"


def chosen_elsewhere(candidates: Sequence[Contender], elsewhere: Sequence[Contender]) -> Judged | None:
    """The smallest sufficient by other captures, judged on these; among the rows that both have.

    None where the others bound nothing, or no row is shared.
    """
    here = {c.name: c for c in candidates}
    found = smallest_sufficient([c for c in elsewhere if c.name in here])
    if found is None:
        return None
    loss = compared(here[found.best].samples, here[found.name].samples, level=0.90)
    return None if loss is None else Judged(name=found.name, best=found.best, loss=loss)


def _area(qualities: Sequence[float], costs: Sequence[float]) -> float:
    area, reached = 0.0, REFERENCE_DB
    for cost, quality in sorted(zip(costs, qualities, strict=True)):
        if cost < REFERENCE_MS and quality > reached:
            area += math.log10(REFERENCE_MS / cost) * (quality - reached)
            reached = quality
    return area


def _dominates(a: Contender, b: Contender) -> bool:
    return a.quality >= b.quality and a.cost <= b.cost and (a.quality > b.quality or a.cost < b.cost)
