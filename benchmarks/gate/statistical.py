"""What needs statistics: scores of trainings that came out different, and times."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.analysis.statistics import Comparison, compare_samples, corrected
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import CellResult, Timing
from benchmarks.gate.baseline import Entry
from benchmarks.gate.checks import GATED, Check, Verdict

OF_VERDICT: dict[str, Verdict] = {
    "worse": "worse",
    "better": "better than explained",
    "equivalent": "not worse",
    "unclear": "not worse",
}
EXACT_COUNTS = ("params", "gaussians")
SLOWER = 1.12  # ratio of least times
SLOWER_STORED = 1.6  # The same code was 27 % slower after an hour on the same quiet machine.
WHOLE = ("frame", "training")  # Stages rose to 2.7 times beside busy cores, and frames by 8 %.
SHORTEST = 0.1  # times the reference workload: what is shorter is noise, and so is
SHORTEST_TRAINING = 100.0  # a training below a second, which is mostly start and reading (+63 % beside other work)
MORE_MEMORY = 1.10

Pairs = dict[str, tuple[Sequence[Entry], Sequence[Entry]]]  # by row: before and after, seeds in order


def judge_quality(pairs: Pairs, *, looks: int) -> tuple[list[Check], list[str]]:
    """Compare scores in pairs: the same seed before and after, which share their random numbers.

    `looks`: how often this run is judged at most, once after each further seed; p values are multiplied by it
    (Bonferroni), then corrected over all comparisons (Holm). Also returns the rows of which more seeds would tell more.
    """
    checks: list[Check] = []
    changes: list[tuple[str, str, str]] = []  # row, name, change
    tests: list[Comparison] = []
    undecided: list[str] = []
    for row, (before, after) in pairs.items():
        old_of_seed = {entry.result.config.seed: entry.result for entry in before}
        shared = [entry.result for entry in after if entry.result.config.seed in old_of_seed]
        seeds = [(old_of_seed[new.config.seed], new) for new in shared]
        if all([v.prediction for v in old.views] == [v.prediction for v in new.views] for old, new in seeds):
            checks.append(Check(row, "quality", "unchanged", f"identical predictions of {len(seeds)} seeds"))
        elif len(seeds) < 2:
            detail = "another picture with the only seed that both have: expected a second"
            checks.append(Check(row, "quality", "not judged", detail))
            undecided.append(row)
        else:
            for name in GATED:
                values = [(old.value(*name), new.value(*name)) for old, new in seeds]
                if any(old is not None and new is None for old, new in values):
                    checks.append(_missing(row, name))
                elif all(old is not None for old, _ in values):
                    metric, (old, new) = METRICS[name[2]], np.array(values, dtype=float).T
                    up = metric.direction == "up"
                    by_seed = ({str(seed): [value] for seed, value in enumerate(side)} for side in (new, old))
                    test = compare_samples(*by_seed, margin=metric.abs_tol, higher_is_better=up)
                    assert test is not None, "the seeds are common"
                    tests.append(replace(test, p=min(1.0, looks * test.p)))
                    change = f"{old.mean():.4g} -> {new.mean():.4g}{metric.unit and ' ' + metric.unit}"
                    changes.append((row, "/".join(name), change))
    for (row, quality, change), test in zip(changes, corrected(tests), strict=True):
        detail = (
            f"{change} ({test.mean:+.4g} [{test.low:+.4g}, {test.high:+.4g}], p {test.p:.2g}, {test.verdict}; "
            f"a change of {max(test.margin, test.detectable):.2g} would have been seen)"
        )
        checks.append(Check(row, "quality", OF_VERDICT[test.verdict], detail, quality))
        if test.verdict == "unclear" and row not in undecided:
            undecided.append(row)
    return checks, undecided


def _missing(row: str, name: tuple[str, str, str]) -> Check:
    """A score that was measured and is not any more; LPIPS where its weights are absent is not judged."""
    if name[2] == "lpips":
        return Check(row, "quality", "not judged", "n/a: no weights for LPIPS here", "/".join(name))
    return Check(row, "quality", "worse", "not measured", "/".join(name))


def count_checks(row: str, before: CellResult, after: CellResult) -> list[Check]:
    """Work that is counted, not timed: any change is told, a rise fails."""
    checks = []
    for name in EXACT_COUNTS:
        old, new = before.value("memory", "", name), after.value("memory", "", name)
        if old is None or new is None:
            continue
        verdict: Verdict = "unchanged" if new == old else "worse" if new > old else "not worse"
        checks.append(Check(row, "cost", verdict, f"{old:g} -> {new:g}", name))
    return checks


def memory_check(row: str, before: Sequence[Entry], after: Sequence[Entry]) -> Check:
    """Peak memory of training and drawing, the largest of all seeds."""
    old, new = (max((e.result.value("memory", "", "peak_rss_mb") or 0.0) for e in each) for each in (before, after))
    verdict: Verdict = "worse" if new > MORE_MEMORY * old else "unchanged"
    detail = f"{old:.0f} -> {new:.0f} MB (a rise from {MORE_MEMORY - 1:.0%} on fails)"
    return Check(row, "cost", verdict, detail, "peak memory")


def least_times(timings: Iterable[Timing], *, beside: Iterable[Timing] = ()) -> dict[str, float]:
    """Least times of a frame and its stages over the least of the reference workload, for noise only ever adds.

    `beside`: timings of the same minutes, in which the reference workload had as good a chance.
    """
    least: dict[str, float] = {}
    reference = min((ms for timing in beside for ms in timing.reference_ms), default=math.inf)
    for timing in timings:
        measured = {"frame": timing.frame_ms, **timing.stage_ms}
        least |= {name: min(least.get(name, math.inf), *values) for name, values in measured.items()}
        reference = min(reference, *timing.reference_ms)
    return {name: value / reference for name, value in least.items()}


def training_time(entries: Sequence[Entry]) -> dict[str, float]:
    """The least CPU time of a training over the least time of the reference workload."""
    seconds = [value for e in entries if (value := e.result.value("speed", "", "train_cpu_s")) is not None]
    references = [min(e.result.timing.reference_ms) for e in entries if e.result.timing is not None]
    return {"training": 1e3 * min(seconds) / min(references)} if seconds and references else {}


def rises(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Ratios of the times that both have and that are long enough to be compared."""
    both = {name: (old, after[name]) for name, old in before.items() if name in after}
    shortest = {"training": SHORTEST_TRAINING}
    return {name: new / old for name, (old, new) in both.items() if max(old, new) >= shortest.get(name, SHORTEST)}


def time_checks(row: str, before: Mapping[str, float], after: Mapping[str, float], *, stored: bool) -> list[Check]:
    """Times as ratios to the reference workload.

    `stored`: those before were not measured in turn with those after; stages are too short to be compared then.
    """
    fails = SLOWER_STORED if stored else SLOWER
    checks = []
    for name, rise in rises(before, after).items():
        if stored and name not in WHOLE:
            continue
        verdict: Verdict = "worse" if rise >= fails else "not judged" if rise >= SLOWER else "unchanged"
        limit = f"a rise from {fails - 1:.0%} on fails"
        if verdict == "not judged":
            limit = f"stored times cannot decide a rise below {fails - 1:.0%}"
            limit += "" if name == "training" else "; --against REV does"
        detail = f"{before[name]:.4g} -> {after[name]:.4g} times the reference workload ({rise - 1:+.0%}; {limit})"
        checks.append(Check(row, "cost", verdict, detail, f"time of {name}"))
    return checks
