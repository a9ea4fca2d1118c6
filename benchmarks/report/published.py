"""`reports/README.md` from its template `README.md.j2`: every number in it comes from a published csv.

`.venv/bin/python -m benchmarks.report.published` writes it anew after a report was published; a test compares the two.
"""

import math
import re
import sys
from collections.abc import Sequence
from functools import cache
from itertools import chain
from pathlib import Path

import pandas as pd
from jinja2 import Environment, StrictUndefined

from ash.files import InputError, write_atomic
from benchmarks.analysis import ablation_matrix
from benchmarks.analysis.differences import differences
from benchmarks.analysis.paper import order_agreement, paper_tables
from benchmarks.analysis.results import (
    RANKED_SPLITS,
    Quantity,
    compare,
    fewer_captures,
    foreground,
    read_csv,
    samples_of,
    summarise,
)
from benchmarks.analysis.stability import losses
from benchmarks.analysis.statistics import Comparison
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.metrics import METRICS, PROTOCOL
from benchmarks.cell.registry import code_version, methods
from benchmarks.report.claims import printed
from benchmarks.report.tables import ON_WHOLE_FRAMES, cost_columns, head_of, people_needed, quality_columns

FOLDER = Path(__file__).parents[2] / "reports"
NAME = "README.md"
OWN = "README: "  # begins the names of claims that are this project's own
OUTFITS = ("tight", "loose")
OTHER_SCENES = "other scenes"
NEEDS = {"better": "needed", "equivalent": "not needed", "worse": "does harm"}  # by the verdict on ASH with a component
FACT = re.compile(r"^\| (code|commit|processor|gpu) \| (.*?) \|$", re.MULTILINE)  # of its provenance


def read_me(folder: Path = FOLDER) -> str:
    """The text of the template with its numbers.

    Raises:
        InputError: a report that the template names is not there, or is of another protocol.
    """
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True)
    numbers = Numbers(folder)
    names = [name for name in vars(Numbers) if not name.startswith("_")]
    return environment.from_string((folder / f"{NAME}.j2").read_text()).render(
        {name: getattr(numbers, name) for name in names}
    )


