"""Times of candidates, interleaved in one process, and their rows: minimum, median, ratio to the definition."""

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from ash.devices import CPU, finish

WHOLE = ""  # the key of a call's whole time, beside those of its stages
Samples = dict[tuple[str, int], dict[str, list[float]]]  # milliseconds by candidate and threads, then by stage


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A function to be timed. It gets the number of its call and may return milliseconds of its stages."""

    name: str
    threads: int
    call: Callable[[int], Mapping[str, float] | None]
    before: Callable[[int], object] = lambda number: None  # each call, not timed
    after: Callable[[int], object] = lambda number: None  # the same
    repeats: int = 1  # calls per round


@dataclass(frozen=True, kw_only=True)
class SpeedRow:
    """One line of the table."""

    what: str
    size: str
    pass_: str  # forward or forward+backward
    device: str
    threads: int
    candidate: str
    min_ms: float
    median_ms: float
    ratio: float  # minimum of the definition over this minimum, both of this run; nan: nothing to compare with


def time_interleaved(
    candidates: list[Candidate], *, rounds: int, warm_up: bool = True, device: torch.device = CPU
) -> Samples:
    """Milliseconds of every call. All candidates take part in each round, so that load on the machine hits all.

    A call ends when what it queued on `device` is done. `warm_up`: each candidate but the first is called once before.
    """
    samples: Samples = {(c.name, c.threads): defaultdict(list) for c in candidates}
    numbers = dict.fromkeys(samples, 0)

    def timed(candidate: Candidate) -> tuple[float, Mapping[str, float]]:
        number = numbers[candidate.name, candidate.threads]
        numbers[candidate.name, candidate.threads] += 1
        candidate.before(number)
        finish(device)
        start = time.perf_counter()
        stages = candidate.call(number)
        finish(device)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        candidate.after(number)
        return elapsed_ms, stages or {}

    for candidate in candidates[1:] if warm_up else ():
        timed(candidate)
    for _ in range(rounds):
        for candidate in candidates:
            for _ in range(candidate.repeats):
                whole, stages = timed(candidate)
                for stage, ms in {**stages, WHOLE: whole}.items():
                    samples[candidate.name, candidate.threads][stage].append(ms)
    return samples


@contextmanager
def torch_threads_restored() -> Iterator[None]:
    """Restore the number of torch's threads at the end."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def rows_of(what: str, size: str, pass_: str, samples: Samples, device: torch.device = CPU) -> list[SpeedRow]:
    """A row per candidate and stage. Ratios are to the first candidate's whole; a stage has none."""
    reference = min(next(iter(samples.values()))[WHOLE])
    return [
        SpeedRow(
            what=stage or what,
            size=size,
            pass_=pass_,
            device=str(device),
            threads=threads,
            candidate=name,
            min_ms=min(ms),
            median_ms=statistics.median(ms),
            ratio=math.nan if stage else reference / min(ms),
        )
        for (name, threads), stages in samples.items()
        for stage, ms in stages.items()
    ]


def as_json(row: SpeedRow) -> dict[str, object]:
    """The row under its public names; null for a ratio to nothing."""
    values = {name.rstrip("_"): value for name, value in vars(row).items()}
    return values | {"ratio": None if math.isnan(row.ratio) else row.ratio}


def print_head() -> None:
    """The head of `print_rows`."""
    print(
        f"{'what':22} {'size':9} {'pass':17} th {'by':18} {'min ms':>10} {'median ms':>10} {'naive/min':>9} {'1/s':>6}"
    )


def print_rows(rows: Iterable[SpeedRow]) -> None:
    """A line for each."""
    for row in rows:
        ratio = "" if math.isnan(row.ratio) else f"{row.ratio:.1f}"
        rate = f"{1e3 / row.median_ms:.1f}" if row.what in ("frame", "train_step") else ""
        print(
            f"{row.what:22} {row.size:9} {row.pass_:17} {row.threads:2} {row.candidate:18}"
            f" {row.min_ms:10.2f} {row.median_ms:10.2f} {ratio:>9} {rate:>6}",
            flush=True,
        )
