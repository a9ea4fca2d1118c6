"""The kinds of charts in a report: a table in, panels of Vega-Lite (by Altair) out."""

import json
import math
from collections.abc import Sequence
from typing import Any

import altair as alt
import pandas as pd

from benchmarks.report.vega import DIM, INK, LINE, PAPER, Series

Panels = tuple[alt.LayerChart, ...]
TICK_GAP = 0.06  # of an axis, at least, between two of its ticks
WIDTH = 900  # pixels of a chart in a file
REAL_TIME_MS = 1e3 / 30
LEAST_REACH_DB = 2.0  # of a whisker beyond all points of a chart of speed
WRITING, FRAME = "#17202c", "#c2415c"  # in a matrix, whose cells keep their light colours on dark pages
RANGE = ("#e8995a", "#f1f3f6", "#6f9ceb")
CELL = (70, 40)  # pixels of a matrix's cell
LEAST_SCALE = 0.7  # below which the numbers of a matrix are hardly readable


def speed(
    points: pd.DataFrame,
    front: pd.DataFrame,
    links: pd.DataFrame,
    series: Sequence[Series],
    *,
    notes: dict[str, list[str]],
    timed_on: str,
) -> Panels:
    """Accuracy against speed: a panel per `panel` of `points`; all share both axes.

    `points`: panel, series, ms, psnr, low, high, ringed. `front`: panel, ms, psnr of the staircase. `links`: panel,
    link, ms, psnr. `notes`: lines of the subtitle by panel.
    """
    reach = max(LEAST_REACH_DB, float(points["psnr"].max() - points["psnr"].min()))
    low, high = (
        points["low"].clip(lower=points["psnr"].min() - reach),
        points["high"].clip(upper=points["psnr"].max() + reach),
    )
    x = _log_domain(points["ms"], 1.5)
    y = _domain(points.assign(low=low, high=high), ["psnr", "low", "high"])
    at = {
        "x": alt.X(
            "ms:Q",
            title=f"ms per frame, {timed_on}",
            scale=alt.Scale(type="log", domain=x, nice=False),
            axis=alt.Axis(values=_log_ticks(x), format="~s"),
        ),
        "y": alt.Y("psnr:Q", title="foreground PSNR [dB]", scale=_fixed(y)),
    }
    tips = [("series", "method", ""), ("ms", "ms per frame", ".1f"), ("psnr", "PSNR [dB]", ".2f")]
    panels = []
    for panel, own in points.groupby("panel", sort=False):
        shown = _shown(own)
        step = front[front["panel"] == panel]
        stair = pd.concat([step.head(1).assign(psnr=y[0]), step, step.tail(1).assign(ms=x[1])])
        stroke: dict[str, Any] = {"color": LINE, "strokeWidth": 1, "clip": True}
        layers = [
            alt.Chart(inline(stair)).mark_line(interpolate="step-after", **stroke).encode(**at),
            alt.Chart(inline(links[links["panel"] == panel]))
            .mark_line(strokeDash=[3, 3], **stroke)
            .encode(**at, detail="link:N"),
            _whiskers(shown, at, series),
            shown.transform_filter("datum.ringed")
            .mark_point(size=330, filled=False, color=INK, clip=True)
            .encode(**at),
            shown.mark_point(size=80, opacity=1, strokeWidth=2, clip=True).encode(
                **at, **style(series), tooltip=tooltips(tips)
            ),
        ]
        if x[0] < REAL_TIME_MS < x[1]:
            mark = alt.Chart(inline(pd.DataFrame({"ms": [REAL_TIME_MS], "psnr": [y[0]], "text": ["30 frames/s"]})))
            layers.append(mark.mark_rule(strokeDash=[2, 4]).encode(x=at["x"]))
            room = math.log(x[1] / REAL_TIME_MS) > 0.2 * math.log(x[1] / x[0])  # for its label, on the right
            text = mark.mark_text(clip=True, dy=-6, dx=4 if room else -4, align="left" if room else "right", color=DIM)
            layers.append(text.encode(**at, text="text:N"))
        panels.append(layered(layers, f"{panel}", (380, 330), notes.get(str(panel), ())))
    return tuple(panels)


