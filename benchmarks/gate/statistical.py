"""What needs statistics: scores of trainings that came out different, and times."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True, kw_only=True, slots=True)
class Quality:
    """Checks of scores, and the rows of which more seeds would tell more."""

    checks: tuple[Check, ...]
    undecided: tuple[str, ...]


def judge_quality(pairs: Pairs, *, looks: int) -> Quality:
    """Compare scores in pairs: the same seed before and after, which share their random numbers.

    `looks`: how often this run is judged at most, once after each further seed; p values are multiplied by it
    (Bonferroni), then corrected over all comparisons (Holm).
    """
    checks: list[Check] = []
    tests: list[tuple[str, tuple[str, str, str], Comparison, float, float]] = []
    undecided = []
    for row, (before, after) in pairs.items():
        seeds = _common(before, after)
        if all(_drawn(old) == _drawn(new) for old, new in seeds):
            detail = f"identical predictions of {len(seeds)} seeds"
            checks.append(Check(row=row, layer="quality", verdict="unchanged", detail=detail))
        elif len(seeds) < 2:
            told = "another picture with the only seed that both have: expected a second"
            checks.append(Check(row=row, layer="quality", verdict="not judged", detail=told))
            undecided.append(row)
        else:
            for name in GATED:
                tests += _tests(row, name, seeds)
                checks += _missing(row, name, seeds)
    adjusted = corrected([replace(test, p=min(1.0, looks * test.p)) for _, _, test, _, _ in tests])
    for (row, name, _, old, new), test in zip(tests, adjusted, strict=True):
        checks.append(_quality_check(row, name, test, old, new))
        if test.verdict == "unclear" and row not in undecided:
            undecided.append(row)
    return Quality(checks=tuple(checks), undecided=tuple(undecided))


def _common(before: Sequence[Entry], after: Sequence[Entry]) -> list[tuple[CellResult, CellResult]]:
    """Results of the seeds that both have."""
    by_seed = {entry.result.config.seed: entry.result for entry in before}
    found = [(by_seed.get(entry.result.config.seed), entry.result) for entry in after]
    return [(old, new) for old, new in found if old is not None]


def _drawn(result: CellResult) -> list[str]:
    return [view.prediction for view in result.views]


def _tests(
    row: str, name: tuple[str, str, str], seeds: Sequence[tuple[CellResult, CellResult]]
) -> list[tuple[str, tuple[str, str, str], Comparison, float, float]]:
    """The comparison of one score, if both have it."""
    values = [(old.value(*name), new.value(*name)) for old, new in seeds]
    known = [(old, new) for old, new in values if old is not None and new is not None]
    if len(known) < 2 or len(known) < len(values):
        return []
    metric = METRICS[name[2]]
    before, after = ({str(seed): [pair[side]] for seed, pair in enumerate(known)} for side in (0, 1))
    test = compare_samples(after, before, margin=metric.abs_tol, higher_is_better=metric.direction == "up")
    assert test is not None
    old, new = (sum(pair[side] for pair in known) / len(known) for side in (0, 1))
    return [(row, name, test, old, new)]


def _missing(row: str, name: tuple[str, str, str], seeds: Sequence[tuple[CellResult, CellResult]]) -> list[Check]:
    """A score that was measured and is not any more; LPIPS where its weights are absent is not judged."""
    if all(new.value(*name) is not None for old, new in seeds if old.value(*name) is not None):
        return []
    absent = name[2] == "lpips"
    detail = "n/a: no weights for LPIPS here" if absent else "not measured"
    verdict: Verdict = "not judged" if absent else "worse"
    return [Check(row=row, layer="quality", name="/".join(name), verdict=verdict, detail=detail)]


def _quality_check(row: str, name: tuple[str, str, str], test: Comparison, old: float, new: float) -> Check:
    unit = METRICS[name[2]].unit
    seen = max(test.margin, test.detectable)
    detail = (
        f"{old:.4g} -> {new:.4g}{unit and ' ' + unit} ({test.mean:+.4g} [{test.low:+.4g}, {test.high:+.4g}], "
        f"p {test.p:.2g}, {test.verdict}; a change of {seen:.2g} would have been seen)"
    )
    return Check(row=row, layer="quality", name="/".join(name), verdict=OF_VERDICT[test.verdict], detail=detail)


def count_checks(row: str, before: CellResult, after: CellResult) -> list[Check]:
    """Work that is counted, not timed: any change is told, a rise fails."""
    checks = []
    for name in EXACT_COUNTS:
        old, new = before.value("memory", "", name), after.value("memory", "", name)
        if old is None or new is None:
            continue
        verdict: Verdict = "unchanged" if new == old else "worse" if new > old else "not worse"
        checks.append(Check(row=row, layer="cost", name=name, verdict=verdict, detail=f"{old:g} -> {new:g}"))
    return checks


def memory_check(row: str, before: Sequence[Entry], after: Sequence[Entry]) -> Check:
    """Peak memory of training and drawing, the largest of all seeds."""
    old, new = (max((e.result.value("memory", "", "peak_rss_mb") or 0.0) for e in each) for each in (before, after))
    verdict: Verdict = "worse" if new > MORE_MEMORY * old else "unchanged"
    detail = f"{old:.0f} -> {new:.0f} MB (a rise from {MORE_MEMORY - 1:.0%} on fails)"
    return Check(row=row, layer="cost", name="peak memory", verdict=verdict, detail=detail)


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
        told = f"a rise from {fails - 1:.0%} on fails"
        if verdict == "not judged":
            told = f"stored times cannot decide a rise below {fails - 1:.0%}"
            told += "" if name == "training" else "; --against REV does"
        detail = f"{before[name]:.4g} -> {after[name]:.4g} times the reference workload ({rise - 1:+.0%}; {told})"
        checks.append(Check(row=row, layer="cost", name=f"time of {name}", verdict=verdict, detail=detail))
    return checks
