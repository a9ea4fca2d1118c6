"""The charts of a scene: its numbers as the tables that `charts.py` draws, with captions."""

from collections.abc import Mapping
from dataclasses import replace

import pandas as pd

from benchmarks.analysis import curves, pareto
from benchmarks.analysis.results import (
    FRAME_MS,
    RANKED_SPLITS,
    RunTables,
    alike,
    fewer_captures,
    foreground,
    samples_of,
)
from benchmarks.analysis.statistics import intervals, on_all_captures, on_shared_captures
from benchmarks.analysis.style import EXACT, SPLIT_NAMES
from benchmarks.cell.registry import WRONG_BY_MM
from benchmarks.report import charts, vega
from benchmarks.report.vega import Figure, Series

PLANTED = {method for mm, row in WRONG_BY_MM.items() if mm > 0 for method in row}  # They have a chart of their own.
SPAN_DB = 9.0  # below the best point: lower points are named in the subtitle and not drawn


def speed_figure(tables: RunTables, scene: str) -> Figure | None:
    """Foreground PSNR against milliseconds per frame, for novel views and novel poses."""
    methods = [m for m in tables.methods(scene) if m not in PLANTED and tables.whole(scene, m)]
    fewer = fewer_captures(tables.of(scene))
    styles = {
        method: replace(series, title=f"{series.title} ({fewer[method]})") if method in fewer else series
        for method, series in vega.series_of(methods).items()
    }
    timed = alike(methods, tables.drawn_on)
    frames = tables.values(scene, FRAME_MS, timed)
    points, front, links = [], [], []
    notes: dict[str, list[str]] = {}
    for split in RANKED_SPLITS:
        panel = SPLIT_NAMES[split].words.capitalize()
        samples = samples_of(tables.of(scene), foreground(split))
        drawn = {m: samples[m] for m in frames if m in samples}  # Brought pictures have no time.
        spans = intervals(drawn)
        floor = max((span.mean for span in spans.values()), default=0.0) - SPAN_DB
        shown = {m: span for m, span in spans.items() if span.mean >= floor}
        competing = pareto.candidates(tables, scene, split)
        sufficient = pareto.smallest_sufficient(competing)
        for method, span in shown.items():
            ringed = sufficient is not None and sufficient.name == method
            numbers = {"ms": frames[method], "psnr": span.mean, "low": span.low, "high": span.high}
            points.append({"panel": panel, "series": styles[method].title, "ringed": ringed, **numbers})
        for method in pareto.front([each for each in competing if each.name in shown]):
            front.append({"panel": panel, "ms": frames[method], "psnr": shown[method].mean})
        for pair in [pair for pair in EXACT.items() if set(pair) <= set(shown)]:
            links += [{"panel": panel, "link": pair[0], "ms": frames[m], "psnr": shown[m].mean} for m in pair]
        ceilings = tables.values(scene, foreground(split, "noise_ceiling"), methods)
        subtitles = [f"noise ceiling {value:.1f} dB" for value in [*ceilings.values()][:1]]
        subtitles += [
            f"{styles[m].title} {span.mean:.1f} dB, below the chart" for m, span in spans.items() if m not in shown
        ]
        subtitles += [f"{styles[m].title}: timed on {tables.drawn_on[m]}, not shown" for m in styles if m not in timed]
        notes[panel] = subtitles
    if not points:
        return None
    series = tuple(styles[method] for method in timed)
    front_table = pd.DataFrame(front, columns=["panel", "ms", "psnr"])
    link_table = pd.DataFrame(links, columns=["panel", "link", "ms", "psnr"])
    caption = "Accuracy against speed: up and left is better. Grey staircase: the methods that none beats in both."
    if links:
        caption += " Hollow: given the exact surface, a bound and no competitor; the dashed line joins it with the same"
        caption += " method on its own template."
    if over := tables.unit(scene):
        compared = on_all_captures(drawn)
        apart = ", the common effect of a capture removed" if compared else ""
        caption += f" Whiskers: 95 % interval over {over}{apart}; one that reaches the edge is cut."
        if compared and len(compared) < len(drawn):
            caption += " A method of fewer captures stands at its adjusted mean: where it would stand with all of them,"
            caption += " by its difference to the methods that have all."
        elif on_shared_captures(drawn) != drawn:
            caption += " Points are of the captures that all methods have: fewer than two methods have every capture."
        caption += " Ringed: the smallest sufficient method."
    panels = charts.speed(
        pd.DataFrame(points).astype({"low": float, "high": float}),
        front_table,
        link_table,
        series,
        notes=notes,
        timed_on=tables.drawn_on[timed[0]],
    )
    return Figure(name=scene, title="Accuracy against speed", caption=caption, panels=panels, series=series)


def training_figure(tables: RunTables, scene: str) -> Figure | None:
    """Foreground PSNR of reserved training views over seconds of training, the mean over trainings of a method."""
    table = curves.during_training(curves.on_equal_captures(tables.curves[tables.curves["scene"] == scene]))
    methods = [m for m in tables.methods(scene) if (table["method"] == m).sum() > 1]
    if not methods:
        return None
    title = "Accuracy against training time"
    caption = "Foreground PSNR of reserved training views, which no step sees. Warm-up is included."
    if over := tables.unit(scene):
        caption += f" Means over {over}, from the last one's first score to the end of the first that ends."
    return line_figure(
        table[table["method"].isin(methods)].rename(columns={"scene": "panel"}),
        vega.series_of(methods),
        name=f"training_{scene}",
        title=title,
        caption=caption,
        x="seconds",
        x_title="seconds of training",
        y_title="PSNR of reserved views [dB]",
        size=(charts.WIDTH - 80, 260),
        log=True,
        columns=1,
    )


def line_figure(
    table: pd.DataFrame,
    series: Mapping[str, Series] | None = None,
    *,
    name: str,
    title: str,
    caption: str,
    x: str,
    x_title: str,
    y_title: str = "foreground PSNR [dB]",
    size: tuple[int, int] = (390, 240),
    log: bool = False,
    rules: pd.DataFrame | None = None,
    columns: int = 2,
) -> Figure:
    """A line per method through `table` (panel, method, psnr, the column `x`, and low, high, scale, crossed if known).

    `series`: by the values of `method`; by default those of the methods.
    """
    series = vega.series_of(table["method"].unique()) if series is None else series
    titles = {method: each.title for method, each in series.items()}
    places = table[x].astype(float) if pd.api.types.is_numeric_dtype(table[x]) else table[x]
    samples = table.assign(series=table["method"].map(titles), x=places, y=table["psnr"])
    columns_drawn = [c for c in ("panel", "scale", "series", "x", "y", "low", "high", "crossed") if c in samples]
    drawn = tuple(series.values())
    panels = charts.lines(samples[columns_drawn], drawn, x=x_title, y=y_title, size=size, log=log, rules=rules)
    columns = min(columns, len(panels))
    return Figure(name=name, title=title, caption=caption, panels=panels, series=drawn, columns=columns)
