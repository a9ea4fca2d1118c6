"""Which differences between methods are established, and how large a difference the run could have found."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.analysis.pareto import Contender
from benchmarks.analysis.scores import FRAME_MS, RANKED_SPLITS, Scores, foreground
from benchmarks.analysis.statistics import Difference, compared, detectable, hierarchical_bootstrap, holm
from benchmarks.analysis.style import style_of
from benchmarks.cell.methods import is_oracle

COUNTS = (1, 2, 4, 8, 16)  # of captures, for which reports say what they would show


@dataclass(frozen=True, kw_only=True, slots=True)
class Contrast:
    """A reference method minus another one, foreground PSNR in dB."""

    split: str
    method: str
    test: Difference
    p_adjusted: float
    bootstrap: tuple[float, float]

    @property
    def significant(self) -> bool:
        """Whether chance is excluded at 5 % among all contrasts of the scene."""
        return self.p_adjusted < 0.05

    @property
    def title(self) -> str:
        """The other method, for readers."""
        return style_of(self.method).title


def difference(scores: Scores, scene: str, ours: str, theirs: str, split: str) -> Difference | None:
    """Foreground PSNR of one method minus another's in dB; None where either was not run, or failed."""
    if not scores.whole(scene, ours, theirs):
        return None
    return compared(*(scores.samples(scene, method, foreground(split)) for method in (ours, theirs)))


def contrasts(
    scores: Scores, scene: str, *, reference: str = "ash", splits: Sequence[str] = RANKED_SPLITS
) -> tuple[Contrast, ...]:
    """The reference against every other method that is no oracle, on these splits; needs two seeds.

    One call is one family of tests: the splits that are not ranked, asked for apart, cost the ranked ones no power.
    """
    tests = [found for found in differences(scores, scene, reference, splits) if not np.isnan(found[2].p)]
    adjusted = holm([test.p for _, _, test in tests])
    return tuple(
        Contrast(
            split=split, method=m, test=test, p_adjusted=p, bootstrap=_bootstrap(scores, scene, reference, m, split)
        )
        for (split, m, test), p in zip(tests, adjusted, strict=True)
    )


def differences(
    scores: Scores, scene: str, reference: str = "ash", splits: Sequence[str] = RANKED_SPLITS
) -> list[tuple[str, str, Difference]]:
    """Split, method and what the reference is ahead of it, for every other method that is no oracle."""
    return [
        (split, theirs, test)
        for split in splits
        for theirs in scores.methods(scene)
        if theirs != reference and not is_oracle(theirs)
        if (test := difference(scores, scene, reference, theirs, split)) is not None
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class DetectableEffect:
    """The smallest true difference, dB, that so many captures in pairs show: of the middle row, and of the worst."""

    captures: int
    middle: float
    worst: float


def detectable_effects(found: Sequence[Contrast], split: str) -> tuple[DetectableEffect, ...]:
    """What 1, 2, 4, 8 and 16 captures would show; of contrasts over a single capture nothing is known."""
    spreads = [contrast.test.spread for contrast in found if contrast.split == split and contrast.test.pairs]
    if not spreads:
        return ()
    return tuple(
        DetectableEffect(
            captures=captures,
            middle=detectable(float(np.median(spreads)), captures),
            worst=detectable(max(spreads), captures),
        )
        for captures in COUNTS
    )


def candidates(scores: Scores, scene: str, split: str) -> tuple[Contender, ...]:
    """The methods that compete on a scene, with foreground PSNR and milliseconds per frame.

    They are judged on the captures that all of them were run on.
    """
    found = []
    for method in scores.methods(scene):
        frame, samples = scores.get(scene, method, FRAME_MS), scores.samples(scene, method, foreground(split))
        if frame and samples and not is_oracle(method) and scores.whole(scene, method):
            found.append(Contender(name=method, samples=samples, cost=frame.mean))
    shared = set.intersection(*(set(contender.samples) for contender in found)) if found else set()
    kept = [replace(c, samples={name: own for name, own in c.samples.items() if name in shared}) for c in found]
    return tuple(kept) if shared else ()


def _bootstrap(scores: Scores, scene: str, ours: str, theirs: str, split: str) -> tuple[float, float]:
    """Interval of the difference by drawing captures (of a single one, seeds) and images anew; NaN without images."""
    unknown = (math.nan, math.nan)
    if scores.images.empty:
        return unknown
    a, b = (scores.per_image(scene, method, split) for method in (ours, theirs))
    pairs = scores.captures(scene) > 1
    if pairs:
        a, b = (rows.groupby(level="capture").mean() for rows in (a, b))
        shared = a.index.intersection(b.index)
        a, b = a.loc[shared], b.loc[shared]
    if a.empty or not a.columns.equals(b.columns) or a.isna().any(axis=None) or b.isna().any(axis=None):
        return unknown
    return hierarchical_bootstrap(a.to_numpy(), b.to_numpy(), rng=np.random.default_rng(0), pairs=pairs)
