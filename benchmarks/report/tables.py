"""Tables of a scene's numbers, and tables as text for terminals and LaTeX."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import pandas as pd

from benchmarks.analysis.scores import HELD_OUT_SPLITS, RANKED_SPLITS, Quantity, Score, Scores, foreground
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.methods import is_oracle
from benchmarks.cell.metrics import METRICS, Metric
from benchmarks.report.content import Entry, Head, Mark, Row, Table
from benchmarks.report.escaping import latex as tex
from benchmarks.report.glossary import METRIC_TERMS

REGION_TITLES = {"full": "whole frame", "release_crop": "release crop", "white_frame": "on white"}
SEVERAL_REGIONS = ("psnr", "ssim", "flip")  # Their columns say which region they are of, if not the foreground.
UNRANKED = ("gaussians",)  # Neither more nor fewer is better.
BESIDE = ("psnr", "flip")  # What is shown of splits that are not ranked.
MEMORY = ("peak_rss_mb", "params", "gaussians")


def quality_columns(metrics: Sequence[str]) -> list[Quantity]:
    """Foreground qualities on held-out views and motion (LPIPS and IoU are defined on whole frames).

    Near and far motion, which rankings leave aside, have the first of them that say the most.
    """
    whole = ("lpips", "iou")
    asked = [(s, m) for s in HELD_OUT_SPLITS for m in metrics if s in RANKED_SPLITS or m in BESIDE]
    return [Quantity(s, "full", m) if m in whole else foreground(s, m) for s, m in asked]


def cost_columns(metrics: Sequence[str]) -> list[Quantity]:
    """What the quality costs."""
    return [Quantity("memory" if metric in MEMORY else "speed", "", metric) for metric in metrics]


def build(
    scores: Scores, scene: str, quantities: Sequence[Quantity], *, title: str, exposed: Collection[str] = ()
) -> Table:
    """The table of a scene; quantities that nobody has are left out. `exposed`: methods that were not isolated."""
    methods = sorted(scores.methods(scene), key=is_oracle)  # Stable: the order of methods within each half.
    found = {q: {m: scores.get(scene, m, q) for m in methods} for q in quantities}
    kept = [quantity for quantity in quantities if any(found[quantity].values())]
    lost = [method for method in methods if scores.failed(scene, method) == scores.cells(scene, method)]
    marks = {q: _marks({m: s for m, s in found[q].items() if s and m not in lost}, METRICS[q.metric]) for q in kept}
    rows = [
        Row(
            name=style_of(method).title,
            entries=tuple(
                _entry(found[q][method], METRICS[q.metric], marks[q].get(method, ""), method in lost) for q in kept
            ),
            apart=is_oracle(method),
            note=_note(scores, scene, method, exposed=method in exposed),
        )
        for method in methods
    ]
    return Table(title=title, columns=tuple(map(head_of, kept)), rows=tuple(rows))


def head_of(quantity: Quantity) -> Head:
    """The column's head; no two quantities of a split share one."""
    measure = METRICS[quantity.metric]
    region = REGION_TITLES.get(quantity.region, "") if quantity.metric in SEVERAL_REGIONS else ""
    return Head(
        title=f"{measure.title}, {region}" if region else measure.title,
        unit=measure.unit,
        arrow="" if quantity.metric in UNRANKED else measure.arrow,
        group=SPLIT_NAMES[quantity.split].title,
        term=METRIC_TERMS.get(quantity.metric, ""),
    )


