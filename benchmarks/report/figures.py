"""The charts of a scene: its numbers as the tables that `charts.py` draws, with captions."""

import pandas as pd

from benchmarks.analysis import pareto
from benchmarks.analysis.results import FRAME_MS, RANKED_SPLITS, Quantity, RunTables, foreground, samples_of
from benchmarks.analysis.statistics import intervals
from benchmarks.analysis.style import EXACT, SPLIT_NAMES, style_of
from benchmarks.cell.methods import WRONG_BY_MM
from benchmarks.report import charts, vega
from benchmarks.report.vega import Figure, Series

STAGES = {
    "stg1_ms": Series(title="Stg.1 template", colour="#2f6fde"),
    "stg2_ms": Series(title="Stg.2 textures", colour="#2a9d8f"),
    "stg3_ms": Series(title="Stg.3 decoders", colour="#dd6b20"),
    "stg4_ms": Series(title="Stg.4 skin and draw", colour="#9b59b6"),
    "": Series(title="other", colour="#8a94a3"),
}
STAGE_METRICS = tuple(stage for stage in STAGES if stage)
MANY_DIFFERENCES = 5  # rows from which on they are drawn as well as listed
PLANTED = {method for mm, row in WRONG_BY_MM.items() if mm > 0 for method in row}  # They have a chart of their own.
SPAN_DB = 9.0  # below the best point: lower points are named in the subtitle and not drawn
VERDICTS = {
    "better": Series(title="ASH is better", colour=vega.BLUE),
    "worse": Series(title="ASH is worse", colour=vega.ORANGE),
    "equivalent": Series(title="equivalent", colour="#2a9d8f"),
    "unclear": Series(title="unclear", colour=vega.LINE),
}


def speed_figure(tables: RunTables, scene: str) -> Figure | None:
    """Foreground PSNR against milliseconds per frame, for novel views and novel poses."""
    methods = [m for m in tables.methods(scene) if m not in PLANTED and tables.whole(scene, m)]
    styles = dict(zip(methods, vega.series_of(methods), strict=True))
    frames = tables.values(scene, FRAME_MS, methods)
    points, front, links = [], [], []
    notes: dict[str, str] = {}
    for split in RANKED_SPLITS:
        panel = SPLIT_NAMES[split].words.capitalize()
        samples = samples_of(tables.of(scene), foreground(split))
        spans = intervals({m: samples[m] for m in frames if m in samples}) if samples else {}
        floor = max((span.mean for span in spans.values()), default=0.0) - SPAN_DB
        shown = {m: span for m, span in spans.items() if span.mean >= floor}
        competing = [each for each in pareto.candidates(tables, scene, split)]
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
        said = [f"noise ceiling {value:.1f} dB" for value in [*ceilings.values()][:1]]
        said += [
            f"{styles[m].title} {span.mean:.1f} dB, below the chart" for m, span in spans.items() if m not in shown
        ]
        notes[panel] = "; ".join(said)
    if not points:
        return None
    series = tuple(styles.values())
    front_table = pd.DataFrame(front, columns=["panel", "ms", "psnr"])
    link_table = pd.DataFrame(links, columns=["panel", "link", "ms", "psnr"])
    caption = "Up and to the left is better. Grey staircase: the front of the methods that no other beats in both."
    if links:
        caption += " Hollow: given the exact surface, a bound and no competitor; the dashed line joins it with the same"
        caption += " method on its own template."
    if over := tables.unit(scene):
        apart = ", the common effect of a capture removed" if over == "captures" else ""
        caption += f" Whiskers: 95 % interval over {over}{apart}; one that reaches the edge is cut."
        caption += " Ringed: the smallest sufficient method."
    panels = charts.speed(
        pd.DataFrame(points).astype({"low": float, "high": float}), front_table, link_table, series, notes=notes
    )
    return Figure(name=scene, title="Accuracy against speed", caption=caption, panels=panels, series=series)


