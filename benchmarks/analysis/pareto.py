"""Accuracy against cost: the front, and the cheapest method that loses nothing that matters. Oracles take no part."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.analysis.results import FRAME_MS, RunTables, alike, foreground, samples_of
from benchmarks.analysis.statistics import Comparison, Samples, compare_samples, on_shared_captures

SUFFICIENT_DB = 0.5  # a loss that viewers of images do not notice
ONE_SIDED = 0.90  # level of the two-sided interval whose ends are one-sided 95 % bounds


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """A method: foreground PSNR in dB by capture and seed, and milliseconds per frame."""

    name: str
    samples: Samples
    frame_ms: float

    @property
    def psnr(self) -> float:
        """Mean over captures."""
        return float(np.mean([np.mean(seeds) for seeds in self.samples.values()]))


@dataclass(frozen=True, kw_only=True, slots=True)
class Sufficient:
    """The cheapest candidate that is not inferior to the best one, and the upper 95 % bound of its loss."""

    name: str
    best: str
    loss_bound_db: float


def candidates(tables: RunTables, scene: str, split: str) -> tuple[Candidate, ...]:
    """The methods that compete on a scene, on the captures that all of them were run on; timed on one device."""
    samples = samples_of(tables.of(scene), foreground(split))
    frames = tables.values(scene, FRAME_MS, alike(tables.methods(scene, oracles=False), tables.drawn_on))
    names = [name for name in frames if samples.get(name) and tables.whole(scene, name)]
    shared = on_shared_captures({name: samples[name] for name in names})
    return tuple(Candidate(name=name, samples=seeds, frame_ms=frames[name]) for name, seeds in shared.items())


def front(candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Names of those that no other beats in both quality and cost, cheapest first."""

    def dominates(a: Candidate, b: Candidate) -> bool:
        return a.psnr >= b.psnr and a.frame_ms <= b.frame_ms and (a.psnr, a.frame_ms) != (b.psnr, b.frame_ms)

    front = [each for each in candidates if not any(dominates(other, each) for other in candidates)]
    return tuple(each.name for each in sorted(front, key=lambda each: each.frame_ms))


def smallest_sufficient(candidates: Sequence[Candidate]) -> Sufficient | None:
    """The cheapest whose loss to the best is below `SUFFICIENT_DB` (one-sided 95 % bound); None: nothing is known."""
    if not candidates:
        return None
    best = max(candidates, key=lambda each: each.psnr)
    for candidate in sorted(candidates, key=lambda each: each.frame_ms):
        loss = compare_samples(best.samples, candidate.samples, level=ONE_SIDED)
        if loss is None or math.isnan(loss.high):
            return None
        bound = 0.0 if candidate is best else loss.high
        if bound < SUFFICIENT_DB:
            return Sufficient(name=candidate.name, best=best.name, loss_bound_db=bound)
    return None


def chosen_on_others(here: Sequence[Candidate], others: Sequence[Candidate]) -> tuple[Sufficient, Comparison] | None:
    """The smallest sufficient by other captures, and how it compares here with the one that was best there.

    Among the methods that both have; None where the others bound nothing. The margin is `SUFFICIENT_DB`.
    """
    by_name = {each.name: each for each in here}
    choice = smallest_sufficient([each for each in others if each.name in by_name])
    if choice is None:
        return None
    change = compare_samples(
        by_name[choice.name].samples, by_name[choice.best].samples, margin=SUFFICIENT_DB, level=ONE_SIDED
    )
    return None if change is None else (choice, change)
