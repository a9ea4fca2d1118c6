"""The same renders scored by the conventions of others, and how far each would move the ranking."""

from dataclasses import dataclass

import pandas as pd

from benchmarks.analysis.scores import Quantity, Scores
from benchmarks.analysis.statistics import kendall
from benchmarks.cell.methods import is_oracle

CONVENTIONS = {  # region, and who scores so
    "foreground": "ours: foreground",
    "release_crop": "ASH release: masked crop on white",
    "white_frame": "AnimatableGaussians: frame on white",
    "full": "nerfbaselines: whole frame",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    """Methods (rows) under conventions (columns), for one split and metric; `agreement`: Kendall's tau with ours."""

    split: str
    metric: str
    values: pd.DataFrame
    ranks: pd.DataFrame
    agreement: tuple[float, ...]


def compare(scores: Scores, scene: str, split: str, metric: str) -> Comparison | None:
    """Values, ranks and agreement, oracles left out; None where fewer than two methods were scored so."""
    names = [method for method in scores.methods(scene) if not is_oracle(method)]
    found = {
        region: {m: score.mean for m in names if (score := scores.get(scene, m, Quantity(split, region, metric)))}
        for region in CONVENTIONS
    }
    values = pd.DataFrame(found, index=names)
    if len(names) < 2 or values.isna().any(axis=None):
        return None
    ranks = values.rank(ascending=False, method="min").astype(int)
    agreement = tuple(kendall(list(values["foreground"]), list(values[region])) for region in values)
    return Comparison(split=split, metric=metric, values=values, ranks=ranks, agreement=agreement)
