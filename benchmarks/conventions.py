"""The same renders scored by the conventions of others, and how far each would move the ranking."""

from dataclasses import dataclass

from benchmarks.metrics import METRICS
from benchmarks.names import is_oracle, look_of
from benchmarks.scores import Scores


@dataclass(frozen=True, kw_only=True, slots=True)
class Convention:
    """A region, and who scores so."""

    region: str
    title: str


CONVENTIONS = (
    Convention(region="foreground", title="ours: foreground"),
    Convention(region="release_crop", title="ASH release: masked crop on white"),
    Convention(region="white_frame", title="AnimatableGaussians: frame on white"),
    Convention(region="full", title="nerfbaselines: whole frame"),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Standing:
    """One method under every convention: value and rank."""

    name: str
    values: tuple[str, ...]
    ranks: tuple[int, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    """All methods under all conventions for one split and metric; `agreement` is Kendall's tau with ours."""

    title: str
    standings: tuple[Standing, ...]
    agreement: tuple[float, ...]


def compare(scores: Scores, scene: str, split: str, metric: str, *, title: str) -> Comparison | None:
    """Values, ranks and agreement, oracles left out; None where fewer than two methods were scored so."""
    names = [method for method in scores.methods(scene) if not is_oracle(method)]
    columns = []
    for convention in CONVENTIONS:
        found = [scores.get(scene, method, split, convention.region, metric) for method in names]
        if any(score is None for score in found):
            return None
        columns.append([score.mean for score in found if score is not None])
    if len(names) < 2:
        return None
    ranks = [[1 + sum(other > value for other in column) for value in column] for column in columns]
    decimals = METRICS[metric].decimals
    standings = tuple(
        Standing(
            name=look_of(name).title,
            values=tuple(f"{column[i]:.{decimals}f}" for column in columns),
            ranks=tuple(rank[i] for rank in ranks),
        )
        for i, name in enumerate(names)
    )
    return Comparison(title=title, standings=standings, agreement=tuple(kendall(columns[0], c) for c in columns))


def kendall(a: list[float], b: list[float]) -> float:
    """Kendall's tau: the share of pairs in the same order minus that in the opposite one; ties count as neither."""
    pairs = [(i, j) for i in range(len(a)) for j in range(i)]
    signs = [_sign(a[i] - a[j]) * _sign(b[i] - b[j]) for i, j in pairs]
    return sum(signs) / len(pairs)


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