def lines(
    samples: pd.DataFrame,
    series: Sequence[Series],
    *,
    x: str,
    y: str,
    size: tuple[int, int],
    rules: pd.DataFrame | None = None,
    log: bool = False,
) -> Panels:
    """Small charts that share the scale of y: `samples` has panel, series, x, y, low, high.

    Where it has `scale`, panels of one value there share theirs; where it has `crossed`, those points are crossed. x
    is a number, or a text whose steps stand at even distances. `rules`: panel, y, text.
    """
    rules = pd.DataFrame(columns=["panel", "y", "text"]) if rules is None else rules
    panels = []
    for panel, own in samples.groupby("panel", sort=False):
        alike = samples[samples["scale"] == own["scale"].iloc[0]] if "scale" in samples else samples
        number = pd.api.types.is_numeric_dtype(samples["x"])
        at = {
            "x": _number_axis(own["x"], x, log=log)
            if number
            else alt.X("x:O", title=x, sort=list(own["x"].unique()), axis=alt.Axis(labelAngle=0)),
            "y": alt.Y(
                "y:Q", title=y, scale=_fixed(_domain(pd.concat([alike, rules]), ["y", "low", "high"], pad=0.05))
            ),
        }
        shown = _shown(own)
        here = alt.Chart(inline(rules[rules["panel"] == panel]))
        tips = [("series", "", ""), ("x", x, ""), ("y", y, ".2f"), ("low", "from", ".2f"), ("high", "to", ".2f")]
        layers = [
            here.mark_rule(strokeDash=[2, 4]).encode(y=at["y"]),
            shown.mark_line(strokeWidth=1.8, clip=True).encode(**at, **_stroke(series)),
            _whiskers(shown, at, series),
            shown.mark_point(size=50, opacity=1, clip=True).encode(**at, **style(series), tooltip=tooltips(tips)),
            shown.transform_filter("datum.crossed")
            .mark_point(shape="M-1,-1L1,1M1,-1L-1,1", size=110, strokeWidth=2, color=INK, opacity=1)
            .encode(**at),
            here.mark_text(align="left", dx=4, dy=-6, color=DIM).encode(x=alt.value(0), y=at["y"], text="text:N"),
        ]
        panels.append(layered(layers, str(panel), size))
    return tuple(panels)


def frames(points: pd.DataFrame, series: Sequence[Series]) -> Panels:
    """PSNR per frame: `points` has track, series, frame, psnr. The page sets the signals `track` and `frame`."""
    shown = _shown(points).transform_filter("datum.track == track")
    at = {
        "x": alt.X(
            "frame:Q", title="frame", scale=alt.Scale(nice=False, zero=False), axis=alt.Axis(format="d", tickMinStep=1)
        ),
        "y": alt.Y("psnr:Q", title="foreground PSNR [dB]", scale=_fixed(_domain(points, ["psnr"], pad=0.06))),
    }
    now = alt.Chart(alt.Data(values=[{}])).transform_calculate(frame="frame")
    tips = tooltips([("series", "method", ""), ("frame", "frame", "d"), ("psnr", "PSNR [dB]", ".2f")])
    layers = [
        now.mark_rule(color=INK, strokeWidth=1.5).encode(x=at["x"]),
        shown.mark_line(strokeWidth=1.6).encode(**at, **_stroke(series)),
        shown.mark_point(size=24, opacity=1).encode(**at, **style(series), tooltip=tips),
    ]
    signals = [alt.param(name="track", value=0), alt.param(name="frame", value=0)]
    return (layered(layers, "", (WIDTH - 80, 190)).add_params(*signals),)


def heatmap(cells: pd.DataFrame, *, rows: Sequence[str], columns: Sequence[str], limit: float, title: str) -> Panels:
    """`cells`: row, column, value, text, interval, verdict, framed. Colours end at the limit on both sides."""
    top = alt.Axis(orient="top", labelAngle=-35, ticks=False, domain=False, labelPadding=6)
    x_scale = alt.Scale(domain=list(columns), paddingInner=0.06, paddingOuter=0.03)
    y_scale = alt.Scale(domain=list(rows), paddingInner=0.1, paddingOuter=0.05)
    at = {
        "x": alt.X("column:N", title=None, scale=x_scale, axis=top),
        "y": alt.Y("row:N", title=None, scale=y_scale, axis=alt.Axis(ticks=False, domain=False)),
    }
    scale = alt.Scale(domain=[-limit, 0, limit], range=list(RANGE), clamp=True, interpolate="rgb")
    tips = [("row", "", ""), ("column", "", ""), ("text", "dB lost", ""), ("interval", "95 %", ""), ("verdict", "", "")]
    shown = alt.Chart(inline(cells))
    index = "indexof(['better', 'worse'], datum.verdict)"
    text: dict[str, Any] = {"dy": -6, "fontSize": 13, "color": WRITING}
    layers = [
        shown.mark_rect(cornerRadius=2).encode(
            **at, fill=alt.Fill("value:Q", scale=scale, legend=None), tooltip=tooltips(tips)
        ),
        shown.transform_filter("datum.framed")
        .mark_rect(filled=False, stroke=FRAME, strokeWidth=2.5, cornerRadius=2)
        .encode(**at),
        shown.transform_filter(f"{index} >= 0").mark_text(fontWeight="bold", **text).encode(**at, text="text:N"),
        shown.transform_filter(f"{index} < 0").mark_text(**text).encode(**at, text="text:N"),
        shown.mark_text(dy=9, fontSize=10, color=WRITING).encode(**at, text="interval:N"),
    ]
    return (layered(layers, title, (CELL[0] * len(columns), CELL[1] * len(rows))),)


