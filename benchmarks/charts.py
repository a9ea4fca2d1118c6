"""Charts as SVG, drawn without a plotting library: small, crisp, on white and on dark paper, equal bytes each time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html import escape

FONT = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif"
STYLE = """\
text{font-family:FONT;font-size:12px;fill:#1f2733}.dim{fill:#5d6878}.head{font-size:14px;font-weight:600}
.grid{stroke:#d8dde5;stroke-width:1}.axis,.front{stroke:#8a94a3;stroke-width:1}.paper{fill:#ffffff}.hollow{fill:#ffffff}
.halo{paint-order:stroke;stroke:#ffffff;stroke-width:3px;stroke-linejoin:round}
@media (prefers-color-scheme:dark){text{fill:#e6eaf0}.dim{fill:#9aa6b6}.grid{stroke:#2c3543}.axis,.front{stroke:#66717f}
.paper,.hollow{fill:#12171f}.halo{stroke:#12171f}}""".replace("FONT", FONT)


SPAN = 9.0  # dB that a chart shows below its best point
FEW_POINTS, ROOM_PER_POINT = 8, 12.0  # From how many points on a chart grows, and by how many pixels each.
APART = 17.0  # pixels between a point and a label that needs a line


@dataclass(frozen=True, kw_only=True, slots=True)
class Point:
    """A method in a scatter chart. A hollow one is a bound, not a competitor; `low` and `high` are its interval.

    One that is not `named` shows its label to the pointer only.
    """

    x: float
    y: float
    label: str
    colour: str
    hollow: bool = False
    low: float | None = None
    high: float | None = None
    ringed: bool = False
    named: bool = True


@dataclass(frozen=True, kw_only=True, slots=True)
class Panel:
    """A scatter panel: points, dashed links and a front (indices of points), and a note in its upper corner."""

    title: str
    points: tuple[Point, ...]
    links: tuple[tuple[int, int], ...] = ()
    front: tuple[int, ...] = ()
    note: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Line:
    """A curve."""

    label: str
    colour: str
    points: tuple[tuple[float, float], ...]
    dashed: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Bar:
    """A horizontal bar of stacked parts."""

    label: str
    parts: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Axis:
    """A mapping from values to pixels, linear or logarithmic, with its tick values."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False
    ticks: tuple[float, ...] = field(default=())

    def at(self, value: float) -> float:
        """Pixel of a value."""
        low, high, value = (math.log10(v) if self.log else v for v in (self.low, self.high, value))
        return self.start + (value - low) / (high - low) * (self.end - self.start)


def scatter(panels: Sequence[Panel], *, x_title: str, y_title: str, width: float = 900.0, height: float = 400.0) -> str:
    """Accuracy against speed: panels side by side that share both axes; x is logarithmic milliseconds.

    What lies more than `SPAN` below the best stands at the lower edge with its value: it would press the rest together.
    """
    panels = _lifted(panels)
    everything = [point for panel in panels for point in panel.points]
    if not everything:
        return document("", width=width, height=60.0, title="no results")
    height += ROOM_PER_POINT * max(0, max(len(panel.points) for panel in panels) - FEW_POINTS)
    left, right, top, bottom, gap = 58.0, 16.0, 44.0, 52.0, 28.0
    each = (width - left - right - gap * (len(panels) - 1)) / len(panels)
    y = linear_axis(
        [v for p in everything for v in (p.y, p.low, p.high) if v is not None], start=height - bottom, end=top, pad=0.12
    )
    parts = []
    for index, panel in enumerate(panels):
        start = left + index * (each + gap)
        x = log_axis([point.x for point in everything], start=start, end=start + each)
        parts.append(_frame(panel.title, x, y, y_labels=index == 0))
        parts.append(_real_time(x, y))
        parts.append(_points(panel, x, y))
        if panel.note:
            parts.append(text_at(start + each, top - 16, panel.note, anchor="end", kind="dim"))
        parts.append(text_at(start + each / 2, height - 12, x_title, anchor="middle", kind="dim"))
    middle = (top + height - bottom) / 2
    turned = f'transform="rotate(-90 16 {short(middle)})"'
    parts.append(text_at(16.0, middle, y_title, anchor="middle", kind="dim", extra=turned))
    return document("".join(parts), width=width, height=height, title=f"{y_title} against {x_title}")


def _lifted(panels: Sequence[Panel]) -> list[Panel]:
    """The panels, with points that lie far below all others raised to the floor and named with their value."""
    floor = max((point.y for panel in panels for point in panel.points), default=0.0) - SPAN

    def lift(point: Point) -> Point:
        if point.y >= floor:
            return point
        return replace(point, y=floor, low=None, high=None, label=f"{point.label}: {point.y:.1f} ↓", named=True)

    return [replace(panel, points=tuple(map(lift, panel.points))) for panel in panels]


def curves(lines: Sequence[Line], *, x_title: str, y_title: str, width: float = 900.0, height: float = 320.0) -> str:
    """Curves over a logarithmic x axis, each named at its end."""
    drawn = [line for line in lines if len(line.points) > 1]
    if not drawn:
        return ""
    left, right, top, bottom = 58.0, 150.0, 20.0, 48.0
    x = log_axis([point[0] for line in drawn for point in line.points], start=left, end=width - right, tight=True)
    y = linear_axis([point[1] for line in drawn for point in line.points], start=height - bottom, end=top, pad=0.05)
    parts = [_frame("", x, y, y_labels=True)]
    ends = _apart([y.at(line.points[-1][1]) for line in drawn], 15.0, top, height - bottom)
    for line, end in zip(drawn, ends, strict=True):
        path = " ".join(f"{short(x.at(px))},{short(y.at(py))}" for px, py in line.points)
        dash = ' stroke-dasharray="5 3"' if line.dashed else ""
        title = f"<title>{escape(line.label)}: {line.points[-1][1]:.2f} after {line.points[-1][0]:.0f} s</title>"
        stroke = f'stroke="{line.colour}" stroke-width="1.8" fill="none" stroke-linejoin="round"{dash}'
        parts.append(f'<polyline points="{path}" {stroke}>{title}</polyline>')
        tip_x, tip_y = x.at(line.points[-1][0]), y.at(line.points[-1][1])
        parts.append(f'<circle cx="{short(tip_x)}" cy="{short(tip_y)}" r="3" fill="{line.colour}"/>')
        parts.append(text_at(width - right + 10, end + 4, line.label, colour=line.colour))
    parts.append(text_at((left + width - right) / 2, height - 10, x_title, anchor="middle", kind="dim"))
    middle = (top + height - bottom) / 2
    turned = f'transform="rotate(-90 16 {short(middle)})"'
    parts.append(text_at(16.0, middle, y_title, anchor="middle", kind="dim", extra=turned))
    return document("".join(parts), width=width, height=height, title=f"{y_title} over {x_title}")


def bars(rows: Sequence[Bar], names: Sequence[str], colours: Sequence[str], *, unit: str, width: float = 900.0) -> str:
    """Horizontal stacked bars with a legend."""
    if not rows:
        return ""
    left, right, top, step = 170.0, 70.0, 40.0, 30.0
    height = top + step * len(rows) + 10
    scale = (width - left - right) / max(sum(row.parts) for row in rows)
    parts, at = [], left
    for name, colour in zip(names, colours, strict=True):
        parts.append(f'<rect x="{short(at)}" y="10" width="12" height="12" rx="2" fill="{colour}"/>')
        parts.append(text_at(at + 17, 20.0, name, kind="dim"))
        at += 34 + 6.6 * len(name)
    for index, row in enumerate(rows):
        y, at = top + index * step, left
        parts.append(text_at(left - 10, y + 15, row.label, anchor="end"))
        for name, colour, value in zip(names, colours, row.parts, strict=True):
            title = f"<title>{escape(row.label)}, {escape(name)}: {value:.2f} {unit}</title>"
            box = f'x="{short(at)}" y="{short(y)}" width="{short(value * scale)}" height="20"'
            parts.append(f'<rect {box} fill="{colour}">{title}</rect>')
            at += value * scale
        parts.append(text_at(at + 6, y + 15, f"{sum(row.parts):.1f} {unit}", kind="dim"))
    return document("".join(parts), width=width, height=height, title="time per stage")


def document(content: str, *, width: float, height: float, title: str) -> str:
    """A complete SVG that adapts to light and dark pages."""
    size = f'viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="{escape(title)}">'
        f"<style>{STYLE}</style>"
        f'<rect class="paper" width="{width:g}" height="{height:g}" rx="6"/>{content}</svg>\n'
    )


def linear_axis(values: Sequence[float], *, start: float, end: float, pad: float) -> Axis:
    """An axis with round ticks around the values."""
    low, high = min(values), max(values)
    room = max((high - low) * pad, 0.5 if high - low < 1e-9 else 0.0)
    low, high = low - room, high + room
    raw = (high - low) / 6
    magnitude = 10 ** math.floor(math.log10(raw))
    step = next(m * magnitude for m in (1, 2, 5, 10) if m * magnitude >= raw)
    first = math.ceil(low / step)
    ticks = tuple(float(round(i * step, 10)) for i in range(first, math.floor(high / step) + 1))
    return Axis(low, high, start, end, False, ticks)


def log_axis(values: Sequence[float], *, start: float, end: float, tight: bool = False) -> Axis:
    """A logarithmic axis with ticks at 1, 2, 5 times powers of ten, closer ones where that leaves fewer than three."""
    positive = [max(value, 1e-3) for value in values]
    low, high = min(positive), max(positive)
    room = 1.02 if tight else max(1.5, (high / low) ** 0.14, (4 * low / high) ** 0.5)
    low, high = low / room, high * room
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: tuple[float, ...] = ()
    for multiples in ((1, 2, 5), (1, 2, 3, 5, 7), tuple(range(1, 10))):
        ticks = tuple(m * 10.0**p for p in powers for m in multiples if low <= m * 10.0**p <= high)
        if len(ticks) >= 3:
            break
    return Axis(low, high, start, end, True, ticks)


def place_labels(
    anchors: Sequence[tuple[float, float]],
    widths: Sequence[float],
    box: tuple[float, float, float, float],
    obstacles: Sequence[tuple[float, float, float, float]] = (),
) -> list[tuple[float, float]]:
    """Where labels go (left end of the base line) so that they touch neither points, nor each other, nor the box.

    Greedy over a ring of candidate places, least overlap first, right of the point preferred.
    """
    height = 13.0
    taken = [(x - 6, y - 6, x + 6, y + 6) for x, y in anchors] + list(obstacles)
    places = []
    for (x, y), width in zip(anchors, widths, strict=True):
        candidates = []
        for reach in (0.0, 10.0, 22.0, 36.0):
            for dx, dy in ((9, 4), (-width - 9, 4), (-width / 2, -10), (-width / 2, 20), (7, -8), (7, 17)):
                away = reach * (1 if dy > 4 else -1 if dy < 4 else 0)
                candidates.append((x + dx, y + dy + away))
            candidates += [(x + 9, y + 4 + reach), (x + 9, y + 4 - reach)]
            candidates += [(x - width - 9, y + 4 + reach), (x - width - 9, y + 4 - reach)]

        def cost(place: tuple[float, float], width: float = width) -> float:
            area = (place[0], place[1] - height + 2, place[0] + width, place[1] + 3)
            outside = sum(max(0.0, v) for v in (box[0] - area[0], box[1] - area[1], area[2] - box[2], area[3] - box[3]))
            return sum(_overlap(area, other) for other in taken) + 50 * outside

        best = min(candidates, key=lambda place: (round(cost(place), 3), candidates.index(place)))
        places.append(best)
        taken.append((best[0], best[1] - height + 2, best[0] + width, best[1] + 3))
    return places


def text_width(text: str) -> float:
    """About how wide a label is at 12 px."""
    narrow = sum(character in "il.,:;'|! /" for character in text)
    return 7.6 * (len(text) - narrow) + 4.2 * narrow


def _points(panel: Panel, x: Axis, y: Axis) -> str:
    anchors = [(x.at(point.x), y.at(point.y)) for point in panel.points]
    parts = [_front([anchors[i] for i in panel.front], x, y)]
    for a, b in panel.links:
        (x1, y1), (x2, y2) = anchors[a], anchors[b]
        dashes = f'stroke="{panel.points[a].colour}" stroke-width="1.2" stroke-dasharray="3 3" opacity="0.75"'
        parts.append(f'<line x1="{short(x1)}" y1="{short(y1)}" x2="{short(x2)}" y2="{short(y2)}" {dashes}/>')
    whiskers = []
    pairs = list(zip(panel.points, anchors, strict=True))
    for point, (px, _) in pairs:
        if point.low is not None and point.high is not None:
            low, high = y.at(point.low), y.at(point.high)
            caps = f"M{short(px - 4)} {short(low)}h8M{short(px - 4)} {short(high)}h8"
            parts.append(
                f'<path d="M{short(px)} {short(low)}V{short(high)}{caps}" '
                f'stroke="{point.colour}" stroke-width="1.3" fill="none"/>'
            )
            whiskers.append((px - 4, min(low, high), px + 4, max(low, high)))
    for point, (px, py) in pairs:
        ink = f'class="hollow" stroke="{point.colour}" stroke-width="2"' if point.hollow else f'fill="{point.colour}"'
        title = f"<title>{escape(point.label)}: {point.y:.2f} at {point.x:.1f} ms</title>"
        if point.ringed:
            ring = f'stroke="{point.colour}" stroke-width="1.4" fill="none"'
            parts.append(f'<circle class="ring" cx="{short(px)}" cy="{short(py)}" r="9.5" {ring}/>')
        parts.append(f'<circle cx="{short(px)}" cy="{short(py)}" r="5.5" {ink}>{title}</circle>')
    nameless = [(px - 6, py - 6, px + 6, py + 6) for point, (px, py) in pairs if not point.named]
    named = [(point, anchor) for point, anchor in pairs if point.named]
    widths = [text_width(point.label) for point, _ in named]
    box = (x.start, y.end, x.end, y.start)
    places = place_labels([anchor for _, anchor in named], widths, box, [*whiskers, *nameless])
    for (point, anchor), place, width in zip(named, places, widths, strict=True):
        parts.append(_leader(anchor, place, width, point.colour))
        parts.append(text_at(*place, point.label, colour=point.colour, kind="halo"))
    return "".join(parts)


def _leader(anchor: tuple[float, float], place: tuple[float, float], width: float, colour: str) -> str:
    """A line from a point to its label where the label had to stand apart."""
    near = min(max(anchor[0], place[0]), place[0] + width), min(max(anchor[1], place[1] - 9), place[1] + 1)
    if math.dist(anchor, near) < APART:
        return ""
    ends = f'x1="{short(anchor[0])}" y1="{short(anchor[1])}" x2="{short(near[0])}" y2="{short(near[1])}"'
    return f'<line {ends} stroke="{colour}" stroke-width="0.8" opacity="0.7"/>'


def _front(anchors: Sequence[tuple[float, float]], x: Axis, y: Axis) -> str:
    """The staircase above which no method lies, from the cheapest member to the right edge."""
    if not anchors:
        return ""
    path = f"M{short(anchors[0][0])} {short(y.start)}"
    for px, py in anchors:
        path += f"H{short(px)}V{short(py)}"
    return f'<path class="front" d="{path}H{short(x.end)}" fill="none" stroke-width="1"/>'


def _frame(title: str, x: Axis, y: Axis, *, y_labels: bool) -> str:
    parts = [text_at(x.start, y.end - 16, title, kind="head")] if title else []
    for tick in y.ticks:
        at = short(y.at(tick))
        parts.append(f'<line class="grid" x1="{short(x.start)}" x2="{short(x.end)}" y1="{at}" y2="{at}"/>')
        if y_labels:
            parts.append(text_at(x.start - 7, y.at(tick) + 4, _tick(tick), anchor="end", kind="dim"))
    for tick in x.ticks:
        at = short(x.at(tick))
        parts.append(f'<line class="grid" x1="{at}" x2="{at}" y1="{short(y.start)}" y2="{short(y.end)}"/>')
        parts.append(text_at(x.at(tick), y.start + 16, _tick(tick), anchor="middle", kind="dim"))
    parts.append(
        f'<line class="axis" x1="{short(x.start)}" x2="{short(x.end)}" y1="{short(y.start)}" y2="{short(y.start)}"/>'
    )
    return "".join(parts)


def _real_time(x: Axis, y: Axis) -> str:
    """A line where 30 frames per second are reached."""
    frame_ms = 1e3 / 30
    if not x.low < frame_ms < x.high:
        return ""
    at = short(x.at(frame_ms))
    line = f'<line class="axis" stroke-dasharray="2 4" x1="{at}" x2="{at}" y1="{short(y.start)}" y2="{short(y.end)}"/>'
    label = "30 frames/s"
    side, anchor = (5, "start") if x.at(frame_ms) + text_width(label) < x.end else (-5, "end")
    return line + text_at(x.at(frame_ms) + side, y.start - 7, label, anchor=anchor, kind="dim")


def _apart(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Positions near the wanted ones, at least `gap` apart, in the same order."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    placed = [0.0] * len(wanted)
    at = low - gap
    for index in order:
        at = placed[index] = max(wanted[index], at + gap)
    overflow = at - high
    if overflow > 0:
        limit = high
        for index in reversed(order):
            limit = placed[index] = min(placed[index], limit)
            limit -= gap
    return placed


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def text_at(
    x: float, y: float, text: str, *, anchor: str = "start", kind: str = "", colour: str = "", extra: str = ""
) -> str:
    """A text element; `kind` is a class of the style sheet."""
    kinds = f' class="{kind}"' if kind else ""
    fill = f' style="fill:{colour}"' if colour else ""
    where = f'x="{short(x)}" y="{short(y)}" text-anchor="{anchor}"'
    return f"<text {where}{kinds}{fill}{' ' + extra if extra else ''}>{escape(text)}</text>"


def _tick(value: float) -> str:
    return f"{value:g}"


def short(value: float) -> str:
    """A coordinate with no more digits than a screen shows."""
    return f"{value:.1f}".rstrip("0").rstrip(".")
