"""The table that an author asked for: numbers of a run in chosen rows and columns, as text, LaTeX and DataFrame.

What it shows stands in a TOML file, see `benchmarks.suites.tables`. `load` gives the numbers of all of its cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from ash.files import InputError
from benchmarks.analysis.results import RANKED_SPLITS, Quantity, RunTables, compare
from benchmarks.analysis.statistics import Comparison, corrected
from benchmarks.analysis.style import style_of, titles_of
from benchmarks.cell.metrics import METRICS, PROTOCOL, Metric
from benchmarks.cell.registry import is_oracle
from benchmarks.report import tables as measured
from benchmarks.report.content import Mark, Table
from benchmarks.report.escaping import latex as tex
from benchmarks.suites.files import methods_known, read_tables
from benchmarks.suites.runs import Run, read_run, results_of
from benchmarks.suites.scenes import scene_names
from benchmarks.suites.tables import REGIONS, SPLITS, UNITS, TableColumn, TableRow, TableSpec

FORMS = {  # what stands in a cell, by form
    "mean": "Mean",
    "half-width": "Mean ± half-width of the 95 % confidence interval",
    "interval": "Mean [95 % confidence interval]",
    "difference": "Mean (difference to {reference} ± half-width of its 95 % confidence interval)",
}
BEST, SECOND = {"bold": "bold", "colour": "yellow"}, {"underline": "underlined", "colour": "orange"}
HEAD = r"""% In a paper: \usepackage{booktabs,graphicxPACKAGES} and \input this file. Compiled alone, it is a document.
\expandafter\ifx\csname @nodocument\endcsname\relax\else
\def\ashbenchalone{}
\documentclass[twocolumn]{article}
\usepackage[utf8]{inputenc}
\usepackage{booktabs,graphicx,textcompPACKAGES}
\begin{document}
\fi
"""
FOOT = r"""
\ifdefined\ashbenchalone\else\expandafter\endinput\fi
\end{document}
"""


@dataclass(frozen=True, kw_only=True)
class AuthorTable:
    """A table with its numbers.

    `numbers` has a row per cell: `row`, `method`, `group`, `column` (as printed), `scene`, `split`, `region`, `metric`,
    `unit`, `mean`, `low`, `high` (95 % interval), `n` (people, or seeds of one person), `difference`,
    `difference_low`, `difference_high`, `p` (to the reference; p after Holm's correction), `mark` and `text`.
    """

    spec: TableSpec
    shown: Table
    numbers: pd.DataFrame
    caption: str
    breaks: tuple[int, ...]  # rows above which there is a rule


def load(run: Path | Run, tables: Path | None = None) -> pd.DataFrame:
    """The numbers of a run's tables, those of `AuthorTable.numbers`, by `table`, the number of the table from 0.

    `tables`: a file with `[[table]]`; by default the tables of the run's suite, or one for each scene.

    Raises:
        InputError: see `of_run`; or no run is there.
    """
    return numbers_of(of_run(run if isinstance(run, Run) else read_run(run), tables))


def numbers_of(tables: Sequence[AuthorTable]) -> pd.DataFrame:
    """The numbers of all tables, by `table`, the number of the table from 0."""
    return pd.concat([table.numbers.assign(table=i) for i, table in enumerate(tables)]).set_index("table")


def of_run(run: Run, tables: Path | None = None) -> tuple[AuthorTable, ...]:
    """The tables of a run that a file describes; by default those of its suite, or one for each scene.

    Raises:
        InputError: no cell is finished; or the file has no table, one that names a row or scene that no run has, or
            only tables of which the run has no row: lists what the run has.
    """
    with titles_of((cell.config for cell in run.cells), run.titles):
        run_tables = RunTables(results_of(run))
        if tables is None:
            return of_tables(run_tables, run.table) or default_tables(run_tables)
        specs, own = read_tables(tables)
        ran = tuple(map(str, run_tables.rows["method"].unique()))
        there = f"the run has the methods {', '.join(ran)} on {', '.join(run_tables.scenes)}"
        methods = {*ran, *own, *methods_known()}
        scenes = {*run_tables.scenes, *own, *scene_names()}
        for spec in specs:
            names = [name for group in spec.rows for row in group for name in (row.method, row.instead)]
            if unknown := [name for name in (*names, spec.reference) if name and name not in methods]:
                raise InputError(f"{tables}: table: unknown row {unknown[0]!r}, {there}")
            places = [spec.scene, *(column.scene for column in spec.columns)]
            if unknown := [name for name in places if name and name not in scenes]:
                raise InputError(f"{tables}: table: unknown scene {unknown[0]!r}, {there}")
        made = of_tables(run_tables, specs)
        if not made:
            raise InputError(f"{tables}: no row of its tables was run, {there}")
        return made


def default_tables(tables: RunTables) -> tuple[AuthorTable, ...]:
    """A table for each scene, over both columns of a paper: PSNR, LPIPS or FLIP, and times, as far as measured."""
    has_lpips = (tables.rows["metric"] == "lpips").any()
    asked = [(metric, split) for split in RANKED_SPLITS for metric in ("psnr", "lpips" if has_lpips else "flip")]
    there = set(tables.rows["metric"])
    columns = tuple(
        TableColumn(metric=metric, split=split)
        for metric, split in (*asked, ("frame_ms", ""), ("train_s", ""))
        if metric in there
    )
    specs = [TableSpec(scene=s, columns=columns, label=f"tab:{_plain(s)}", wide=True) for s in tables.scenes]
    return of_tables(tables, specs)


def _plain(name: str) -> str:
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in name)


def of_tables(tables: RunTables, specs: Sequence[TableSpec]) -> tuple[AuthorTable, ...]:
    """Those of the tables of which the run has a row; one that names no scene is made for each."""
    made = []
    for spec in [each for asked in specs for each in _by_scene(asked, tables.scenes)]:
        names = {name for group in spec.rows for row in group for name in (row.method, row.instead)}
        scenes = {column.scene or spec.scene for column in spec.columns if column.metric}
        ran = {method for scene in scenes for method in tables.methods(scene)}
        if ran & (names or ran):
            made.append(_Maker(tables, spec).table())
    return tuple(made)


def _by_scene(spec: TableSpec, scenes: Sequence[str]) -> list[TableSpec]:
    if spec.scene or all(column.scene for column in spec.columns if column.metric):
        return [spec]
    several = len(scenes) > 1 and spec.label
    return [replace(spec, scene=s, label=f"{spec.label}-{_plain(s)}" if several else spec.label) for s in scenes]


class _Maker:
    """Makes one table of a run."""

    def __init__(self, tables: RunTables, spec: TableSpec) -> None:
        self.tables = tables
        columns = [self._complete(column, spec) for column in spec.columns]
        self.scenes = tuple(dict.fromkeys(column.scene for column in columns if column.metric))
        ran = {method for scene in self.scenes for method in tables.methods(scene)}
        order = tables.rows[tables.rows["scene"].isin(self.scenes)]["method"].unique()  # of the suite
        groups = spec.rows or (tuple(TableRow(method=str(method)) for method in order),)
        self.notes = [row.note for group in groups for row in group if row.note and self._replaced(row, ran)]
        self.groups = [
            [replace(row, method=row.instead) if self._replaced(row, ran) else row for row in group] for group in groups
        ]
        self.rows = [row for group in self.groups for row in group]
        self.columns = columns
        self.spec = spec

    @staticmethod
    def _replaced(row: TableRow, ran: set[str]) -> bool:
        return row.method not in ran and row.instead in ran

    def _complete(self, column: TableColumn, spec: TableSpec) -> TableColumn:
        """The column with split, region and scene, where the run has the metric."""
        if not column.metric:
            return column
        scene = column.scene or spec.scene
        rows = self.tables.of(scene)
        rows = rows[rows["metric"] == column.metric]
        split = column.split or _first(("novel_view", *SPLITS), rows["split"])
        region = column.region or _first(REGIONS, rows[rows["split"] == split]["region"])
        return replace(column, scene=scene, split=split, region=region)

    def table(self) -> AuthorTable:
        """All of it."""
        cells = [[self._cell(row, column) for column in self.columns] for row in self.rows]
        places = [(i, k) for i, row in enumerate(cells) for k, cell in enumerate(row) if cell["comparison"] is not None]
        tests = corrected([cells[i][k]["comparison"] for i, k in places])
        for (i, k), test in zip(places, tests, strict=True):
            cells[i][k]["comparison"] = test
        marks = self._marks(cells)
        records, texts = [], []
        for i, row in enumerate(self.rows):
            texts.append([self._text(cell, column) for cell, column in zip(cells[i], self.columns, strict=True)])
            for k, column in enumerate(self.columns):
                records.append(self._record(row, column, cells[i][k], marks.get((i, k), ""), texts[-1][k]))
        heads = pd.MultiIndex.from_tuples([self._head(column) for column in self.columns])
        frame = pd.DataFrame(texts, index=[self._name(row) for row in self.rows], columns=heads)
        breaks, at = [], 0
        for group in self.groups[:-1]:
            at += len(group)
            breaks.append(at)
        return AuthorTable(
            spec=self.spec,
            shown=Table(frame=frame, marks=marks),
            numbers=pd.DataFrame(records),
            caption=self._caption({*marks.values()}),
            breaks=tuple(breaks),
        )

    def _cell(self, row: TableRow, column: TableColumn) -> dict[str, Any]:
        """Mean, interval and comparison of a cell, in the metric's unit; `lost`: every training failed."""
        empty: dict[str, Any] = {"mean": math.nan, "half": math.nan, "n": 0, "lost": False, "comparison": None}
        if column.given:
            return {**empty, "mean": row.given.get(column.given, math.nan)}
        found = self.tables.get(column.scene, row.method, _quantity(column))
        if found is None:
            return empty
        compared = self.spec.form == "difference" and row.method != self.spec.reference
        comparison = self._compare(column, row.method, self.spec.reference) if compared else None
        lost = self.tables.failed(column.scene, row.method) == self.tables.cells["cells"][column.scene, row.method]
        return {
            "mean": float(found.value),
            "half": float(found.half_width),
            "n": int(found.n),
            "lost": bool(lost),
            "comparison": comparison,
        }

    def _compare(self, column: TableColumn, method: str, other: str) -> Comparison | None:
        return compare(self.tables.of(column.scene), method, other, _quantity(column))

    def _marks(self, cells: list[list[dict[str, Any]]]) -> dict[tuple[int, int], Mark]:
        """Best where it is better than every other row, and second then; oracles are not ranked."""
        tests: list[tuple[int, list[int], list[Comparison]]] = []
        for k, column in enumerate(self.columns if self.spec.marks else ()):
            direction = METRICS[column.metric].direction if column.metric else "none"
            ranked = [i for i, row in enumerate(self.rows) if cells[i][k]["n"] and not is_oracle(row.method)]
            ranked = [i for i in ranked if not self.tables.failed(column.scene, self.rows[i].method)]
            if direction == "none" or column.metric in measured.UNRANKED or len(ranked) < 2:
                continue
            ranked.sort(key=lambda i, k=k: cells[i][k]["mean"], reverse=direction == "up")  # type: ignore[misc]
            first, *others = ranked
            compared = [self._compare(column, self.rows[first].method, self.rows[i].method) for i in others]
            tests.append((k, ranked, [each for each in compared if each is not None]))
        adjusted = iter(corrected([pair for _, _, pairs in tests for pair in pairs]))
        marks: dict[tuple[int, int], Mark] = {}
        for k, ranked, pairs in tests:
            verdicts = [next(adjusted).verdict for _ in pairs]
            if verdicts and all(verdict == "better" for verdict in verdicts):
                marks |= {(ranked[0], k): "best", (ranked[1], k): "second"}
        return marks

    def _text(self, cell: dict[str, Any], column: TableColumn) -> str:
        if cell["lost"]:
            return "failed"
        if math.isnan(cell["mean"]):
            return "n/a"
        factor, text = _factor(column), _number(column, cell["mean"] * _factor(column))
        comparison, half = cell["comparison"], cell["half"] * factor
        if self.spec.form == "difference" and comparison is not None:
            change = _number(column, comparison.mean * factor, signed=True)
            width = (comparison.high - comparison.low) / 2 * factor
            return f"{text} ({change})" if math.isnan(width) else f"{text} ({change} ± {_number(column, width)})"
        if math.isnan(half) or self.spec.form in ("mean", "difference"):
            return text
        mean = cell["mean"] * factor
        if self.spec.form == "interval":
            return f"{text} [{_number(column, mean - half)}, {_number(column, mean + half)}]"
        return f"{text} ± {_number(column, half)}"

    def _record(
        self, row: TableRow, column: TableColumn, cell: dict[str, Any], mark: Mark, text: str
    ) -> dict[str, Any]:
        factor, test = _factor(column), cell["comparison"] or Comparison(mean=math.nan)
        group, head = self._head(column)
        return {
            **{"row": self._name(row), "method": row.method, "group": group, "column": head},
            **{"scene": column.scene, "split": column.split, "region": column.region, "metric": column.metric},
            "unit": _unit(column),
            "mean": cell["mean"] * factor,
            **{"low": (cell["mean"] - cell["half"]) * factor, "high": (cell["mean"] + cell["half"]) * factor},
            "n": cell["n"],
            **{"difference": test.mean * factor, "difference_low": test.low * factor},
            **{"difference_high": test.high * factor, "p": test.p, "mark": mark, "text": text},
        }

    def _name(self, row: TableRow) -> str:
        title = row.title or style_of(row.method).title
        failed = sum(self.tables.failed(scene, row.method) for scene in self.scenes)
        cells = sum(int(self.tables.cells["cells"].get((scene, row.method), 0)) for scene in self.scenes)
        return f"{title} ({failed} of {cells} failed)" if failed else title

    def _head(self, column: TableColumn) -> tuple[str, str]:
        if not column.metric:
            return column.group, column.title
        group, title = measured.head_of(_quantity(column)) if column.split else ("", METRICS[column.metric].title)
        own, unit = METRICS[column.metric].unit, _unit(column)
        title = title.replace(f" [{own}]", f" [{unit}]" if unit != "1" else "") if own else title
        title = f"{title} [{unit}]" if unit and not own else title
        where = f"{column.scene}, {group}" if len(self.scenes) > 1 else group
        return column.group or where, column.title or title

    def _caption(self, marks: set[Mark]) -> str:
        """People, seeds, what stands in a cell, those marks that the table has, protocol."""
        sentences = [self.spec.caption.rstrip(".") + "."] if self.spec.caption else []
        units = set()
        for scene in self.scenes:
            rows = self.tables.of(scene)
            if not len(rows):
                continue
            people, seeds = rows["capture"].nunique(), rows["seed"].nunique()
            counts = f"{people} {'person' if people == 1 else 'people'}, {seeds} seed{'' if seeds == 1 else 's'}"
            sentences.append(f"Scene {scene}: {counts}{' each' if people > 1 else ''}.")
            units.add("people" if people > 1 else "the seeds of one person" if seeds > 1 else "")
        over = " and ".join(sorted(filter(None, units)))
        if over:
            reference = style_of(self.spec.reference).title if self.spec.reference else ""
            form = FORMS[self.spec.form].format(reference=reference)
            test = ", in pairs" if self.spec.form == "difference" and "people" in units else ""
            sentences.append(f"{form}{test}, over {over}." if self.spec.form != "mean" else f"Mean over {over}.")
            best, second = (
                " and ".join(text for mark, text in words.items() if mark in self.spec.marks).capitalize()
                for words in (BEST, SECOND)
            )
            if marks:
                sentences += [f"{best}: better than every other row (p < 0.05, Holm)."] if best else []
                sentences += [f"{second}: second."] if second else []
            elif self.spec.marks:
                sentences.append("No row is significantly better than all others.")
        else:
            sentences.append("One value per row: no interval, and no row is marked as best.")
        return " ".join([*sentences, *self.notes, f"Protocol {PROTOCOL} of ash-bench."])


def _first(order: Sequence[str], present: pd.Series) -> str:
    there = set(present)
    return next((name for name in order if name in there), "")


def _quantity(column: TableColumn) -> Quantity:
    return Quantity(column.split, column.region, column.metric)


def _unit(column: TableColumn) -> str:
    return column.unit or (METRICS[column.metric].unit if column.metric else "")


def _factor(column: TableColumn) -> float:
    return UNITS.get((METRICS[column.metric].unit, column.unit), 1.0) if column.metric else 1.0


def _number(column: TableColumn, value: float, *, signed: bool = False) -> str:
    """The number with the column's decimals, by default the metric's."""
    metric: Metric | None = METRICS.get(column.metric)
    decimals = column.decimals if column.decimals is not None else metric.decimals if metric else 2
    return f"{value:{'+' if signed else ''}.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def latex(tables: Sequence[AuthorTable]) -> str:
    """A file that compiles alone and can be `\\input` in a paper that loads booktabs and graphicx."""
    packages = ",colortbl" if any("colour" in table.spec.marks for table in tables) else ""
    return HEAD.replace("PACKAGES", packages) + "\n".join(map(_latex, tables)) + FOOT


def _latex(table: AuthorTable) -> str:
    """A `table` as wide as one column at most: a wider one is scaled down to it."""
    kind, shown = "table*" if table.spec.wide else "table", table.shown
    spans, rules, start = [], [], 2
    for group, span in shown.groups:
        spans.append(rf"\multicolumn{{{span}}}{{c}}{{{tex(group)}}}")
        rules += [rf"\cmidrule(lr){{{start}-{start + span - 1}}}"] if group else []
        start += span
    grouped = [f" & {' & '.join(spans)} \\\\", "".join(rules)] if rules else []
    body: list[str] = []
    for i, (name, texts) in enumerate(shown.rows):
        body += [r"\midrule"] if i in table.breaks else []
        cells = " & ".join(_marked(tex(text), mark, table.spec.marks) for text, mark in texts)
        body.append(f"{tex(name)} & {cells} \\\\")
    align = "".join("l" if table.spec.form == "difference" and column.metric else "r" for column in table.spec.columns)
    lines = [
        rf"\begin{{{kind}}}",
        r"\centering",
        r"\setlength{\abovecaptionskip}{0pt}\setlength{\belowcaptionskip}{6pt}\setlength{\tabcolsep}{4pt}",
        rf"\caption{{{tex(table.caption)}}}",
        *([rf"\label{{{table.spec.label}}}"] if table.spec.label else []),
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{@{{}}l{align}@{{}}}}",
        *[r"\toprule", *grouped, " & " + " & ".join(tex(title) for _, title in shown.heads) + r" \\", r"\midrule"],
        *body,
        *[r"\bottomrule", r"\end{tabular}}", rf"\end{{{kind}}}"],
    ]
    return "\n".join(lines) + "\n"


def _marked(text: str, mark: Mark, marks: Sequence[str]) -> str:
    if mark == "best":
        text = rf"\textbf{{{text}}}" if "bold" in marks else text
        return r"\cellcolor[rgb]{1,0.95,0.6}" + text if "colour" in marks else text
    if mark == "second":
        text = rf"\underline{{{text}}}" if "underline" in marks else text
        return r"\cellcolor[rgb]{0.98,0.92,0.84}" + text if "colour" in marks else text
    return text
