"""The kinds of charts in a report: one declarative specification each (Vega-Lite, by Altair), in panels."""

import json
import math
from collections.abc import Sequence
from typing import Any

import altair as alt
import pandas as pd

from benchmarks.report.vega import DIM, INK, LINE, PAPER, Series

FEW = 6  # Up to so many series are named where they are drawn, if there is room.
APART = 0.06  # of an axis, at least, between two of its ticks
WIDTH = 900  # pixels of a chart in a file
REAL_TIME_MS = 1e3 / 30
LEAST_REACH_DB = 2.0  # that a whisker may stand out beyond all points of a chart of speed


def speed(
    points: pd.DataFrame, front: pd.DataFrame, links: pd.DataFrame, series: Sequence[Series], *, notes: dict[str, str]
) -> tuple[tuple[alt.LayerChart, ...], bool]:
    """Accuracy against speed: a panel per `panel` of `points`, which all share both axes; and whether points are named.

    `points`: panel, series, ms, psnr, low, high, ringed, and where it lies below the chart note and level, a count.
    `front`: panel, ms, psnr of the staircase. `links`: panel, link, ms, psnr.
    """
    size, x, y = (380, 330), _log_domain(points["ms"], 1.5), _domain(_cut(points), ["psnr", "low", "high"])
    sides = [_sides(own, series, "ms", "psnr", x=x, y=y, size=size) for _, own in points.groupby("panel", sort=False)]
    named = len(series) <= FEW and all(side is not None for side in sides)
    placed = points.assign(side=pd.concat([side for side in sides if side is not None]) if named else "")
    panels = []
    for panel, own in placed.groupby("panel", sort=False):
        at = _xy("ms:Q", "psnr:Q", x, y, "ms per frame, one core", "foreground PSNR [dB]", log=True)
        tips = [("series", "method", ""), ("ms", "ms per frame", ".1f"), ("psnr", "PSNR [dB]", ".2f")]
        seen = alt.Chart(inline(own)).transform_filter("indexof(hidden, datum.series) < 0")
        step = front[front["panel"] == panel]
        stair = pd.concat([step.head(1).assign(psnr=y[0]), step, step.tail(1).assign(ms=x[1])])
        layers = [
            alt.Chart(inline(stair))
            .mark_line(interpolate="step-after", color=LINE, strokeWidth=1, clip=True)
            .encode(**at),
            alt.Chart(inline(links[links["panel"] == panel]))
            .mark_line(color=LINE, strokeDash=[3, 3], clip=True)
            .encode(**at, detail="link:N"),
            _whiskers(seen, at, series),
            seen.transform_filter("datum.ringed").mark_point(size=330, filled=False, color=INK, clip=True).encode(**at),
            seen.mark_point(size=80, opacity=1, strokeWidth=2, clip=True).encode(
                **at, **look(series), tooltip=tooltips(tips)
            ),
            *_labels(seen.transform_filter("!isValid(datum.level)"), at, own),
            *(
                _text(seen.transform_filter(f"datum.level === {level}"), at, "note:N", dy=-14 * level)
                for level in sorted(own["level"].dropna().unique())
            ),
        ]
        if x[0] < REAL_TIME_MS < x[1]:
            mark = pd.DataFrame({"ms": [REAL_TIME_MS], "psnr": [y[0]], "text": ["30 frames/s"]})
            layers.append(alt.Chart(inline(mark)).mark_rule(strokeDash=[2, 4]).encode(x=at["x"]))
            late = math.log(REAL_TIME_MS / x[0]) > 0.8 * math.log(x[1] / x[0])  # No room is left on the right.
            place: dict[str, Any] = {"dx": -4, "align": "right"} if late else {"dx": 4, "align": "left"}
            layers.append(_text(alt.Chart(inline(mark)), at, "text:N", dy=-6, color=DIM, **place))
        panels.append(layered(layers, f"{panel}", size, notes.get(str(panel), "")))
    return tuple(panels), named


