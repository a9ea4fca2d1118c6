"""What torch's convolutions and splatting cost each other by turns, and what idle threads cost that wait by spinning.

How the threads of torch's OpenMP runtime wait is settled as it is loaded. So each way has a process of its own,
`python -m benchmarks.speed.mixture`, and the processes are asked by turns.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise

import torch

from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import splat
from benchmarks.speed.scenes import splat_scene

THREADS = (1, 2)
PARTS = ("convolution", "splat", "by turns")
CALLS = 5  # of each part, one after the other, before another process has its turn
WAITING = ("briefly", "spinning")  # As this process was told to (`benchmarks.cli`), and as untold.
SETTINGS = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")

Samples = dict[str, list[float]]  # milliseconds by part


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Forward and backward of a convolution and of scene S, each alone and by turns: medians in milliseconds."""

    threads: int
    waiting: str  # one of WAITING
    convolution_ms: float
    splat_ms: float
    alternating_ms: float
    alternating_min_ms: float

    @property
    def ratio(self) -> float:
        """Alternating over the sum of both alone; 1: they do not disturb each other."""
        return self.alternating_ms / (self.convolution_ms + self.splat_ms)


def time_mixture(*, rounds: int) -> list[Mixture]:
    """By number of threads and way of waiting; all take part in every round, and the first round is not counted."""
    found: dict[tuple[int, str], Samples] = {(n, how): {part: [] for part in PARTS} for n in THREADS for how in WAITING}
    with ExitStack() as stack:
        processes = {how: stack.enter_context(_process(how)) for how in WAITING}
        for number in range(rounds + 1):
            for (threads, how), samples in found.items():
                for part, taken in _asked(processes[how], threads).items():
                    samples[part] += taken if number else []
    return [_mixture(threads, how, samples) for (threads, how), samples in found.items()]


def _mixture(threads: int, waiting: str, samples: Samples) -> Mixture:
    convolution, drawing, alternating = (statistics.median(samples[part]) for part in PARTS)
    return Mixture(
        threads=threads,
        waiting=waiting,
        convolution_ms=convolution,
        splat_ms=drawing,
        alternating_ms=alternating,
        alternating_min_ms=min(samples[PARTS[-1]]),
    )


@contextmanager
def _process(waiting: str) -> Iterator[subprocess.Popen[str]]:
    told = dict(os.environ)
    if waiting == "spinning":
        told = {name: value for name, value in told.items() if name not in SETTINGS}
    command = [sys.executable, "-m", "benchmarks.speed.mixture"]
    with subprocess.Popen(command, env=told, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _asked(process: subprocess.Popen[str], threads: int) -> Samples:
    assert process.stdin is not None and process.stdout is not None
    print(threads, file=process.stdin, flush=True)
    answer: Samples = json.loads(process.stdout.readline())
    return answer


def _parts() -> dict[str, Callable[[], None]]:
    scene = splat_scene("S")
    leaves = {name: getattr(scene.gaussians, name).clone().requires_grad_() for name in Gaussians.__slots__}
    layer = torch.nn.Conv2d(32, 32, 3, padding=1)
    features = torch.randn(1, 32, 64, 64, generator=torch.Generator().manual_seed(0))

    def convolve() -> None:
        layer(features).square().sum().backward()

    def draw() -> None:
        splat(Gaussians(**leaves), **scene.cameras, threads=torch.get_num_threads()).rgb.sum().backward()

    def both() -> None:
        convolve()
        draw()

    return dict(zip(PARTS, (convolve, draw, both), strict=True))


def serve() -> None:
    """Of each line, a number of threads, time every part on them, and answer with a line of milliseconds."""
    parts = _parts()
    for line in sys.stdin:
        torch.set_num_threads(int(line))
        print(json.dumps({part: _times(call) for part, call in parts.items()}), flush=True)


def _times(call: Callable[[], None]) -> list[float]:
    moments = [time.perf_counter()]
    for _ in range(CALLS):
        call()
        moments.append(time.perf_counter())
    return [1e3 * (end - start) for start, end in pairwise(moments)]


def print_mixtures(mixtures: list[Mixture]) -> None:
    """A line for each, with its time by turns over that of one thread."""
    one = {mixture.waiting: mixture for mixture in mixtures if mixture.threads == 1}
    print("torch's convolution and splat S, medians; threads with nothing to do wait")
    for mixture in mixtures:
        alone = one[mixture.waiting]
        print(
            f"  {mixture.waiting:8} on {mixture.threads}: {mixture.convolution_ms:.2f} and {mixture.splat_ms:.2f} ms"
            f" alone, {mixture.alternating_ms:.2f} by turns: {mixture.ratio:.2f} of the sum,"
            f" {mixture.alternating_ms / alone.alternating_ms:.2f} of one thread's"
            f" (least: {mixture.alternating_min_ms / alone.alternating_min_ms:.2f})",
            flush=True,
        )


if __name__ == "__main__":
    serve()
