"""The training curve out of a method's log."""

import json
import math
from itertools import islice
from pathlib import Path
from typing import Any

from ash.files import open_regular
from benchmarks.cell.schema import CurvePoint

MAX_POINTS = 200
SETTLED_DB = 0.3

LARGEST_LOG, LONGEST_LINE, MOST_LINES = 1 << 28, 1 << 16, 1_000_000
LARGEST_VALUE = 1e12


def read_curve(path: Path) -> tuple[CurvePoint, ...]:
    """Points of `log.jsonl` that carry `seconds` and a `loss` or `train_psnr`, in order of time, thinned to some 200.

    Lines of other kinds, and the half line that an interrupted process leaves, are passed over.
    """
    if not path.exists():
        return ()
    with open_regular(path, most=LARGEST_LOG) as file:
        lines = iter(lambda: file.readline(LONGEST_LINE), b"")
        points = [point for line in islice(lines, MOST_LINES) if (point := _point(line)) is not None]
    points.sort(key=lambda point: point.seconds)
    return tuple(points[i] for i in _thin(points))


def seconds_to_settle(curve: tuple[CurvePoint, ...]) -> float | None:
    """Seconds after which every score of the reserved views lies within 0.3 dB of the last; None without scores."""
    scored = [(point.seconds, point.psnr) for point in curve if point.psnr is not None]
    below = [i for i, (_, psnr) in enumerate(scored) if psnr < scored[-1][1] - SETTLED_DB]
    return scored[below[-1] + 1 if below else 0][0] if scored else None


def _point(line: bytes) -> CurvePoint | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict):
        return None
    seconds, loss, psnr = (_finite(row.get(name)) for name in ("seconds", "loss", "train_psnr"))
    if seconds is None or (loss is None and psnr is None):
        return None
    return CurvePoint(seconds=seconds, loss=loss, psnr=psnr)


def _finite(value: Any) -> float | None:
    known = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST_VALUE
    return float(value) if known else None


def _thin(points: list[CurvePoint]) -> list[int]:
    """Every point with a score, the last, and as many of the others as there is room for."""
    step = max(1, math.ceil(len(points) / MAX_POINTS))
    scored = [i for i, point in enumerate(points) if point.psnr is not None]
    return sorted({*range(0, len(points), step), *scored[-MAX_POINTS:], *([len(points) - 1] if points else [])})