class Numbers:
    """What a template may ask for; a quantity is named by split and metric (`benchmarks.cell.metrics`).

    Rows of several reports are those of "one+other". A scene may be a perturbed one, "loose tracking=3".
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows = cache(self._read)
        self._means = cache(lambda report: summarise(self._rows(report)))
        self._losses = cache(lambda report, region: losses(self._rows(report), region))

    def score(self, report: str, scene: str, method: str, split: str = "novel_view", metric: str = "psnr") -> str:
        """The mean over people."""
        return self._score(report, scene, method, _quantity(split, metric))

    def difference(
        self, report: str, scene: str, a: str, b: str, split: str = "novel_view", metric: str = "psnr", region: str = ""
    ) -> str:
        """Row `a` minus row `b` in pairs over people, with its 95 % interval. `region`: by default that of tables."""
        quantity = Quantity(split, region, metric) if region else _quantity(split, metric)
        of_scene = self._of_scene(report, scene)
        test = compare(of_scene, a, b, quantity)
        if test is None or not samples_of(of_scene, quantity).keys() >= {a, b}:
            raise InputError(f"{self.folder / report}: expected rows {a} and {b} on {scene}")
        return _with_interval(test, metric)

    def loss(
        self,
        report: str,
        scene: str,
        method: str,
        axis: str,
        severity: float,
        split: str = "novel_view",
        region: str = "foreground",
    ) -> str:
        """PSNR of a region that a defect of the capture costs, in pairs over people, with its 95 % interval."""
        found = self._losses(report, region)
        place = {"scene": scene, "method": method, "axis": axis, "severity": severity, "split": split}
        found = found[(found[[*place]] == list(place.values())).all(axis=1)]
        if len(found) != 1:
            raise InputError(f"{self.folder / report}: expected {method} on {scene} with {axis}={severity:g}")
        test = Comparison(**found[["mean", "low", "high"]].iloc[0])
        return _with_interval(test, "psnr")

    def scores(self, report: str, *scenes: str) -> str:
        """A table in Markdown of the rows that ran on everybody: PSNR and LPIPS on all held-out splits, milliseconds
        and training seconds.
        """
        quantities = [*quality_columns(("psnr", "lpips")), *cost_columns(("frame_ms", "train_cpu_s"))]
        cells = []
        for scene in scenes:
            rows = self._of_scene(report, scene)
            fewer = fewer_captures(rows)
            for method in rows["method"].unique():
                if method not in fewer:
                    scores = (self._score(report, scene, method, quantity) for quantity in quantities)
                    cells.append([f"{scene}: {style_of(method).title}", *scores])
        return _markdown(["", *(": ".join(head_of(quantity)) for quantity in quantities)], cells)

    def needs(self, report: str) -> str:
        """A table in Markdown: what ASH loses without a component, with the verdict on ASH or how many people would
        decide, on the scene that should need it and on the one of strength 0; and how much more than on the latter.
        """
        rows = self._rows(report)
        table = differences(rows)
        views, poses = ({(e.row, e.scene): e for e in ablation_matrix.effects(table, s)} for s in RANKED_SPLITS)
        asked = {row for (row, _), effect in views.items() if effect.expected}
        cells = []
        for (row, scene), effect in views.items():
            if effect.expected or (row in asked and scene == ablation_matrix.ZERO_STRENGTH):
                cells.append([effect.component, scene, str(self.people(report, scene, row))])
                for split, each in zip(RANKED_SPLITS, (effect, poses[row, scene]), strict=True):
                    cells[-1] += [_need(each), ablation_matrix.more_than_without(rows, scene, row, split)]
        heads = [(SPLIT_NAMES[s].words, f"more than on {ablation_matrix.ZERO_STRENGTH}") for s in RANKED_SPLITS]
        return _markdown(["ASH", "scene", "people", *chain.from_iterable(heads)], cells, numbers=False)

    def strengths(self, report: str, factor: str, row: str, split: str = "novel_view") -> str:
        """How much more ASH loses without a component than on the scene of strength 0, at every strength."""
        more = ablation_matrix.more_by_strength(self._rows(report), factor, row, split)
        if not more:
            raise InputError(f"{self.folder / report}: expected rows ash and {row} on {factor} and strength 0")
        return more

    def order(self, report: str, scene: str, split: str, metric: str) -> str:
        """Kendall's tau of our rows to the order of the paper's comparison, with its interval over people."""
        spec = next(spec for spec in paper_tables() if spec.label == f"tab:{scene}")
        column = next(column for column in spec.columns if (column.split, column.metric) == (split, metric))
        given = {row.method: row.given[column.beside] for group in spec.rows for row in group}
        quantity = Quantity(split, column.region, metric) if column.region else foreground(split, metric)
        order = order_agreement(self._of_scene(report, scene), given, quantity)
        if order is None:
            raise InputError(f"{self.folder / report}: expected three rows of the paper on one person in {scene}")
        return order.tau_text

    def claims(self) -> str:
        """The paper's claims that were judged, in Markdown: a column for each outfit, one for other scenes."""
        table = self._claims(own=False)
        shown = printed(table[table["effect"].notna()])
        shown["text"] = [
            f"{'' if row.scene in OUTFITS else f'{row.scene}: '}{row.verdict}: {row.difference}"
            f"{row.paper and f', paper {row.paper}'}, {row.people} people{row.needed and f', {row.needed} needed'}"
            for row in shown.itertuples()
        ]
        shown["column"] = shown["scene"].where(shown["scene"].isin(OUTFITS), OTHER_SCENES)
        wide = shown.set_index(["contrast", "column"], append=True)["text"].unstack(sort=False).fillna("")
        heads = ["claim", "contrast", *wide.columns]
        return _markdown(heads, [[*name, *row] for name, *row in wide.itertuples()], numbers=False)

    def own_claims(self) -> str:
        """This project's own claims by verdict: how many are confirmed, and the names of the others."""
        parts = []
        for verdict, rows in self._claims(own=True).groupby("verdict", sort=False):
            scenes = rows.groupby("name", sort=False)["scene"].agg(" and ".join)
            names = [f"{name.removeprefix(OWN)} ({scene})" for name, scene in scenes.items()]
            parts.append(f"{len(rows)} {verdict}" + (f" ({'; '.join(names)})" if verdict != "confirmed" else ""))
        return ", ".join(parts)

    def _claims(self, *, own: bool) -> pd.DataFrame:
        table = pd.read_csv(self.folder / "claims" / "claims.csv", keep_default_na=False, na_values=[""])
        return table[table["name"].str.startswith(OWN) == own]

    def training(self, report: str) -> str:
        """Core-hours of training of a published report, and its processors and GPUs."""
        facts = self._facts(report)
        rows = self._rows(report)
        hours = rows[(rows["metric"] == "train_cpu_s") & (rows["split"] == "speed")]["value"].sum() / 3600
        gpus = [gpu for gpu in facts["gpu"].split(", ") if gpu != "none"]
        return ", ".join([f"{hours:.1f} core-hours", facts["processor"], *gpus])

    def cells(self, report: str) -> int:
        """How many trainings a report has."""
        return len(self._plateaus(report))

    def at_plateau(self, report: str) -> int:
        """How many of them had reached their plateau."""
        return int(self._plateaus(report).sum())

    def people(self, report: str, scene: str = "", method: str = "") -> int:
        """How many people a report has, one of its scenes, or a method on it."""
        rows = self._of_scene(report, scene) if scene else self._rows(report)
        return (rows[rows["method"] == method] if method else rows)["subject"].nunique()

    def _of_scene(self, report: str, scene: str) -> pd.DataFrame:
        rows = self._rows(report)
        return rows[rows["scene"] == scene]

    def _plateaus(self, report: str) -> pd.Series:
        rows = self._rows(report)
        return rows[(rows["split"] == "speed") & (rows["metric"] == "plateau")]["value"]

    def state(self, report: str) -> str:
        """Whether today's code made a published report."""
        facts = self._facts(report)
        today = {code_version(name) for name, method in methods().items() if method.is_ours}
        is_current = set(facts.get("code", "").split(", ")) <= today
        return "current" if is_current else f"stale, {facts.get('commit', 'unknown')}"

    def _facts(self, report: str) -> dict[str, str]:
        """The provenance that its page prints, without the backslashes of Markdown."""
        return dict(FACT.findall((self.folder / report / "report.md").read_text().replace("\\", "")))

    def _score(self, report: str, scene: str, method: str, quantity: Quantity) -> str:
        table = self._means(report)
        key = (scene, method, *quantity)
        if key not in table.index:
            return "n/a"
        measure = METRICS[quantity.metric]
        return f"{table.loc[key, 'value']:.{measure.decimals}f}"

    def _read(self, report: str) -> pd.DataFrame:
        rows = pd.concat([read_csv(self.folder / name / "results.csv") for name in report.split("+")])
        if set(rows["protocol"]) != {PROTOCOL}:
            raise InputError(f"{self.folder / report}: expected results of protocol {PROTOCOL}")
        return rows


def _quantity(split: str, metric: str) -> Quantity:
    if split in ("speed", "memory") or METRICS[metric].unit == "mm":
        return Quantity(split, "", metric)
    return Quantity(split, "full", metric) if metric in ON_WHOLE_FRAMES else foreground(split, metric)


def _need(effect: ablation_matrix.AblationEffect) -> str:
    """The loss without the component, and whether it is needed or how many people would decide."""
    if effect.verdict == "unclear":
        return f"{effect.text}: {people_needed(effect.needed) or 'more'} people would decide"
    return f"{effect.text}: {NEEDS[effect.verdict]}"


def _with_interval(test: Comparison, metric: str) -> str:
    """A difference with its interval; without one where there is one person."""
    measure = METRICS[metric]

    def number(value: float) -> str:
        return f"{value:+z.{measure.decimals}f}"

    interval = "" if math.isnan(test.low) else f" [{number(test.low)}, {number(test.high)}]"
    return f"{number(test.mean)} {measure.unit}{interval}"


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = True) -> str:
    lines = [heads, ["---", *["---:" if numbers else "---"] * (len(heads) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    place = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    write_atomic(place / NAME, read_me(place).encode())