def curves(
    points: pd.DataFrame, series: Sequence[Series], *, x: str, y: str, log: bool = True
) -> tuple[tuple[alt.LayerChart, ...], bool]:
    """Lines over time: `points` has series, x, y; each line is named at its end where there is room."""
    size = (WIDTH - 80, 260)
    names_at_ends = len(series) <= FEW
    domain = _log_domain(points["x"], 1.02) if log else (float(points["x"].min()), float(points["x"].max()))
    if names_at_ends:  # They are drawn inside, right of the last point.
        domain = (domain[0], domain[1] * (domain[1] / domain[0]) ** 0.22)
    span = _domain(points, ["y"], pad=0.06)
    ends = points.groupby("series", sort=False).tail(1)
    gaps = ends["y"].sort_values().diff().dropna() / (span[1] - span[0]) * size[1]
    named = names_at_ends and bool((gaps > 14).all())
    at = _xy("x:Q", "y:Q", domain, span, x, y, log=log)
    seen = alt.Chart(inline(points)).transform_filter("indexof(hidden, datum.series) < 0")
    last = alt.Chart(inline(ends)).transform_filter("indexof(hidden, datum.series) < 0")
    tips = tooltips([("series", "method", ""), ("x", x, ".3~s"), ("y", y, ".2f")])
    layers = [
        seen.mark_line(strokeWidth=1.8, clip=True).encode(**at, **_stroke(series, dashes=True)),
        seen.mark_point(size=22, opacity=1, clip=True).encode(**at, **look(series), tooltip=tips),
        *([_text(last, at, "series:N", dx=9, align="left")] if named else []),
    ]
    return (layered(layers, "", size),), named


def bars(rows: pd.DataFrame, series: Sequence[Series], *, x: str) -> tuple[alt.LayerChart, ...]:
    """Stacked bars: `rows` has row, series, value."""
    order = list(rows["row"].unique())
    totals = rows.groupby("row", sort=False, as_index=False)["value"].sum()
    y = alt.Y("row:N", sort=order, title=None, axis=alt.Axis(ticks=False, domain=False))
    limit = alt.Scale(domain=[0, float(totals["value"].max()) * 1.12])
    seen = alt.Chart(inline(rows.assign(order=rows["series"].map({s.title: i for i, s in enumerate(series)}))))
    drawn = seen.transform_filter("indexof(hidden, datum.series) < 0").mark_bar(clip=True)
    tips = tooltips([("row", "method", ""), ("series", "stage", ""), ("value", x, ".2f")])
    value = alt.X("value:Q", title=x, scale=limit)
    layers = [
        drawn.encode(
            y=y, x=value, order="order:Q", tooltip=tips, fill=_scale("fill", series, [s.colour for s in series])
        ),
        alt.Chart(inline(totals))
        .mark_text(align="left", dx=5, color=DIM)
        .encode(y=y, x=alt.X("value:Q"), text=alt.Text("value:Q", format=".1f")),
    ]
    return (layered(layers, "", (WIDTH - 220, 30 * len(order))),)


