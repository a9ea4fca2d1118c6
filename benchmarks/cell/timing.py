"""Training time, a fixed workload that measures how fast the machine is, and peak memory."""

import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WARM_UP_FRAMES = 3
TIMED_FRAMES = 15


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingTime:
    """Seconds of a training, seen from outside: by the clock, and of CPU time of all the method's processes.

    A process that was stopped, or shared its core, has less of the latter; one that used several cores has more.
    """

    wall_s: float
    cpu_s: float | None  # None: a result from before it was measured


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
