"""The ASH paper's tables beside ours: its numbers, the order of its rows, and our renders by the conventions of others.

The paper's tables are `[[table]]` in `benchmarks/suites/paper.toml` and `cameras.toml`.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from benchmarks.analysis.results import Quantity, RunTables, samples_of
from benchmarks.analysis.statistics import Interval, mean_interval
from benchmarks.suites.files import suite_file
from benchmarks.suites.tables import TableSpec, tables_of

SUITES = ("paper", "cameras")  # in which the paper's tables stand
SEEN = {  # by the paper's rows that were trained on a part of its views, under our names
    "cams_12": "12 of 120 cameras",
    "cams_30": "30 of 120 cameras",
    "cams_60": "60 of 120 cameras",
    "wo_mot_truncated": "40 s of footage",
}

CONVENTIONS = {  # region, and who scores so
    "foreground": "ours: foreground",
    "release_crop": "ASH release: masked crop on white",
    "white_frame": "AnimatableGaussians: frame on white",
    "full": "nerfbaselines: whole frame",
}
FEWEST_RANKED = 3  # Two rows are no ranking.


def paper_tables() -> list[TableSpec]:
    """The tables of the paper, in its order."""
    files = [suite_file(name) for name in SUITES]
    return [spec for path in files for spec in tables_of(tomllib.loads(path.read_text())["table"], place=path.name)]


@dataclass(frozen=True, kw_only=True, slots=True)
class OrderAgreement:
    """How far rows stand in the order of published numbers (Kendall's tau: 1 the same, 0 unrelated, -1 reversed)."""

    tau: Interval  # mean over people of the order on each; no interval where it is the same on all
    rows: int
    people: int
    chance: float  # share of all orders of as many rows that agree at least as well as the order of the means

    @property
    def tau_text(self) -> str:
        """Tau with its interval."""
        interval = "" if math.isnan(self.tau.low) else f" [{self.tau.low:+.2f}, {self.tau.high:+.2f}]"
        return f"{self.tau.mean:+.2f}{interval}"


def order_agreement(rows: pd.DataFrame, given: Mapping[str, float], quantity: Quantity) -> OrderAgreement | None:
    """Compare the order of methods by a quantity with that by `given`; `rows`: of one scene.

    None with fewer than three methods that were run on the same people.
    """
    from scipy.stats import kendalltau  # A second of imports.

    samples = {method: seeds for method, seeds in samples_of(rows, quantity).items() if method in given}
    people = [name for name in next(iter(samples.values()), {}) if all(name in seeds for seeds in samples.values())]
    if len(samples) < FEWEST_RANKED or not people:
        return None
    scores = np.array([[np.mean(seeds[name]) for name in people] for seeds in samples.values()])
    published = [given[method] for method in samples]
    mean, low, high = mean_interval([float(kendalltau(published, each).statistic) for each in scores.T])
    return OrderAgreement(
        tau=Interval(mean, max(-1.0, low), min(1.0, high)) if low < high else Interval(mean),
        rows=len(samples),
        people=len(people),
        chance=float(kendalltau(published, scores.mean(1), alternative="greater").pvalue),
    )


def conventions(tables: RunTables, scene: str, split: str, metric: str) -> pd.DataFrame | None:
    """The same renders scored by the conventions of others: methods by `CONVENTIONS`.

    Oracles are left out; None where fewer than two methods were scored so.
    """
    names = tables.methods(scene, oracles=False)
    by_region = {region: tables.values(scene, Quantity(split, region, metric), names) for region in CONVENTIONS}
    values = pd.DataFrame(by_region, index=list(names))
    return None if len(names) < 2 or values.isna().any(axis=None) else values
