"""Patterns on cloth, from plain to tartan: a colour for every place, given in metres around and along a garment."""

from collections.abc import Callable

import numpy as np

from synth.person.cast import Print
from synth.person.palettes import Colour

SHARP = 0.0015  # metres over which a figure's edge is softened


def edge(x: np.ndarray, width: float) -> np.ndarray:
    """A step at zero, softened over `width` metres."""
    return np.clip(x / width + 0.5, 0, 1)


def stripes(x: np.ndarray, period: float, share: float = 0.5, soft: float = SHARP) -> np.ndarray:
    """1 on stripes, 0 between them."""
    phase = (x / period) % 1.0
    distance = np.minimum(np.abs(phase - share / 2), np.abs(phase - 1 - share / 2))
    return edge((share / 2 - distance) * period, soft)


def mix(base: np.ndarray, colour: Colour, amount: np.ndarray) -> np.ndarray:
    """Colours `[n, 3]` with a share `[n]` of another one."""
    return base + amount[:, None] * (np.array(colour) - base)


def plain(count: int, colour: Colour) -> np.ndarray:
    """One colour, `[n, 3]`."""
    return np.tile(np.array(colour, dtype=np.float64), (count, 1))


def printed(cloth: Print, around: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The colours `[n, 3]` of a print at `around` and `along` `[n]`, metres."""
    ground, figure, line = cloth.colours
    colour = plain(len(along), ground)
    shapes, lines = PATTERNS[cloth.kind](around, along, cloth.period)
    if shapes is not None:
        colour = mix(colour, figure, shapes)
    return colour if lines is None else mix(colour, line, lines)


Pattern = tuple[np.ndarray | None, np.ndarray | None]  # how much of figure and line there is, 0..1


def _tartan(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    wide = 0.5 * stripes(around, period, 0.5) + 0.5 * stripes(along, period, 0.5)
    return wide, np.maximum(stripes(around, period, 0.07), stripes(along, period, 0.07))


def _checks(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    return 0.5 * stripes(around, period) + 0.5 * stripes(along, period), None


def _argyle(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    lozenge = stripes(along + around, period, 0.35) * stripes(along - around, period, 0.35)
    thread = stripes(along + around, period, 0.06) + stripes(along - around, period, 0.06)
    return 0.85 * lozenge, 0.6 * np.clip(thread, 0, 1)


def _dots(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    row = np.floor(along / period)
    x = (around / period + 0.5 * (row % 2)) % 1.0 - 0.5
    y = (along / period) % 1.0 - 0.5
    return edge((0.27 - np.hypot(x, y)) * period, SHARP), None


def _zigzag(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    wave = np.abs((around / (1.6 * period)) % 1.0 - 0.5) * 1.2 * period
    return stripes(along + wave, period), None


def _leaves(around: np.ndarray, along: np.ndarray, period: float) -> Pattern:
    """Slender ellipses, every second row leaning the other way, with a vein."""
    row = np.floor(along / period)
    lean = np.where(row % 2 == 0, 0.7, -0.7)
    x = (around / (0.8 * period) + 0.31 * row) % 1.0 - 0.5
    y = (along / period) % 1.0 - 0.5
    long, wide = x * np.sin(lean) + y * np.cos(lean), x * np.cos(lean) - y * np.sin(lean)
    inside = (1 - np.hypot(long / 0.46, wide / 0.2)) * 0.2 * period
    return edge(inside, SHARP), edge(0.02 * period - np.abs(wide) * period, SHARP) * edge(inside, SHARP)


PATTERNS: dict[str, Callable[[np.ndarray, np.ndarray, float], Pattern]] = {
    "plain": lambda around, along, period: (None, None),
    "stripes": lambda around, along, period: (stripes(along, period), None),
    "pinstripes": lambda around, along, period: (stripes(around, period, 0.2), None),
    "checks": _checks,
    "tartan": _tartan,
    "argyle": _argyle,
    "dots": _dots,
    "zigzag": _zigzag,
    "leaves": _leaves,
}
