"""The training curve out of a method's log."""

import json
import math
from pathlib import Path
from typing import Any

from benchmarks.cells import CurvePoint

MAX_POINTS = 200


def read_curve(path: Path) -> tuple[CurvePoint, ...]:
    """Points of `log.jsonl` that carry `seconds` and a `loss` or `train_psnr`, in order of time, thinned to 200.

    Lines of other kinds, and the half line that an interrupted process leaves, are passed over.
    """
    if not path.exists():
        return ()
    points = [point for line in path.read_text(errors="replace").splitlines() if (point := _point(line)) is not None]
    points.sort(key=lambda point: point.seconds)
    return tuple(points[i] for i in _thin(len(points)))


def _point(line: str) -> CurvePoint | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    if not isinstance(row, dict):
        return None
    seconds, loss, psnr = (_finite(row.get(name)) for name in ("seconds", "loss", "train_psnr"))
    if seconds is None or (loss is None and psnr is None):
        return None
    return CurvePoint(seconds=seconds, loss=loss, psnr=psnr)


def _finite(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _thin(count: int) -> list[int]:
    step = max(1, math.ceil(count / MAX_POINTS))
    return sorted({*range(0, count, step), *([count - 1] if count else [])})
