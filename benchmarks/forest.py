"""Differences with their intervals, a row each: SVG of the same make as `benchmarks/charts.py`."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from benchmarks.charts import Axis, document, linear_axis, short, text_at, text_width

ROW, TOP, BELOW = 22.0, 44.0, 46.0
NUMBERS = 176.0  # pixels for what is written beside a panel
ROOMY = 1.6  # Shown are this many times the extent of the middle eighty per cent; arrows point to what lies beyond.
ABOVE, BELOW_ZERO, UNSURE = "#2f6fde", "#dd6b20", "#8a94a3"  # Where the interval lies, or that it holds zero.


@dataclass(frozen=True, kw_only=True, slots=True)
class Effect:
    """A difference with its interval."""

    label: str
    mean: float
    low: float
    high: float

    @property
    def colour(self) -> str:
        """By sign, where there is one."""
        return ABOVE if self.low > 0 else BELOW_ZERO if self.high < 0 else UNSURE


@dataclass(frozen=True, kw_only=True, slots=True)
class ForestPanel:
    """One column of the chart. Labels that it lacks leave their row empty."""

    title: str
    effects: tuple[Effect, ...]


def forest(panels: Sequence[ForestPanel], *, x_title: str, width: float = 900.0) -> str:
    """The panels side by side, rows in the order of the first panel's means; all share the scale of x."""
    effects = [effect for panel in panels for effect in sorted(panel.effects, key=lambda effect: -effect.mean)]
    labels = list(dict.fromkeys(effect.label for effect in effects))
    if not labels:
        return ""
    left = 20.0 + max(map(text_width, labels))
    each = (width - left) / len(panels)
    height = TOP + ROW * len(labels) + BELOW
    low, high = _extent(effects)
    parts = [text_at(left - 12, TOP + ROW * (i + 0.5) + 4, label, anchor="end") for i, label in enumerate(labels)]
    for index, panel in enumerate(panels):
        start = left + index * each
        x = linear_axis([low, 0.0, high], start=start, end=start + each - NUMBERS, pad=0.02)
        parts.append(_panel(panel, labels, x, height, x_title))
    return document("".join(parts), width=width, height=height, title=x_title)


def _extent(effects: Sequence[Effect]) -> tuple[float, float]:
    """What the scale covers: all of what is usual, so that one wide interval does not press the rest together."""
    ends = np.array([(effect.low, effect.high) for effect in effects])
    usual = ROOMY * max(0.1, float(np.quantile(np.abs(ends), 0.8)))
    return max(-usual, float(ends[:, 0].min())), min(usual, float(ends[:, 1].max()))


def _panel(panel: ForestPanel, labels: Sequence[str], x: Axis, height: float, x_title: str) -> str:
    floor = height - BELOW
    parts = [text_at(x.start, TOP - 18, panel.title, kind="head")]
    for tick in x.ticks:
        kind = "axis" if tick == 0 else "grid"
        at = short(x.at(tick))
        parts.append(f'<line class="{kind}" x1="{at}" x2="{at}" y1="{short(TOP - 6)}" y2="{short(floor)}"/>')
        parts.append(text_at(x.at(tick), floor + 16, f"{tick:g}", anchor="middle", kind="dim"))
    parts.append(text_at((x.start + x.end) / 2, floor + 34, x_title, anchor="middle", kind="dim"))
    for effect in panel.effects:
        y = TOP + ROW * (labels.index(effect.label) + 0.5)
        parts.append(_row(effect, x, y))
        numbers = f"{effect.mean:+.2f} [{effect.low:+.2f}, {effect.high:+.2f}]"
        parts.append(text_at(x.end + 12, y + 4, numbers, kind="dim" if effect.colour == UNSURE else ""))
    return "".join(parts)


def _row(effect: Effect, x: Axis, y: float) -> str:
    low, high = max(effect.low, x.low), min(effect.high, x.high)
    path = f"M{short(x.at(low))} {short(y)}H{short(x.at(high))}" if low < high else ""
    if effect.low < x.low:
        path += f"M{short(x.start + 5)} {short(y - 4)}l-5 4l5 4"
    if effect.high > x.high:
        path += f"M{short(x.end - 5)} {short(y - 4)}l5 4l-5 4"
    parts = [f'<path d="{path}" stroke="{effect.colour}" stroke-width="1.6" fill="none"/>']
    if x.low <= effect.mean <= x.high:
        title = f"<title>{escape(effect.label)}: {effect.mean:+.2f}</title>"
        parts.append(
            f'<circle cx="{short(x.at(effect.mean))}" cy="{short(y)}" r="4.5" fill="{effect.colour}">{title}</circle>'
        )
    return "".join(parts)
