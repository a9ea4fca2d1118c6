"""Tables of a report: built once, written as HTML, Markdown and LaTeX."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from benchmarks.metrics import METRICS, Metric
from benchmarks.names import is_oracle, look_of
from benchmarks.scores import Score, Scores

Mark = Literal["", "best", "second"]
SPLIT_TITLES = {"novel_view": "Novel view", "novel_pose": "Novel pose", "train_view": "Training view"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """A quantity: where it stands in the results, and the group that heads it."""

    split: str
    region: str
    metric: str
    group: str

    @property
    def measure(self) -> Metric:
        """How the quantity is read."""
        return METRICS[self.metric]

    @property
    def head(self) -> str:
        """Name, unit and direction."""
        measure = self.measure
        unit = f" [{measure.unit}]" if measure.unit else ""
        return f"{measure.title}{unit} {measure.arrow}".strip()


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """One number as it is printed; `sort` is the number itself (None: not measured)."""

    text: str
    spread: str = ""  # half of the 95 % interval over seeds
    sort: float | None = None
    mark: Mark = ""

    @property
    def whole(self) -> str:
        """The number with its spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """A method's row. Oracles stand apart and are not ranked."""

    name: str
    entries: tuple[Entry, ...]
    oracle: bool = False
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """A table of one scene."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Column groups and how many columns each spans."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.group:
                found[-1] = (column.group, found[-1][1] + 1)
            else:
                found.append((column.group, 1))
        return found


def quality_columns(metrics: Sequence[str] = ("psnr", "ssim", "flip", "lpips")) -> list[Column]:
    """Foreground qualities on held-out views and poses (LPIPS is defined on whole frames)."""
    splits = ("novel_view", "novel_pose")
    return [
        Column(split=split, region="full" if m == "lpips" else "foreground", metric=m, group=SPLIT_TITLES[split])
        for split in splits
        for m in metrics
    ]


def cost_columns(
    metrics: Sequence[str] = ("frame_ms", "train_s", "peak_rss_mb", "params", "gaussians"),
) -> list[Column]:
    """What the quality costs."""
    memory = ("peak_rss_mb", "params", "gaussians")
    return [Column(split="memory" if m in memory else "speed", region="", metric=m, group="Cost") for m in metrics]


def build(scores: Scores, scene: str, columns: Sequence[Column], *, title: str) -> Table:
    """The table of a scene; quantities that nobody has are left out."""
    methods = scores.methods(scene)
    kept = [column for column in columns if any(_get(scores, scene, m, column) is not None for m in methods)]
    rows = [
        Row(
            name=look_of(method).title,
            entries=tuple(_entry(scores, scene, method, column) for column in kept),
            oracle=is_oracle(method),
            note=_note(scores, scene, method),
        )
        for method in methods
    ]
    rows.sort(key=lambda row: row.oracle)  # Stable: the suite's order within each half.
    return _marked(Table(title=title, columns=tuple(kept), rows=tuple(rows)))


def markdown(table: Table) -> str:
    """GitHub's table syntax: best in bold, second in italics."""
    heads = [f"{column.group}: {column.head}" for column in table.columns]
    lines = ["| | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    marks = {"": "{}", "best": "**{}**", "second": "*{}*"}
    for row in table.rows:
        name = f"{row.name} ({row.note})" if row.note else row.name
        lines.append(f"| {name} | " + " | ".join(marks[e.mark].format(e.whole) for e in row.entries) + " |")
    return "\n".join(lines)


def plain(table: Table) -> str:
    """Aligned columns for a terminal; the best is starred."""
    heads = ["", *(column.measure.title for column in table.columns)]
    units = ["", *(f"{column.measure.unit} {column.measure.arrow}".strip() for column in table.columns)]
    rows = [[row.name, *(e.whole + ("*" if e.mark == "best" else " ") for e in row.entries)] for row in table.rows]
    widths = [max(len(line[i]) for line in (heads, units, *rows)) for i in range(len(heads))]
    lines = [
        "  ".join(
            text.ljust(width) if i == 0 else text.rjust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in (heads, units, *rows)
    ]
    spans, at = " " * widths[0], 0
    for group, span in table.groups:
        width = sum(widths[1 + at : 1 + at + span]) + 2 * span
        spans += group.rjust(width)
        at += span
    return "\n".join(line.rstrip() for line in (spans, *lines))


def latex(table: Table) -> str:
    """A `booktabs` table; best and second best are coloured as the paper does. Needs booktabs and colortbl."""
    count = len(table.columns)
    spans = " & ".join(rf"\multicolumn{{{span}}}{{c}}{{{_tex(group)}}}" for group, span in table.groups)
    rules, start = "", 2
    for _, span in table.groups:
        rules += rf"\cmidrule(lr){{{start}-{start + span - 1}}}"
        start += span
    lines = [
        r"\begin{tabular}{l" + "r" * count + "}",
        r"\toprule",
        f" & {spans} \\\\",
        rules,
        " & " + " & ".join(_tex(column.head) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    marks = {"": "{}", "best": r"\cellcolor{{yellow}}{}", "second": r"\cellcolor{{antiquebrass}}{}"}
    for index, row in enumerate(table.rows):
        if row.oracle and not table.rows[index - 1].oracle and index:
            lines.append(r"\midrule")
        cells = " & ".join(marks[entry.mark].format(_tex(entry.whole)) for entry in row.entries)
        lines.append(f"{_tex(row.name)} & {cells} \\\\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _get(scores: Scores, scene: str, method: str, column: Column) -> Score | None:
    return scores.get(scene, method, column.split, column.region, column.metric)


def _note(scores: Scores, scene: str, method: str) -> str:
    failed = scores.failed(scene, method)
    return f"{failed} of {len(scores.cells(scene, method))} failed" if failed else ""


def _entry(scores: Scores, scene: str, method: str, column: Column) -> Entry:
    score, measure = _get(scores, scene, method, column), column.measure
    if scores.failed(scene, method) == len(scores.cells(scene, method)):
        return Entry(text="failed", sort=None if score is None else score.mean)
    if score is None:
        return Entry(text="n/a")
    text = _number(score.mean, measure)
    spread = "" if score.half_width is None or measure.decimals == 0 else f"{score.half_width:.{measure.decimals}f}"
    return Entry(text=text, spread=spread, sort=score.mean)


def _number(value: float, measure: Metric) -> str:
    """Counts in thousands or millions with three digits, everything else with the metric's decimals."""
    if measure.key in ("params", "gaussians") and value >= 1e4:
        return f"{value / 1e6:.3g}M" if value >= 1e6 else f"{value / 1e3:.3g}k"
    return f"{value:.{measure.decimals}f}"


def _marked(table: Table) -> Table:
    """The table with the best and second best of each ranked column marked; equal as printed is equal."""
    rows = [list(row.entries) for row in table.rows]
    for position, column in enumerate(table.columns):
        if column.measure.direction == "none":
            continue
        shown = [
            (round(entry.sort, column.measure.decimals), index)
            for index, row in enumerate(table.rows)
            if not row.oracle and (entry := row.entries[position]).sort is not None and entry.text != "failed"
        ]
        ranks = sorted({value for value, _ in shown}, reverse=column.measure.direction == "up")
        if len(ranks) < 2:
            continue
        for value, index in shown:
            mark: Mark = "best" if value == ranks[0] else "second" if value == ranks[1] else ""
            rows[index][position] = replace(rows[index][position], mark=mark)
    return replace(table, rows=tuple(replace(row, entries=tuple(e)) for row, e in zip(table.rows, rows, strict=True)))


def _tex(text: str) -> str:
    for plain, escaped in (
        ("\\", r"\textbackslash{}"),
        ("&", r"\&"),
        ("%", r"\%"),
        ("_", r"\_"),
        ("#", r"\#"),
        ("↑", r"$\uparrow$"),
        ("↓", r"$\downarrow$"),
        ("±", r"$\pm$"),
        ("\u2009", r"\,"),
    ):
        text = text.replace(plain, escaped)
    return text