def plain(table: Table) -> str:
    """Aligned columns for a terminal; the best is starred."""
    heads = ["", *(column.title for column in table.columns)]
    units = ["", *(f"{column.unit} {column.arrow}".strip() for column in table.columns)]
    rows = [[row.name, *(e.whole + ("*" if e.mark == "best" else " ") for e in row.entries)] for row in table.rows]
    widths = [max(len(line[i]) for line in (heads, units, *rows)) for i in range(len(heads))]
    first = 1
    for group, span in table.groups:  # A group's title may be wider than its columns.
        widths[first] += max(0, len(group) - sum(widths[first : first + span]) - 2 * (span - 1))
        first += span
    lines = [
        "  ".join([line[0].ljust(widths[0]), *(text.rjust(w) for text, w in zip(line[1:], widths[1:], strict=True))])
        for line in (heads, units, *rows)
    ]
    spans, at = " " * widths[0], 1
    for group, span in table.groups:
        spans += group.rjust(sum(widths[at : at + span]) + 2 * span)
        at += span
    return "\n".join(line.rstrip() for line in (spans, *lines))


def latex(table: Table) -> str:
    """A `booktabs` table; best and second best are coloured as the paper does. Needs booktabs and colortbl."""
    spans = " & ".join(rf"\multicolumn{{{span}}}{{c}}{{{tex(group)}}}" for group, span in table.groups)
    rules, start = "", 2
    for _, span in table.groups:
        rules += rf"\cmidrule(lr){{{start}-{start + span - 1}}}"
        start += span
    lines = [
        r"\begin{tabular}{l" + "r" * len(table.columns) + "}",
        r"\toprule",
        *([f" & {spans} \\\\", rules] if any(group for group, _ in table.groups) else []),
        " & " + " & ".join(tex(column.whole) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    colours = {"best": r"\cellcolor{yellow}", "second": r"\cellcolor{antiquebrass}"}
    for index, row in enumerate(table.rows):
        if index and row.apart and not table.rows[index - 1].apart:
            lines.append(r"\midrule")
        cells = " & ".join(colours.get(entry.mark, "") + tex(entry.whole) for entry in row.entries)
        lines.append(f"{tex(row.name)} & {cells} \\\\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def number(value: float, measure: Metric) -> str:
    """Counts in thousands or millions with three digits, everything else with the metric's decimals."""
    if measure.key in ("params", "gaussians") and value >= 1e4:
        return f"{value / 1e6:.3g}M" if value >= 1e6 else f"{value / 1e3:.3g}k"
    return f"{value:.{measure.decimals}f}"


def entry_of(score: Score | None, measure: Metric) -> Entry:
    """A score as it is printed. An interval that reaches below zero says nothing: the values' range stands instead."""
    if score is None:
        return Entry(text="n/a")
    if score.half_width is None or measure.decimals == 0:
        return Entry(text=number(score.mean, measure), sort=score.mean)
    if score.half_width > abs(score.mean):
        return Entry(text=f"{number(score.least, measure)} to {number(score.greatest, measure)}", sort=score.mean)
    return Entry(text=number(score.mean, measure), spread=f"{score.half_width:.{measure.decimals}f}", sort=score.mean)


def _note(scores: Scores, scene: str, method: str, *, exposed: bool) -> str:
    failed = scores.failed(scene, method)
    notes = [f"{failed} of {scores.cells(scene, method)} failed"] if failed else []
    return ", ".join([*notes, "not isolated"] if exposed else notes)


def _entry(score: Score | None, measure: Metric, mark: Mark, lost: bool) -> Entry:
    if lost:
        return Entry(text="failed", sort=None if score is None else score.mean)
    return replace(entry_of(score, measure), mark=mark)


def _marks(scores: dict[str, Score], measure: Metric) -> dict[str, Mark]:
    """Best and second best where more or less is better; equal as printed is equal, oracles are not ranked."""
    means = pd.Series({method: score.mean for method, score in scores.items() if not is_oracle(method)}, dtype=float)
    shown = means.round(measure.decimals)
    if measure.direction == "none" or measure.key in UNRANKED or shown.nunique() < 2:
        return {}
    ranks = shown.rank(method="dense", ascending=measure.direction == "down")
    names: dict[float, Mark] = {1.0: "best", 2.0: "second"}
    return {str(method): names[rank] for method, rank in ranks.items() if rank in names}
