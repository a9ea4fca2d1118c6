"""Rows of speed: what was timed, on what, by which candidate, and how much faster than its definition."""

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from ash.devices import CPU, finish


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
    ratio: float  # the naive minimum over this one's, both from this run


@dataclass(frozen=True, kw_only=True)
class TimedCandidate:
    """Something to be timed, and how many of its calls make one sample beside one of the slowest's."""

    name: str
    threads: int
    call: Callable[[], object]
    repeats: int = 1


def in_turns(
    naive: Callable[[], object], native: Callable[..., object], threads: tuple[int, ...]
) -> list[TimedCandidate]:
    """The definition as it runs, then its kernel, ten times as often, on each number of `threads`."""
    return [
        TimedCandidate(name="naive", threads=torch.get_num_threads(), call=naive),
        *(TimedCandidate(name="native", threads=n, call=partial(native, threads=n), repeats=10) for n in threads),
    ]


def time_interleaved(
    candidates: list[TimedCandidate], *, rounds: int, device: torch.device = CPU
) -> dict[tuple[str, int], list[float]]:
    """Milliseconds of every call, in rounds over all candidates: they share the machine's good and bad moments.

    A call is over when what it queued on `device` is done.
    """
    times: dict[tuple[str, int], list[float]] = {(c.name, c.threads): [] for c in candidates}
    for candidate in candidates[1:]:
        candidate.call()
    finish(device)
    for _ in range(rounds):
        for candidate in candidates:
            for _ in range(candidate.repeats):
                start = time.perf_counter()
                candidate.call()
                finish(device)
                times[candidate.name, candidate.threads].append(1e3 * (time.perf_counter() - start))
    return times


def rows_of(
    what: str, size: str, pass_: str, times: dict[tuple[str, int], list[float]], device: torch.device = CPU
) -> list[SpeedRow]:
    """The candidates' rows; the first candidate is the one that the ratios refer to."""
    reference = min(next(iter(times.values())))
    return [
        row_of(what, size, pass_, threads, name, samples, reference, device)
        for (name, threads), samples in times.items()
    ]


def row_of(
    what: str,
    size: str,
    pass_: str,
    threads: int,
    candidate: str,
    samples: list[float],
    reference_ms: float,
    device: torch.device = CPU,
) -> SpeedRow:
    """One candidate's row; its ratio is `reference_ms` over its minimum."""
    return SpeedRow(
        what=what,
        size=size,
        pass_=pass_,
        device=str(device),
        threads=threads,
        candidate=candidate,
        min_ms=min(samples),
        median_ms=statistics.median(samples),
        ratio=reference_ms / min(samples),
    )


def as_json(row: SpeedRow) -> dict[str, object]:
    """The row under its public names; null for a ratio to nothing."""
    known = {name.rstrip("_"): value for name, value in vars(row).items()}
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in known.items()}


def print_rows(rows: list[SpeedRow]) -> None:
    """A line for each."""
    for row in rows:
        print(
            f"{row.what:15} {row.size:9} {row.pass_:17} {row.threads:2} {row.candidate:7}"
            f" {row.min_ms:10.2f} {row.median_ms:10.2f} {row.ratio:8.1f}",
            flush=True,
        )