def forest(effects: pd.DataFrame, series: Sequence[Series], *, x: str) -> tuple[alt.LayerChart, ...]:
    """Differences with their intervals, a row each: `effects` has panel, row, mean, low, high, series (who is ahead).

    Rows are in the order of the first panel's means, all of which are shown. One wide interval does not press the rest
    together: it is cut.
    """
    order = list(effects.sort_values("mean", ascending=False, kind="stable")["row"].drop_duplicates())
    first = effects[effects["panel"] == effects["panel"].iloc[0]].sort_values("mean", ascending=False)
    order = [*first["row"], *(row for row in order if row not in set(first["row"]))]
    ends = effects[["low", "high"]].to_numpy()
    most = float(effects["mean"].abs().max())
    usual = max(0.16, 1.6 * float(pd.Series(abs(ends).ravel()).quantile(0.8)), 1.06 * most)
    low, high = max(-usual, min(0.0, float(ends.min()))), min(usual, max(0.0, float(ends.max())))
    room = 0.03 * (high - low)
    cut = effects.assign(
        start=effects["low"].clip(low, high), end=effects["high"].clip(low, high), zero=0.0, left=low, right=high
    )
    panels = []
    for panel, own in cut.groupby("panel", sort=False):
        at = alt.X("mean:Q", title=x, scale=alt.Scale(domain=[low - room, high + room], nice=False))
        y = alt.Y(
            "row:N", sort=order, title=None, scale=alt.Scale(domain=order), axis=alt.Axis(ticks=False, domain=False)
        )
        seen = alt.Chart(inline(own)).transform_filter("indexof(hidden, datum.series) < 0")
        span = [("low", "from", "+.2f"), ("high", "to", "+.2f")]
        tips = tooltips([("row", "", ""), ("mean", "difference", "+.2f"), *span])
        arrow: dict[str, Any] = {"size": 40, "opacity": 1, "clip": True}
        layers = [
            alt.Chart(inline(own.head(1))).mark_rule().encode(x=alt.X("zero:Q")),
            seen.mark_rule(strokeWidth=1.8, clip=True).encode(x=alt.X("start:Q"), x2="end:Q", y=y, **_stroke(series)),
            seen.transform_filter("datum.mean >= datum.left && datum.mean <= datum.right")
            .mark_point(size=60, opacity=1)
            .encode(x=at, y=y, **look(series), tooltip=tips),
            seen.transform_filter("datum.low < datum.left")
            .mark_point(shape="triangle-left", **arrow)
            .encode(x="left:Q", y=y, **_stroke(series)),
            seen.transform_filter("datum.high > datum.right")
            .mark_point(shape="triangle-right", **arrow)
            .encode(x="right:Q", y=y, **_stroke(series)),
        ]
        panels.append(layered(layers, str(panel), (300, 24 * len(order))))
    return tuple(panels)


def lines(
    samples: pd.DataFrame,
    series: Sequence[Series],
    *,
    y: str,
    size: tuple[int, int],
    rules: pd.DataFrame | None = None,
    log: bool = False,
) -> tuple[alt.LayerChart, ...]:
    """Small charts that share the scale of y: `samples` has panel, x_title, series, x, y, low, high and crossed.

    Where it has `scale`, too, panels of one value there share theirs. x is a number, or a text whose steps stand at
    even distances. `rules`: panel, y, text.
    """
    rules = pd.DataFrame(columns=["panel", "y", "text"]) if rules is None else rules
    panels = []
    for panel, own in samples.groupby("panel", sort=False):
        alike = samples[samples["scale"] == own["scale"].iloc[0]] if "scale" in samples else samples
        span = _domain(pd.concat([alike, rules]), ["y", "low", "high"], pad=0.05)
        number = pd.api.types.is_numeric_dtype(samples["x"])
        title = str(own["x_title"].iloc[0])
        at = {
            "x": _number_axis(own["x"], title, log=log)
            if number
            else alt.X("x:O", title=title, sort=list(own["x"].unique()), axis=alt.Axis(labelAngle=0)),
            "y": alt.Y("y:Q", title=y, scale=alt.Scale(domain=span, nice=False, zero=False)),
        }
        seen = alt.Chart(inline(own)).transform_filter("indexof(hidden, datum.series) < 0")
        here = rules[rules["panel"] == panel]
        tips = tooltips(
            [("series", "", ""), ("x", title, ""), ("y", y, ".2f"), ("low", "from", ".2f"), ("high", "to", ".2f")]
        )
        layers = [
            alt.Chart(inline(here)).mark_rule(strokeDash=[2, 4]).encode(y=at["y"]),
            seen.mark_line(strokeWidth=1.8, clip=True).encode(**at, **_stroke(series)),
            _whiskers(seen, at, series),
            seen.mark_point(size=50, opacity=1, clip=True).encode(**at, **look(series), tooltip=tips),
            seen.transform_filter("datum.crossed")
            .mark_point(shape="M-1,-1L1,1M1,-1L-1,1", size=110, strokeWidth=2, color=INK, opacity=1)
            .encode(**at),
            alt.Chart(inline(here))
            .mark_text(align="left", dx=4, dy=-6, color=DIM)
            .encode(x=alt.value(0), y=at["y"], text="text:N"),
        ]
        panels.append(layered(layers, str(panel), size))
    return tuple(panels)