def least_width(columns: int) -> int:
    """Pixels that a matrix of so many columns and the names of its rows needs at least."""
    return round(LEAST_SCALE * CELL[0] * (columns + 2))


def layered(layers: Sequence[alt.Chart], title: str, size: tuple[int, int], note: Sequence[str] = ()) -> alt.LayerChart:
    """Layers as one panel, whose series the page can hide."""
    heading = alt.TitleParams(title, subtitle=list(note)) if note else alt.TitleParams(title)
    drawn: Any = alt.layer(*layers)
    chart: alt.LayerChart = drawn.properties(width=size[0], height=size[1]).add_params(
        alt.param(name="hidden", value=[])
    )
    return chart.properties(title=heading) if title else chart


def inline(table: pd.DataFrame) -> alt.Data:
    """The rows inline, NaN as null."""
    return alt.Data(values=json.loads(table.to_json(orient="records", double_precision=6)))


def style(series: Sequence[Series]) -> dict[str, Any]:
    """Fill, stroke and shape of marks, by the column `series`."""
    return {
        "fill": _scale("fill", series, [PAPER if s.hollow else s.colour for s in series]),
        "stroke": _scale("stroke", series, [s.colour for s in series]),
        "shape": _scale("shape", series, [s.shape for s in series]),
    }


def tooltips(fields: Sequence[tuple[str, str, str]]) -> list[alt.Tooltip]:
    """What is shown to the pointer: field, title and format."""
    return [
        alt.Tooltip(f"{field}:Q", title=title, format=how) if how else alt.Tooltip(f"{field}:N", title=title or " ")
        for field, title, how in fields
    ]


def _shown(rows: pd.DataFrame) -> alt.Chart:
    """The rows of the series that the page does not hide."""
    return alt.Chart(inline(rows)).transform_filter("indexof(hidden, datum.series) < 0")


def _scale(channel: str, series: Sequence[Series], values: Sequence[Any]) -> Any:
    scale = alt.Scale(domain=[s.title for s in series], range=list(values))
    kind = {"fill": alt.Fill, "stroke": alt.Stroke, "shape": alt.Shape}[channel]
    return kind("series:N", scale=scale, legend=alt.Legend(title=None))


def _stroke(series: Sequence[Series]) -> dict[str, Any]:
    return {"stroke": _scale("stroke", series, [s.colour for s in series])}


def _whiskers(chart: alt.Chart, at: dict[str, Any], series: Sequence[Series]) -> alt.Chart:
    with_interval = chart.transform_filter("isValid(datum.low)")
    return with_interval.mark_rule(strokeWidth=1.4, clip=True).encode(
        x=at["x"], y=alt.Y("low:Q"), y2="high:Q", **_stroke(series)
    )


def _fixed(domain: tuple[float, float]) -> alt.Scale:
    return alt.Scale(domain=domain, nice=False, zero=False)


def _domain(table: pd.DataFrame, columns: Sequence[str], pad: float = 0.1) -> tuple[float, float]:
    values = pd.to_numeric(table[[name for name in columns if name in table]].stack())
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    padding = pad * (high - low) or 1.0
    return low - padding, high + padding


def _log_domain(values: pd.Series, padding: float) -> tuple[float, float]:
    return float(values.min()) / padding, float(values.max()) * padding


def _log_ticks(domain: tuple[float, float]) -> list[float]:
    """1, 2, 5 of every decade; of many decades 1 only, and more within a single one."""
    low, high = (math.log10(value) for value in domain)
    steps: tuple[float, ...] = (1, 2, 5) if high - low < 2.5 else (1,)
    if high - low < 1:
        steps = (1, 1.5, 2, 3, 4, 5, 7)
    ticks = [step * 10.0**power for power in range(math.floor(low), math.ceil(high) + 1) for step in steps]
    return [tick for tick in ticks if domain[0] <= tick <= domain[1]]


def _number_axis(values: pd.Series, title: str, *, log: bool) -> alt.X:
    """An axis with ticks at its values, as far as they lie apart; a logarithmic one has those of its decades."""
    if log:
        domain = _log_domain(values, 1.1)
        scale = alt.Scale(type="log", domain=domain, nice=False)
        return alt.X("x:Q", title=title, scale=scale, axis=alt.Axis(values=_log_ticks(domain), format="~s"))
    ticks: list[float] = []
    for value in sorted(values.unique(), key=lambda value: (len(f"{value:.3g}"), value)):  # Rounder ones first.
        if all(abs(value - tick) >= TICK_GAP * float(values.max() - values.min()) for tick in ticks):
            ticks.append(float(value))
    scale = alt.Scale(padding=8, nice=False, zero=False)  # Room for the marks at both ends.
    return alt.X("x:Q", title=title, scale=scale, axis=alt.Axis(values=sorted(ticks), format=".3~g"))
