"""Which differences between methods are established, and how large a difference the run could have found."""

from dataclasses import dataclass

import numpy as np

from benchmarks.analysis.names import look_of
from benchmarks.analysis.pareto import Contender
from benchmarks.analysis.scores import FRAME_MS, RANKED_SPLITS, Scores, foreground
from benchmarks.analysis.statistics import Difference, hierarchical_bootstrap, holm, paired, welch
from benchmarks.cell.methods import is_oracle


@dataclass(frozen=True, kw_only=True, slots=True)
class Contrast:
    """A reference method minus another one, foreground PSNR in dB."""

    split: str
    method: str
    test: Difference
    p_adjusted: float
    bootstrap: tuple[float, float]

    @property
    def established(self) -> bool:
        """Whether chance is excluded at 5 % among all contrasts of the scene."""
        return self.p_adjusted < 0.05

    @property
    def title(self) -> str:
        """The other method, for readers."""
        return look_of(self.method).title


def difference(scores: Scores, scene: str, ours: str, theirs: str, split: str) -> Difference | None:
    """Foreground PSNR of one method minus another's in dB; None where either was not run, or failed.

    Over the captures in pairs, where the scene has several; else over the seeds. A single value knows no interval: then
    it is NaN, and so is p.
    """
    a, b = (scores.values(scene, method, foreground(split)) for method in (ours, theirs))
    if not a or not b or not scores.whole(scene, ours, theirs):
        return None
    if len(a) > 1 and len(b) > 1:
        return paired(a, b) if scores.captures(scene) > 1 and len(a) == len(b) else welch(a, b)
    unknown = {name: float("nan") for name in ("low", "high", "p", "effect", "detectable")}
    return Difference(mean=float(np.mean(a) - np.mean(b)), **unknown)


def contrasts(scores: Scores, scene: str, *, reference: str = "ash") -> tuple[Contrast, ...]:
    """The reference against every other method that is no oracle; needs two seeds."""
    tests = [
        (split, theirs, test)
        for split in RANKED_SPLITS
        for theirs in scores.methods(scene)
        if theirs != reference and not is_oracle(theirs)
        if (test := difference(scores, scene, reference, theirs, split)) is not None and not np.isnan(test.p)
    ]
    adjusted = holm([test.p for _, _, test in tests])
    return tuple(
        Contrast(
            split=split, method=m, test=test, p_adjusted=p, bootstrap=_bootstrap(scores, scene, reference, m, split)
        )
        for (split, m, test), p in zip(tests, adjusted, strict=True)
    )


def candidates(scores: Scores, scene: str, split: str) -> tuple[Contender, ...]:
    """The methods that compete on a scene, with foreground PSNR per seed and milliseconds per frame."""
    found = []
    for method in scores.methods(scene):
        frame, values = scores.get(scene, method, FRAME_MS), scores.values(scene, method, foreground(split))
        if frame and values and not is_oracle(method) and scores.whole(scene, method):
            found.append(Contender(name=method, qualities=tuple(values), cost=frame.mean))
    return tuple(found)


def _bootstrap(scores: Scores, scene: str, ours: str, theirs: str, split: str) -> tuple[float, float]:
    a, b = (scores.per_image(scene, method, split) for method in (ours, theirs))
    if a.empty or not a.columns.equals(b.columns) or a.isna().any(axis=None) or b.isna().any(axis=None):
        return float("nan"), float("nan")
    pairs = scores.captures(scene) > 1
    if pairs:
        a, b = (rows.groupby(level="capture").mean() for rows in (a, b))
        if not a.index.equals(b.index):
            return float("nan"), float("nan")
    return hierarchical_bootstrap(a.to_numpy(), b.to_numpy(), rng=np.random.default_rng(0), pairs=pairs)
