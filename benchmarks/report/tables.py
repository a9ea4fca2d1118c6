"""Tables of a scene's numbers, and tables as text for terminals."""

import re
from collections.abc import Collection, Sequence
from typing import Any

import pandas as pd

from benchmarks.analysis.results import HELD_OUT_SPLITS, RANKED_SPLITS, Quantity, RunTables, fewer_captures, foreground
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.metrics import METRICS, Metric
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import BROUGHT_NOTE
from benchmarks.report.content import Mark, Table

REGION_TITLES = {"full": "whole frame", "release_crop": "release crop", "white_frame": "on white"}
SEVERAL_REGIONS = ("psnr", "ssim", "flip")  # Their columns name the region, unless it is the foreground.
UNRANKED = ("gaussians",)  # Neither more nor fewer is better.
BESIDE = ("psnr", "lpips", "flip")  # What is shown of splits that are not ranked.
MEMORY = ("peak_rss_mb", "params", "gaussians")
ON_WHOLE_FRAMES = ("lpips", "iou")


def people_needed(count: float) -> str:
    """`captures_needed` of `benchmarks.analysis.statistics` as text: empty where it is NaN."""
    return "" if pd.isna(count) else f"{count:.0f}".replace("inf", "over 1000")


def quality_columns(metrics: Sequence[str]) -> list[Quantity]:
    """Foreground qualities on novel views and poses; near and far poses have few of them."""
    qualities = [(s, m) for s in HELD_OUT_SPLITS for m in metrics if s in RANKED_SPLITS or m in BESIDE]
    return [Quantity(s, "full", m) if m in ON_WHOLE_FRAMES else foreground(s, m) for s, m in qualities]


def main_columns(tables: RunTables, scene: str) -> list[Quantity]:
    """PSNR and LPIPS on all held-out splits; FLIP where LPIPS was not measured."""
    has_lpips = (tables.of(scene)["metric"] == "lpips").any()
    return quality_columns(("psnr", "lpips" if has_lpips else "flip"))


def cost_columns(metrics: Sequence[str]) -> list[Quantity]:
    """Times and sizes."""
    return [Quantity("memory" if metric in MEMORY else "speed", "", metric) for metric in metrics]


def build(
    tables: RunTables, scene: str, quantities: Sequence[Quantity], *, title: str, exposed: Collection[str] = ()
) -> Table:
    """The table of a scene without the quantities that no method has. `exposed`: methods that were not isolated.

    Best and second best are marked where rows have several values; of one value each none is known to be better, nor
    is a mean over fewer captures.
    """
    methods = sorted(tables.methods(scene), key=is_oracle)  # Stable: the order of methods within each half.
    columns = {q: [tables.get(scene, method, q) for method in methods] for q in quantities}
    columns = {q: rows for q, rows in columns.items() if any(row is not None for row in rows)}
    lost = [tables.failed(scene, method) == tables.cells["cells"][scene, method] for method in methods]
    fewer = fewer_captures(tables.of(scene))
    names = [_name(tables, scene, method, exposed=method in exposed, fewer=fewer.get(method, "")) for method in methods]
    texts: dict[tuple[str, str], list[str]] = {}
    marks: dict[tuple[int, int], Mark] = {}
    for column, (quantity, rows) in enumerate(columns.items()):
        measure = METRICS[quantity.metric]
        texts[head_of(quantity)] = [
            "failed" if gone else text_of(row, measure) for row, gone in zip(rows, lost, strict=True)
        ]
        apart = [gone or method in fewer or is_oracle(method) for gone, method in zip(lost, methods, strict=True)]
        means = {i: row.value for i, row in enumerate(rows) if row is not None and not apart[i]}
        if tables.unit(scene):
            marks |= {(i, column): mark for i, mark in _marks(means, measure).items()}
    frame = pd.DataFrame(texts, index=names)
    return Table(title=title, frame=frame, marks=marks, below=sum(map(is_oracle, methods)))


UNIT = re.compile(r" \[(.*?)\]")


def head_of(quantity: Quantity) -> tuple[str, str]:
    """Group and title of the column; no two quantities of a split share one."""
    measure = METRICS[quantity.metric]
    region = REGION_TITLES.get(quantity.region, "") if quantity.metric in SEVERAL_REGIONS else ""
    unit = f" [{measure.unit}]" if measure.unit else ""
    arrow = "" if quantity.metric in UNRANKED else measure.arrow
    return SPLIT_NAMES[quantity.split].title, f"{measure.title}{f', {region}' if region else ''}{unit} {arrow}".strip()


def number(value: float, measure: Metric) -> str:
    """Counts in thousands or millions with three digits, everything else with the metric's decimals."""
    if measure.key in ("params", "gaussians") and value >= 1e4:
        return f"{value / 1e6:.3g}M" if value >= 1e6 else f"{value / 1e3:.3g}k"
    return f"{value:.{measure.decimals}f}"


def text_of(row: Any, measure: Metric) -> str:
    """A row of `RunTables.summary` as printed; where its interval reaches below zero, the range of the values."""
    if row is None:
        return "n/a"
    if pd.isna(row.half_width) or measure.decimals == 0:
        return number(row.value, measure)
    if row.half_width > abs(row.value):
        return f"{number(row.least, measure)} to {number(row.greatest, measure)}"
    return f"{number(row.value, measure)} ± {row.half_width:.{measure.decimals}f}"


def plain(table: Table) -> str:
    """Aligned columns for a terminal, units in a line of their own; a mark for the best becomes a star."""
    parts = [UNIT.split(title) for _, title in table.heads]  # "PSNR [dB] ↑" -> "PSNR", "dB", " ↑"
    heads = ["", *(part[0] + part[-1] * (len(part) > 1) for part in parts)]
    units = ["", *(part[1] if len(part) > 1 else "" for part in parts)]
    rows = [[name, *(text + ("*" if mark == "best" else " ") for text, mark in texts)] for name, texts in table.rows]
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


def _name(tables: RunTables, scene: str, method: str, *, exposed: bool, fewer: str) -> str:
    failed = tables.failed(scene, method)
    notes = [fewer] if fewer else []
    notes += [f"{failed} of {tables.cells['cells'][scene, method]} failed"] if failed else []
    notes += ["not isolated"] if exposed else []
    notes += [BROUGHT_NOTE] if method in tables.brought else []
    return f"{style_of(method).title} ({', '.join(notes)})" if notes else style_of(method).title


def _marks(means: dict[int, float], measure: Metric) -> dict[int, Mark]:
    """Best and second best where more or less is better; equal as printed is equal."""
    shown = pd.Series(means, dtype=float).round(measure.decimals)
    if measure.direction == "none" or measure.key in UNRANKED or shown.nunique() < 2:
        return {}
    ranks = shown.rank(method="dense", ascending=measure.direction == "down")
    marks: dict[float, Mark] = {1.0: "best", 2.0: "second"}
    return {int(i): marks[rank] for i, rank in ranks.items() if rank in marks}
