"""How long a frame takes, by stage, beside a fixed workload that tells how fast the machine was; how much memory."""

import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ash.capture.dataset import Capture, Pose
from ash.protocol import Drawn, StageClock
from benchmarks.cell.schema import Timing
from benchmarks.cell.views import View

WARM_UP_FRAMES = 3
TIMED_FRAMES = 15


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingTime:
    """Seconds of a training, seen from outside: by the clock, and of CPU time of all the method's processes.

    A process that was stopped, or shared its core, has less of the latter; one that used several cores has more.
    """

    wall_s: float
    cpu_s: float | None  # None: a result from before it was measured


def time_frames(avatar: Drawn, capture: Capture, views: list[View]) -> Timing:
    """Time single frames after a warm-up, each after the one before it, as in playback: caches may help as there."""
    frame_ms, reference_ms = [], []
    stage_ms: dict[str, list[float]] = {}
    for index in range(WARM_UP_FRAMES + TIMED_FRAMES):
        view = views[index % len(views)]
        camera, clock = capture.cameras[view.camera], StageClock()
        avatar.render(Pose(capture.motion, max(0, view.frame - 1)), camera, clock=StageClock())
        start = time.perf_counter()
        avatar.render(Pose(capture.motion, view.frame), camera, clock=clock)
        elapsed = (time.perf_counter() - start) * 1e3
        reference = reference_workload_ms()
        if index >= WARM_UP_FRAMES:
            frame_ms.append(elapsed)
            reference_ms.append(reference)
            for name, value in clock.ms.items():
                stage_ms.setdefault(name, []).append(value)
    stages = {name: tuple(values) for name, values in sorted(stage_ms.items())}
    return Timing(frame_ms=tuple(frame_ms), stage_ms=stages, reference_ms=tuple(reference_ms))


def reference_workload_ms() -> float:
    """Milliseconds of a fixed mixture of arithmetic and memory traffic (a product and a sort), a few ms on one core."""
    grid = np.sin(np.arange(192 * 192, dtype=np.float32)).reshape(192, 192)
    start = time.perf_counter()
    product = grid
    for _ in range(8):
        product = np.tanh(product @ grid)
        np.sort(product, axis=None)
    return (time.perf_counter() - start) * 1e3


def peak_memory_mb() -> float:
    """The largest resident memory of this process so far, in MiB.

    Linux's `ru_maxrss` survives `exec`: a child of a large process would begin with its parent's peak.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10  # macOS counts bytes
