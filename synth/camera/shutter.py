"""Motion blur: where the surface is while a shutter is open."""

import numpy as np

POSES = 8  # that an open shutter averages


def shutter_poses(frames: np.ndarray, at: int, *, shutter: float, count: int = POSES) -> list[np.ndarray]:
    """Poses `[s, 3]` of the surface while the shutter is open around frame `at` of a sequence `[t, s, 3]`.

    `shutter` is the time it is open as a share of the time between frames; zero gives the frame itself. Between frames
    every vertex moves along the Catmull-Rom curve through its places, and beyond the ends of the sequence on uniformly.
    The times are the middles of equal shares of the time that it is open.
    """
    if shutter == 0:
        return [frames[at]]
    times = at + shutter * ((np.arange(count) + 0.5) / count - 0.5)
    return [_between(frames, time).astype(frames.dtype) for time in times]


def _between(frames: np.ndarray, time: float) -> np.ndarray:
    first = int(np.clip(np.floor(time), 0, max(len(frames) - 2, 0)))
    x = time - first
    knots = [_extended(frames, first + k) for k in (-1, 0, 1, 2)]
    a, b, c, d = knots
    if not 0 <= x <= 1:  # Beyond an end: uniform motion.
        return b + x * (c - b)
    return b + 0.5 * x * (c - a + x * (2 * a - 5 * b + 4 * c - d + x * (3 * (b - c) + d - a)))


def _extended(frames: np.ndarray, index: int) -> np.ndarray:
    last = len(frames) - 1
    if index < 0:
        return frames[0].astype(np.float64) - (frames[min(1, last)].astype(np.float64) - frames[0]) * -index
    if index > last:
        step = frames[last].astype(np.float64) - frames[max(last - 1, 0)]
        return frames[last].astype(np.float64) + step * (index - last)
    return frames[index].astype(np.float64)
