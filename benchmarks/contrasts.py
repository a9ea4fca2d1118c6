"""Which differences between methods are established, and how large a difference the run could have found."""

from dataclasses import dataclass

import numpy as np

from benchmarks.names import is_oracle, look_of
from benchmarks.pareto import Candidate
from benchmarks.scores import Scores
from benchmarks.statistics import Difference, hierarchical_bootstrap, holm, welch

RANKED_SPLITS = ("novel_view", "novel_pose")


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


def contrasts(scores: Scores, scene: str, *, reference: str = "ash") -> tuple[Contrast, ...]:
    """The reference against every other method that is no oracle; needs two seeds."""
    pairs = [(split, reference, other) for split in RANKED_SPLITS for other in _rivals(scores, scene, reference)]
    tests = []
    for split, ours, theirs in pairs:
        a, b = (scores.values(scene, method, split, "foreground", "psnr") for method in (ours, theirs))
        if len(a) > 1 and len(b) > 1:
            tests.append((split, theirs, welch(a, b), _bootstrap(scores, scene, ours, theirs, split)))
    adjusted = holm([test.p for _, _, test, _ in tests])
    return tuple(
        Contrast(split=split, method=method, test=test, p_adjusted=p, bootstrap=interval)
        for (split, method, test, interval), p in zip(tests, adjusted, strict=True)
    )


def candidates(scores: Scores, scene: str, split: str) -> tuple[Candidate, ...]:
    """The methods that compete on a scene, with foreground PSNR per seed and milliseconds per frame."""
    found = []
    for method in scores.methods(scene):
        frame = scores.get(scene, method, "speed", "", "frame_ms")
        values = scores.values(scene, method, split, "foreground", "psnr")
        if frame and values and not is_oracle(method) and not scores.failed(scene, method):
            found.append(Candidate(name=method, qualities=tuple(values), cost=frame.mean))
    return tuple(found)


def _rivals(scores: Scores, scene: str, reference: str) -> list[str]:
    methods = scores.methods(scene)
    if reference not in methods or scores.failed(scene, reference):
        return []
    return [m for m in methods if m != reference and not is_oracle(m) and not scores.failed(scene, m)]


def _bootstrap(scores: Scores, scene: str, ours: str, theirs: str, split: str) -> tuple[float, float]:
    a, b = (_per_image(scores, scene, method, split) for method in (ours, theirs))
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or a.shape[1] == 0:
        return float("nan"), float("nan")
    return hierarchical_bootstrap(a, b, rng=np.random.default_rng(0))


def _per_image(scores: Scores, scene: str, method: str, split: str) -> np.ndarray:
    """Foreground PSNR `[seeds, images]`, images in the protocol's order."""
    rows = []
    for cell in scores.cells(scene, method):
        rows.append([view.scores["foreground", "psnr"] for view in cell.views if view.split == split])
    return np.array(rows, dtype=float) if len({len(row) for row in rows}) == 1 else np.empty(0)
