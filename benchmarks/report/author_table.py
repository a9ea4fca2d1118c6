"""The table that an author asked for: numbers of a run in chosen rows and columns, as text, LaTeX and DataFrame.

What it shows stands in a TOML file, see `benchmarks.suites.tables`. `load` gives the numbers of all of its cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import pandas as pd

from ash.files import InputError
from benchmarks.analysis.paper import order_agreement
from benchmarks.analysis.results import RANKED_SPLITS, Quantity, RunTables, compare
from benchmarks.analysis.statistics import Comparison, corrected
from benchmarks.analysis.style import style_of, titles_of
from benchmarks.cell.metrics import METRICS, PROTOCOL, Metric
from benchmarks.cell.registry import is_oracle
from benchmarks.report import tables as measured
from benchmarks.report.content import Block, Mark, Table, Text
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
ORDER_NOTE = (
    "Kendall's tau between the order of our rows and that of the numbers beside them: 1 the same, 0 unrelated, -1 "
    "reversed; the mean over people of the order on each, with its 95 % interval. By chance: the share of all orders "
    "of as many rows that agree at least as well as the order of our means."
)
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
    orders: Table | None  # how far its rows stand in the order of the numbers that its columns name `beside`


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
    qualities = [(metric, split) for split in RANKED_SPLITS for metric in ("psnr", "lpips" if has_lpips else "flip")]
    there = set(tables.rows["metric"])
    columns = tuple(
        TableColumn(metric=metric, split=split)
        for metric, split in (*qualities, ("frame_ms", ""), ("train_s", ""))
        if metric in there
    )
    specs = [TableSpec(scene=s, columns=columns, label=f"tab:{_plain(s)}", wide=True) for s in tables.scenes]
    return of_tables(tables, specs)


def blocks(tables: Sequence[AuthorTable]) -> list[Block]:
    """The tables with their captions, and the order of their rows beside that of published numbers."""
    made: list[Block] = []
    for table in tables:
        made += [table.shown, Text(text=table.caption, note=True)]
        made += [table.orders, Text(text=ORDER_NOTE, note=True)] if table.orders is not None else []
    return made


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
            made.append(_table(tables, spec))
    return tuple(made)


def _by_scene(spec: TableSpec, scenes: Sequence[str]) -> list[TableSpec]:
    if spec.scene or all(column.scene for column in spec.columns if column.metric):
        return [spec]
    several = len(scenes) > 1 and spec.label
    return [replace(spec, scene=s, label=f"{spec.label}-{_plain(s)}" if several else spec.label) for s in scenes]


def _groups(tables: RunTables, spec: TableSpec) -> tuple[tuple[tuple[TableRow, ...], ...], list[str]]:
    """The rows, those that stand in for others among them, by default every method of the run; and the notes below."""
    scenes = _scenes(spec.columns)
    notes: list[str] = []
    ran = {method for scene in scenes for method in tables.methods(scene)}

    def shown(row: TableRow) -> TableRow:
        if row.method in ran or row.instead not in ran:
            return row
        notes.append(row.note)
        return replace(row, method=row.instead)

    order = tables.rows[tables.rows["scene"].isin(scenes)]["method"].unique()  # of the suite
    groups = spec.rows or (tuple(TableRow(method=str(method)) for method in order),)
    return tuple(tuple(map(shown, group)) for group in groups), [*filter(None, notes)]


def _complete(tables: RunTables, column: TableColumn, scene: str) -> TableColumn:
    """The column with split, region and scene, where the run has the metric."""
    if not column.metric:
        return column
    rows = tables.of(column.scene or scene)
    rows = rows[rows["metric"] == column.metric]
    split = column.split or _first(("novel_view", *SPLITS), rows["split"])
    region = column.region or _first(REGIONS, rows[rows["split"] == split]["region"])
    return replace(column, scene=column.scene or scene, split=split, region=region)


def _scenes(columns: Sequence[TableColumn]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(column.scene for column in columns if column.metric))


def _table(tables: RunTables, asked: TableSpec) -> AuthorTable:
    spec = replace(asked, columns=tuple(_complete(tables, column, asked.scene) for column in asked.columns))
    groups, notes = _groups(tables, spec)
    rows, scenes = [row for group in groups for row in group], _scenes(spec.columns)
    tests, marks = _differences(tables, spec, rows), _marks(tables, spec, rows)
    numbers = pd.DataFrame(
        _record(tables, spec, row, column, test=tests.get((i, k)), mark=marks.get((i, k), ""))
        for i, row in enumerate(rows)
        for k, column in enumerate(spec.columns)
    )
    texts = numbers["text"].to_numpy().reshape(len(rows), len(spec.columns))
    heads = pd.MultiIndex.from_tuples([_head(column, scenes) for column in spec.columns])
    frame = pd.DataFrame(texts, index=[_name(tables, row, scenes) for row in rows], columns=heads)
    caption = _caption(tables, spec, set(marks.values()), notes)
    ends = tuple(accumulate(len(group) for group in groups[:-1]))
    shown, orders = Table(frame=frame, marks=marks), _orders(tables, spec, rows)
    return AuthorTable(spec=spec, shown=shown, numbers=numbers, caption=caption, breaks=ends, orders=orders)


def _orders(tables: RunTables, spec: TableSpec, rows: Sequence[TableRow]) -> Table | None:
    texts = {}
    for column in (column for column in spec.columns if column.beside):
        given = {row.method: row.given[column.beside] for row in rows if row.method and column.beside in row.given}
        if (order := order_agreement(tables.of(column.scene), given, _quantity(column))) is not None:
            place = next(each for each in spec.columns if each.given == column.beside)
            text = [order.tau_text, str(order.rows), str(order.people), f"{order.chance:.0%}"]
            texts[": ".join(filter(None, (place.group, place.title)))] = text
    if not texts:
        return None
    frame = pd.DataFrame.from_dict(texts, orient="index", columns=["tau", "rows", "people", "by chance"])
    return Table(title="The order of rows", corner="beside", frame=frame)


def _record(
    tables: RunTables, spec: TableSpec, row: TableRow, column: TableColumn, *, test: Comparison | None, mark: Mark
) -> dict[str, Any]:
    """A cell: its place, its numbers in the unit shown, and its text."""
    factor, scenes, test = _factor(column), _scenes(spec.columns), test or Comparison(mean=math.nan)
    score = tables.get(column.scene, row.method, _quantity(column)) if column.metric else None
    mean = row.given.get(column.given, math.nan) if score is None else float(score.value)
    half = math.nan if score is None else float(score.half_width)
    change, low, high = (value * factor for value in (test.mean, test.low, test.high))
    trained = tables.cells["cells"].get((column.scene, row.method), 0)
    lost = score is not None and tables.failed(column.scene, row.method) == trained
    group, head = _head(column, scenes)
    return {
        **{"row": _name(tables, row, scenes), "method": row.method, "group": group, "column": head},
        **{"scene": column.scene, "split": column.split, "region": column.region, "metric": column.metric},
        **{"unit": _unit(column), "mean": mean * factor},
        **{"low": (mean - half) * factor, "high": (mean + half) * factor},
        **{"n": 0 if score is None else int(score.n), "difference": change, "difference_low": low},
        **{"difference_high": high, "p": test.p, "mark": mark},
        "text": "failed" if lost else _text(column, spec.form, mean * factor, half * factor, change, (high - low) / 2),
    }


def _differences(tables: RunTables, spec: TableSpec, rows: Sequence[TableRow]) -> dict[tuple[int, int], Comparison]:
    """To the reference, by row and column, where the form asks for them; p is corrected over the table."""
    if spec.form != "difference":
        return {}
    compared = {
        (i, k): compare(tables.of(column.scene), row.method, spec.reference, _quantity(column))
        for i, row in enumerate(rows)
        for k, column in enumerate(spec.columns)
        if column.metric and row.method != spec.reference
    }
    tests = {place: test for place, test in compared.items() if test is not None}
    return dict(zip(tests, corrected([*tests.values()]), strict=True))


def _marks(tables: RunTables, spec: TableSpec, rows: Sequence[TableRow]) -> dict[tuple[int, int], Mark]:
    """Best where it is better than every other row, and second then; oracles and failed rows are not ranked."""
    places = {row.method: i for i, row in enumerate(rows) if not is_oracle(row.method)}
    tests: list[tuple[int, list[str], list[Comparison]]] = []
    for k, column in enumerate(spec.columns if spec.marks else ()):
        direction = METRICS[column.metric].direction if column.metric else "none"
        if direction == "none" or column.metric in measured.UNRANKED:
            continue
        whole = [method for method in places if not tables.failed(column.scene, method)]
        means = pd.Series(tables.values(column.scene, _quantity(column), whole), dtype=float)
        order = [*means.sort_values(ascending=direction == "down", kind="stable").index]
        pairs = [compare(tables.of(column.scene), order[0], other, _quantity(column)) for other in order[1:]]
        tests.append((k, order, [each for each in pairs if each is not None]))
    adjusted = iter(corrected([pair for _, _, pairs in tests for pair in pairs]))
    marks: dict[tuple[int, int], Mark] = {}
    for k, order, compared in tests:
        verdicts = [next(adjusted).verdict for _ in compared]
        if verdicts and all(verdict == "better" for verdict in verdicts):
            marks |= {(places[order[0]], k): "best", (places[order[1]], k): "second"}
    return marks


def _text(column: TableColumn, form: str, mean: float, half: float, change: float, width: float) -> str:
    """What stands in a cell: its mean, half the width of its interval, and the same of its difference."""
    text = "n/a" if math.isnan(mean) else _number(column, mean)
    if form == "difference" and not math.isnan(change):
        interval = "" if math.isnan(width) else f" ± {_number(column, width)}"
        return f"{text} ({_number(column, change, signed=True)}{interval})"
    if math.isnan(half) or form in ("mean", "difference"):
        return text
    if form == "interval":
        return f"{text} [{_number(column, mean - half)}, {_number(column, mean + half)}]"
    return f"{text} ± {_number(column, half)}"


def _name(tables: RunTables, row: TableRow, scenes: Sequence[str]) -> str:
    title = row.title or style_of(row.method).title
    failed = sum(tables.failed(scene, row.method) for scene in scenes)
    cells = sum(int(tables.cells["cells"].get((scene, row.method), 0)) for scene in scenes)
    return f"{title} ({failed} of {cells} failed)" if failed else title


def _head(column: TableColumn, scenes: Sequence[str]) -> tuple[str, str]:
    """Group and title."""
    if not column.metric:
        return column.group, column.title
    group, title = measured.head_of(_quantity(column)) if column.split else ("", METRICS[column.metric].title)
    own, unit = METRICS[column.metric].unit, _unit(column)
    title = title.replace(f" [{own}]", f" [{unit}]" if unit != "1" else "") if own else title
    title = f"{title} [{unit}]" if unit and not own else title
    where = f"{column.scene}, {group}" if len(scenes) > 1 else group
    return column.group or where, column.title or title


def _caption(tables: RunTables, spec: TableSpec, marks: set[Mark], notes: Sequence[str]) -> str:
    """People, seeds, regions, what stands in a cell, those marks that the table has, protocol."""
    sentences = [spec.caption.rstrip(".") + "."] if spec.caption else []
    units = set()
    for scene in _scenes(spec.columns):
        people, seeds = tables.captures(scene), tables.seeds(scene)
        if people:
            counts = f"{people} {'person' if people == 1 else 'people'}, {seeds} seed{'' if seeds == 1 else 's'}"
            sentences.append(f"Scene {scene}: {counts}{' each' if people > 1 else ''}.")
            units.add("people" if people > 1 else "the seeds of one person" if seeds > 1 else "")
    sentences += dict.fromkeys(
        f"{METRICS[column.metric].title}: {measured.REGION_TITLES[column.region]}."
        for column in spec.columns
        if column.title and column.region in measured.REGION_TITLES  # Which a title of the author's may not tell.
    )
    over = " and ".join(sorted(filter(None, units)))
    if not over:
        sentences.append("One value per row: no interval, and no row is marked as best.")
    else:
        form = FORMS[spec.form].format(reference=style_of(spec.reference).title if spec.reference else "")
        test = ", in pairs" if spec.form == "difference" and "people" in units else ""
        sentences.append(f"{form}{test}{'' if spec.form == 'mean' else ','} over {over}.")
        if marks:
            meanings = (BEST, "better than every other row (p < 0.05, Holm)"), (SECOND, "second")
            for words, meaning in meanings:
                if names := " and ".join(text for mark, text in words.items() if mark in spec.marks):
                    sentences.append(f"{names.capitalize()}: {meaning}.")
        elif spec.marks:
            sentences.append("No row is significantly better than all others.")
    return " ".join([*sentences, *notes, f"Protocol {PROTOCOL} of ash-bench."])


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