def differences_figure(table: pd.DataFrame, scene: str, *, over: str) -> Figure | None:
    """`differences` of a scene, where they are so many that a table is hard to read. `over`: unit of the intervals."""
    if not len(table) or table.groupby("split").size().max() < MANY_DIFFERENCES:
        return None
    rows = table.assign(
        panel=table["split"].map(lambda split: SPLIT_NAMES[split].title),
        row=table["method"].map(lambda method: style_of(method).title),
        series=table["verdict"].map(lambda verdict: VERDICTS[verdict].title),
    )
    series = tuple(series for verdict, series in VERDICTS.items() if (table["verdict"] == verdict).any())
    known = f"with the 95 % interval over {over}; arrows: it is cut" if over else "of one seed, without intervals"
    return Figure(
        name=f"effects_{scene}",
        title="Differences",
        caption=f"Foreground PSNR of ASH minus that of the row, {known}.",
        panels=charts.forest(
            rows[["panel", "row", "mean", "low", "high", "series"]], series, x="ASH minus the row [dB]"
        ),
        series=series,
    )


def training_figure(tables: RunTables, scene: str) -> Figure | None:
    """Foreground PSNR of reserved training views over seconds of training, first seed of the first capture."""
    curves = tables.curves[tables.curves["scene"] == scene]
    curves = curves[curves["capture"] == curves.groupby("method")["capture"].transform("first")]
    curves = curves[curves["seed"] == curves.groupby("method")["seed"].transform("min")]
    methods = [m for m in tables.methods(scene) if (curves["method"] == m).sum() > 1]
    if not methods:
        return None
    title = "Training"
    caption = "Foreground PSNR of reserved training views, which no step sees, over seconds of training. First seed;"
    return line_figure(
        curves[curves["method"].isin(methods)].assign(panel=""),
        methods,
        name=f"training_{scene}",
        title=title,
        caption=f"{caption} warm-up included.",
        x="seconds",
        x_title="seconds of training",
        y_title="PSNR of reserved views [dB]",
        size=(charts.WIDTH - 80, 260),
        log=True,
    )


def stage_figure(tables: RunTables, scene: str) -> Figure | None:
    """Milliseconds per frame by stage; what no stage claims is shown as other."""
    rows = []
    for method in tables.methods(scene):
        whole = tables.get(scene, method, FRAME_MS)
        stages = {stage: tables.get(scene, method, Quantity("speed", "", stage)) for stage in STAGE_METRICS}
        if whole is None or tables.failed(scene, method) or all(row is None for row in stages.values()):
            continue
        parts = {stage: 0.0 if row is None else row.value for stage, row in stages.items()}
        parts[""] = max(0.0, whole.value - sum(parts.values()))
        name = style_of(method).title
        rows += [{"row": name, "series": STAGES[stage].title, "value": value} for stage, value in parts.items()]
    if not rows:
        return None
    return Figure(
        name=f"stages_{scene}",
        title="Time per stage",
        caption="One frame on one core, median after warm-up, by the paper's stages.",
        panels=charts.bars(pd.DataFrame(rows), tuple(STAGES.values()), x="ms per frame"),
        series=tuple(STAGES.values()),
        columns=1,
    )


def line_figure(
    table: pd.DataFrame,
    methods: list[str],
    *,
    name: str,
    title: str,
    caption: str,
    x: str,
    x_title: str,
    y_title: str = "foreground PSNR [dB]",
    size: tuple[int, int] = (390, 240),
    log: bool = False,
) -> Figure:
    """A line per method through `table` (panel, method, psnr, the column `x`, and low, high, scale where known)."""
    series = vega.series_of(methods)
    names = {method: each.title for method, each in zip(methods, series, strict=True)}
    samples = table.assign(series=table["method"].map(names), x=table[x].astype(float), y=table["psnr"])
    kept = [column for column in ("panel", "scale", "series", "x", "y", "low", "high") if column in samples]
    panels = charts.lines(samples[kept], series, x=x_title, y=y_title, size=size, log=log)
    return Figure(
        name=name, title=title, caption=caption, panels=panels, series=series, columns=2 if len(panels) > 1 else 1
    )
