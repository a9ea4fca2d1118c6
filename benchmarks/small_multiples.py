"""Many small line charts that share their y axis: SVG of the same make as `benchmarks/charts.py`."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from benchmarks.charts import Axis, document, linear_axis, short, text_at, text_width


@dataclass(frozen=True, kw_only=True, slots=True)
class Sample:
    """A value with its interval, None where there is none; a crossed one is marked."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None
    crossed: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Series:
    """Samples joined by a line, or alone."""

    label: str
    colour: str
    samples: tuple[Sample, ...]
    joined: bool = True


@dataclass(frozen=True, kw_only=True, slots=True)
class Rule:
    """A labelled horizontal line."""

    y: float
    label: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Multiple:
    """One small chart. `ticks` are positions on x and what is written there."""

    title: str
    x_title: str
    ticks: tuple[tuple[float, str], ...]
    series: tuple[Series, ...]
    rules: tuple[Rule, ...] = ()


def small_multiples(multiples: Sequence[Multiple], *, y_title: str, columns: int = 3, width: float = 900.0) -> str:
    """The charts in rows of `columns`, with one legend; y covers every sample and rule of all of them."""
    if not multiples:
        return ""
    left, right, top, gap, below = 52.0, 12.0, 40.0, 20.0, 66.0
    tall = 450.0 / columns
    each = (width - left - right - gap * (columns - 1)) / columns
    rows = -(-len(multiples) // columns)
    values = [
        v for m in multiples for s in m.series for p in s.samples for v in (p.y, p.low, p.high) if v is not None
    ] + [rule.y for m in multiples for rule in m.rules]
    parts = [_legend(multiples, left)]
    for index, multiple in enumerate(multiples):
        x0 = left + (index % columns) * (each + gap)
        y0 = top + 24 + (index // columns) * (tall + below)
        y = linear_axis(values, start=y0 + tall, end=y0, pad=0.05)
        parts.append(_chart(multiple, x0, x0 + each, y, y_labels=index % columns == 0))
    middle = top + rows * (tall + below) / 2
    parts.append(
        text_at(13.0, middle, y_title, anchor="middle", kind="dim", extra=f'transform="rotate(-90 13 {short(middle)})"')
    )
    return document("".join(parts), width=width, height=top + rows * (tall + below), title=y_title)


def _legend(multiples: Sequence[Multiple], at: float) -> str:
    parts = []
    for label, colour in dict.fromkeys((s.label, s.colour) for m in multiples for s in m.series):
        parts.append(f'<circle cx="{short(at + 5)}" cy="16" r="4.5" fill="{colour}"/>')
        parts.append(text_at(at + 14, 20.0, label))
        at += 32 + text_width(label)
    if any(sample.crossed for m in multiples for s in m.series for sample in s.samples):
        parts.append(_cross(at + 5, 16.0, "#8a94a3") + text_at(at + 14, 20.0, "breakdown", kind="dim"))
    return "".join(parts)


def _chart(multiple: Multiple, start: float, end: float, y: Axis, *, y_labels: bool) -> str:
    xs = [position for position, _ in multiple.ticks] + [p.x for s in multiple.series for p in s.samples]
    room = 0.06 * (max(xs) - min(xs)) or 1.0
    x = Axis(min(xs) - room, max(xs) + room, start, end)
    parts = [text_at(start, y.end - 8, multiple.title, kind="head")]
    for tick in y.ticks:
        at = short(y.at(tick))
        parts.append(f'<line class="grid" x1="{short(start)}" x2="{short(end)}" y1="{at}" y2="{at}"/>')
        if y_labels:
            parts.append(text_at(start - 7, y.at(tick) + 4, f"{tick:g}", anchor="end", kind="dim"))
    for position, label in multiple.ticks:
        parts.append(text_at(x.at(position), y.start + 16, label, anchor="middle", kind="dim"))
    parts.append(text_at((start + end) / 2, y.start + 33, multiple.x_title, anchor="middle", kind="dim"))
    for rule in multiple.rules:
        at = short(y.at(rule.y))
        parts.append(
            f'<line class="axis" stroke-dasharray="2 4" x1="{short(start)}" x2="{short(end)}" y1="{at}" y2="{at}"/>'
        )
        parts.append(text_at(start + 3, y.at(rule.y) - 4, rule.label, kind="dim halo"))
    return "".join([*parts, *(_series(series, x, y) for series in multiple.series)])


def _series(series: Series, x: Axis, y: Axis) -> str:
    parts = []
    if series.joined:
        path = " ".join(f"{short(x.at(p.x))},{short(y.at(p.y))}" for p in series.samples)
        parts.append(f'<polyline points="{path}" stroke="{series.colour}" stroke-width="1.8" fill="none"/>')
    for p in series.samples:
        px, py = x.at(p.x), y.at(p.y)
        if p.low is not None and p.high is not None:
            whisker = f"M{short(px)} {short(y.at(p.low))}V{short(y.at(p.high))}"
            parts.append(f'<path d="{whisker}" stroke="{series.colour}" stroke-width="1.3" fill="none"/>')
        title = f"<title>{escape(series.label)}: {p.y:.2f}</title>"
        parts.append(f'<circle cx="{short(px)}" cy="{short(py)}" r="3.5" fill="{series.colour}">{title}</circle>')
        if p.crossed:
            parts.append(_cross(px, py, series.colour))
    return "".join(parts)


def _cross(x: float, y: float, colour: str) -> str:
    d = f"M{short(x - 6)} {short(y - 6)}l12 12M{short(x + 6)} {short(y - 6)}l-12 12"
    return f'<path d="{d}" stroke="{colour}" stroke-width="2" fill="none"/>'