def frames(points: pd.DataFrame, series: Sequence[Series]) -> tuple[alt.LayerChart, ...]:
    """PSNR per frame: `points` has track, series, frame, psnr. The page sets the signals `track` and `frame`."""
    span = _domain(points, ["psnr"], pad=0.06)
    shown = alt.Chart(inline(points)).transform_filter("datum.track == track && indexof(hidden, datum.series) < 0")
    at = {
        "x": alt.X(
            "frame:Q", title="frame", scale=alt.Scale(nice=False, zero=False), axis=alt.Axis(format="d", tickMinStep=1)
        ),
        "y": alt.Y("psnr:Q", title="foreground PSNR [dB]", scale=alt.Scale(domain=span, nice=False, zero=False)),
    }
    now = alt.Chart(alt.Data(values=[{}])).transform_calculate(frame="frame")
    tips = tooltips([("series", "method", ""), ("frame", "frame", "d"), ("psnr", "PSNR [dB]", ".2f")])
    layers = [
        now.mark_rule(color=INK, strokeWidth=1.5).encode(x=at["x"]),
        shown.mark_line(strokeWidth=1.6).encode(**at, **_stroke(series, dashes=True)),
        shown.mark_point(size=24, opacity=1).encode(**at, **look(series), tooltip=tips),
    ]
    signals = [alt.param(name="track", value=0), alt.param(name="frame", value=0)]
    return (layered(layers, "", (WIDTH - 80, 190)).add_params(*signals),)


def layered(layers: Sequence[alt.Chart], title: str, size: tuple[int, int], note: str = "") -> alt.LayerChart:
    """Layers as one panel, whose series the page can hide."""
    heading = alt.TitleParams(title, subtitle=note) if note else alt.TitleParams(title)
    hidden = alt.param(name="hidden", value=[])
    drawn: Any = alt.layer(*layers)
    chart: alt.LayerChart = drawn.properties(width=size[0], height=size[1]).add_params(hidden)
    return chart.properties(title=heading) if title else chart


def inline(table: pd.DataFrame) -> alt.Data:
    """The rows inline, NaN as null."""
    return alt.Data(values=json.loads(table.to_json(orient="records", double_precision=6)))


def _xy(
    x: str,
    y: str,
    x_domain: tuple[float, float],
    y_domain: tuple[float, float],
    x_title: str,
    y_title: str,
    *,
    log: bool,
) -> dict[str, Any]:
    scale = alt.Scale(type="log" if log else "linear", domain=x_domain, nice=False)
    axis = alt.Axis(values=_log_ticks(x_domain), format="~s") if log else alt.Axis()
    return {
        "x": alt.X(x, title=x_title, scale=scale, axis=axis),
        "y": alt.Y(y, title=y_title, scale=alt.Scale(domain=y_domain, nice=False, zero=False)),
    }


def _scale(channel: str, series: Sequence[Series], values: Sequence[Any]) -> Any:
    scale = alt.Scale(domain=[s.title for s in series], range=list(values))
    kind = {"fill": alt.Fill, "stroke": alt.Stroke, "shape": alt.Shape, "strokeDash": alt.StrokeDash}[channel]
    legend = None if channel == "strokeDash" else alt.Legend(title=None)
    return kind("series:N", scale=scale, legend=legend)


def look(series: Sequence[Series]) -> dict[str, Any]:
    """Fill, stroke and shape of marks, by the column `series`."""
    return {
        "fill": _scale("fill", series, [PAPER if s.hollow else s.colour for s in series]),
        "stroke": _scale("stroke", series, [s.colour for s in series]),
        "shape": _scale("shape", series, [s.shape for s in series]),
    }


def _stroke(series: Sequence[Series], *, dashes: bool = False) -> dict[str, Any]:
    found = {"stroke": _scale("stroke", series, [s.colour for s in series])}
    if dashes:
        found["strokeDash"] = _scale("strokeDash", series, [[5, 3] if s.hollow else [1, 0] for s in series])
    return found


def _whiskers(chart: alt.Chart, at: dict[str, Any], series: Sequence[Series]) -> alt.Chart:
    with_interval = chart.transform_filter("isValid(datum.low)")
    return with_interval.mark_rule(strokeWidth=1.4, clip=True).encode(
        x=at["x"], y=alt.Y("low:Q"), y2="high:Q", **_stroke(series)
    )


def tooltips(fields: Sequence[tuple[str, str, str]]) -> list[alt.Tooltip]:
    """What is shown to the pointer: field, title and format."""
    return [
        alt.Tooltip(f"{field}:Q", title=title, format=how) if how else alt.Tooltip(f"{field}:N", title=title or " ")
        for field, title, how in fields
    ]


def _text(chart: alt.Chart, at: dict[str, Any], text: str, **mark: Any) -> alt.Chart:
    return chart.mark_text(clip=True, **mark).encode(x=at["x"], y=at["y"], text=text)


def _labels(chart: alt.Chart, at: dict[str, Any], points: pd.DataFrame) -> list[alt.Chart]:
    """Names beside their points, a layer for each side that is used."""
    places = {
        "right": (10, 0, "left"),
        "left": (-10, 0, "right"),
        "above": (0, -14, "center"),
        "under": (0, 15, "center"),
    }
    return [
        _text(chart.transform_filter(f"datum.side == '{side}'"), at, "series:N", dx=dx, dy=dy, align=align)
        for side, (dx, dy, align) in places.items()
        if (points["side"] == side).any()
    ]


def _sides(
    points: pd.DataFrame,
    series: Sequence[Series],
    x_name: str,
    y_name: str,
    *,
    x: tuple[float, float],
    y: tuple[float, float],
    size: tuple[int, int],
) -> pd.Series | None:
    """On which side of each point its name has room, free of points and other names; None where one has none."""
    across = (points[x_name].map(math.log) - math.log(x[0])) / (math.log(x[1]) - math.log(x[0])) * size[0]
    down = (y[1] - points[y_name]) / (y[1] - y[0]) * size[1]
    taken = [(px - 7, py - 7, px + 7, py + 7) for px, py in zip(across, down, strict=True)]
    found = {}
    for index, px, py, name in zip(points.index, across, down, points["series"], strict=True):
        wide = 6.8 * len(name)
        boxes = {
            "right": (px + 8, py - 7, px + 10 + wide, py + 7),
            "left": (px - 10 - wide, py - 7, px - 8, py + 7),
            "above": (px - wide / 2, py - 21, px + wide / 2, py - 8),
            "under": (px - wide / 2, py + 8, px + wide / 2, py + 22),
        }
        for side, box in boxes.items():
            inside = box[0] >= 0 and box[2] <= size[0] and box[1] >= 0 and box[3] <= size[1]
            if inside and not any(_touch(box, other) for other in taken):
                taken.append(box)
                found[index] = side
                break
        else:
            return None
    return pd.Series(found)


def _touch(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _domain(table: pd.DataFrame, columns: Sequence[str], pad: float = 0.1) -> tuple[float, float]:
    values = pd.to_numeric(table[[name for name in columns if name in table]].stack())
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    room = pad * (high - low) or 1.0
    return low - room, high + room


def _cut(points: pd.DataFrame) -> pd.DataFrame:
    """With whiskers that stand out no farther than the points span, so that one failure hides no difference."""
    low, high = points["psnr"].min(), points["psnr"].max()
    reach = max(LEAST_REACH_DB, high - low)
    return points.assign(low=points["low"].clip(lower=low - reach), high=points["high"].clip(upper=high + reach))


def _log_domain(values: pd.Series, room: float) -> tuple[float, float]:
    return float(values.min()) / room, float(values.max()) * room


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
    scale = alt.Scale(padding=8, nice=False, zero=False)  # Room for the marks at both ends.
    return alt.X("x:Q", title=title, scale=scale, axis=alt.Axis(values=_ticks_apart(values), format=".3~g"))


def _ticks_apart(values: pd.Series) -> list[float]:
    """Values that a label each has room for; of two that are too close, the rounder one."""
    least = APART * float(values.max() - values.min())
    ticks: list[float] = []
    for value in sorted(values.unique(), key=lambda value: (len(f"{value:.3g}"), value)):
        if all(abs(value - tick) >= least for tick in ticks):
            ticks.append(float(value))
    return sorted(ticks)
