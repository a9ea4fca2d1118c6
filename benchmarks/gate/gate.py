"""The verdict on a change: a run against a committed baseline, with known error rates.

Three levels. Identical predictions prove that nothing changed. Otherwise qualities are compared over seeds as in every
report (`statistics.compare_samples`, corrected over all comparisons): worse fails, and better is flagged as well, for a
leak looks like progress. Costs: exact work counts, and, on a processor like the baseline's, peak memory and the times
of frames and training. Times are ratios to a reference workload that is timed between the frames, so that the load of
the machine cancels. Noise only adds to a time, so that a time that fails is measured again. A training that became much
shorter is flagged as well. On another processor memory and times are not judged.
"""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Literal

from ash.capture.typed import from_json
from ash.files import InputError, read_json, write_json
from benchmarks.analysis.statistics import Comparison, compare_samples, corrected
from benchmarks.cell.metrics import METRICS, PROTOCOL
from benchmarks.cell.schema import CellResult
from benchmarks.report import escaping

Verdict = Literal["pass", "fail", "unexplained improvement", "not judged"]
Kind = Literal["presence", "quality", "time", "memory", "work"]
FINE = ("pass", "not judged")
Row = tuple[str, str]  # scene and method

GATED = (  # (split, region, metric): few, so that Holm's correction leaves power
    ("train_view", "foreground", "psnr"),  # varies least between seeds
    ("novel_view", "foreground", "psnr"),
    ("novel_pose", "foreground", "psnr"),
    ("near_pose", "foreground", "psnr"),
    ("far_pose", "foreground", "psnr"),
    ("novel_view", "foreground", "flip"),
    ("novel_view", "full", "lpips"),  # where the backbone's weights are
    ("novel_pose", "full", "lpips"),
    ("novel_view", "full", "iou"),
    ("novel_pose", "", "template_mm"),
)
EXACT_COUNTS = ("params", "gaussians")
OF_VERDICT: dict[str, Verdict] = {
    "worse": "fail",
    "better": "unexplained improvement",
    "equivalent": "pass",
    "unclear": "pass",
}
SLOWER = 1.12  # ratio of minima over a baseline's thirteen cells and a run's three to thirteen
TIMED_AGAIN = 10  # cells for times alone: always for a baseline, for a run one by one while a time fails
OTHER_TRAINING = 1.25  # ratio of training times, either way
STAGE_FLOOR = 0.1  # stages below this share of the reference workload are noise
MORE_MEMORY = 1.10
NOT_IN_BASELINE = "the baseline has no results of this row; --update-baseline adds it"
SINGLE_SEED_FACTOR = 5.0  # one seed has no spread: only losses of several margins fail


@dataclass(frozen=True, kw_only=True, slots=True)
class BaselineEntry:
    """One method on one scene; lists run over seeds."""

    scene: str
    method: str
    truth: str  # hash of what its capture shows; equal on machines whose renders differ by rounding
    seeds: tuple[int, ...]
    predictions: tuple[str, ...]  # one digest per seed over all predicted images
    qualities: dict[str, tuple[float, ...]]
    counts: dict[str, float]
    memory_mb: float
    times: dict[str, float]  # frame, stages, training: least over that of the reference workload
    failed: int

    @property
    def title(self) -> str:
        """For checks."""
        return f"{self.scene} · {self.method}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Baseline:
    """What a run is compared with."""

    suite: str
    commit: str
    machine: str
    entries: tuple[BaselineEntry, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """One comparison and its outcome."""

    what: str
    verdict: Verdict
    detail: str
    kind: Kind = "presence"
    name: str = ""  # the quality, stage or count; empty where the whole of a method is meant
    scene: str = ""
    method: str = ""


def summarise(suite: str, results: Sequence[CellResult], timed: Sequence[CellResult] = ()) -> Baseline:
    """The numbers of a run that the gate compares; `timed`: more cells of its methods, for times alone."""
    provenances = [result.provenance for result in results if result.provenance is not None]
    pairs = dict.fromkeys((result.config.place, result.config.method) for result in results)
    entries = [_entry(_of(pair, results), _of(pair, timed)) for pair in pairs]
    commit = provenances[0].commit if provenances else "unknown"
    machine = provenances[0].machine.get("processor", "unknown") if provenances else "unknown"
    return Baseline(suite=suite, commit=commit, machine=machine, entries=tuple(entries))


def write_baseline(path: Path, baseline: Baseline) -> None:
    """Write a baseline: the only place where one is ever changed."""
    write_json(path, {"protocol": PROTOCOL, **asdict(baseline)})


def read_baseline(path: Path) -> Baseline:
    """Read a baseline.

    Raises:
        InputError: damaged, or of another protocol version.
    """
    content = read_json(path)
    if isinstance(content, dict) and content.get("protocol", PROTOCOL) != PROTOCOL:
        raise InputError(f"{path}: expected protocol {PROTOCOL}, got {content['protocol']!r}; make a new baseline")
    try:
        baseline: Baseline = from_json(Baseline, {name: value for name, value in content.items() if name != "protocol"})
        return baseline
    except (AttributeError, ValueError) as error:
        raise InputError(f"{path}: expected a baseline of the gate ({error})") from error


def replacement(path: Path, head: Baseline) -> Baseline:
    """The run, if it may replace the baseline at `path`, which need not exist.

    Raises:
        InputError: a cell of the run failed, or the run lacks a row that the baseline has.
    """
    if failed := [entry.title for entry in head.entries if entry.failed]:
        raise InputError(f"a baseline needs cells that are done, and cells of {', '.join(failed)} failed")
    rows = {entry.title for entry in head.entries}
    before = read_baseline(path).entries if path.exists() else ()
    if dropped := [entry.title for entry in before if entry.title not in rows]:
        raise InputError(
            f"{path} holds {', '.join(dropped)}, which this run lacks; to drop them, remove that file first"
        )
    return head


def judge(baseline: Baseline, head: Baseline) -> list[Check]:
    """Every comparison of a run with the baseline.

    Raises:
        InputError: they are of different suites, or have no row in common that has results.
    """
    if baseline.suite != head.suite:
        raise InputError(f"expected a run of suite {baseline.suite}, as the baseline is, got {head.suite}")
    by_row = {(entry.scene, entry.method): entry for entry in head.entries}
    judged = {(entry.scene, entry.method) for entry in baseline.entries if entry.seeds}
    checks = [
        _check(entry, "present", "not judged", NOT_IN_BASELINE)
        for entry in head.entries
        if (entry.scene, entry.method) not in judged
    ]
    if not judged & by_row.keys():
        held = ", ".join(entry.title for entry in baseline.entries if entry.seeds) or "no finished cell"
        ran = ", ".join(entry.title for entry in head.entries) or "no finished cell"
        raise InputError(f"nothing was compared: the baseline has {held}; the run has {ran}")
    compared: list[tuple[BaselineEntry, BaselineEntry]] = []
    for base in baseline.entries:
        now = by_row.get((base.scene, base.method))
        if (base.scene, base.method) not in judged:
            continue
        if now is None:
            checks.append(_check(base, "present", "fail", "the baseline has this row and the run lacks it"))
        elif now.failed > base.failed or not now.seeds:
            checks.append(_check(base, "came through", "fail", f"{now.failed} seeds failed"))
        else:
            compared.append((base, now))
    checks += _quality_checks(compared)
    here = baseline.machine == head.machine
    for base, now in compared:
        checks += _count_checks(base, now)
        checks += [_memory_check(base, now), *_time_checks(base, now)] if here else [_elsewhere(base, baseline, head)]
    return checks


def judge_with_retries(
    baseline: Baseline,
    suite: str,
    results: Sequence[CellResult],
    remeasured: Callable[[Collection[Row], int], Sequence[CellResult]],
) -> tuple[Baseline, list[Check]]:
    """The numbers of a run and the checks, after times that fail were measured up to `TIMED_AGAIN` times more.

    `remeasured`: results of another cell for each of some rows; its second argument counts the calls.
    """
    timed: list[CellResult] = []
    slow: set[Row] = set()
    for attempt in range(TIMED_AGAIN + 1):
        timed += remeasured(slow, attempt - 1) if attempt else ()
        head = summarise(suite, results, timed)
        checks = judge(baseline, head)
        slow = {(check.scene, check.method) for check in checks if (check.kind, check.verdict) == ("time", "fail")}
        if not slow:
            break
    return head, checks


def markdown(baseline: Baseline, head: Baseline, checks: Sequence[Check]) -> str:
    """A summary for a pull request: the verdict, what failed, and all checks folded away."""
    bad = [check for check in checks if check.verdict not in FINE]
    title = "passed" if not bad else f"**{len(bad)} of {len(checks)} checks did not pass**"
    lines = [f"## ash-bench gate: {title}", ""]
    texts = (head.suite, head.commit, baseline.commit, head.machine)
    suite, commit, before, machine = map(escaping.markdown, texts)
    lines.append(f"Suite {suite}, commit {commit} against baseline {before}, on {machine}.")
    if bad:
        lines += ["", *_rows(bad)]
    return "\n".join([*lines, "", "<details><summary>All checks</summary>", "", *_rows(checks), "", "</details>", ""])


def junit(checks: Sequence[Check]) -> str:
    """The checks as a JUnit file."""
    bad = sum(check.verdict not in FINE for check in checks)
    skipped = sum(check.verdict == "not judged" for check in checks)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    numbers = f'tests="{len(checks)}" failures="{bad}" errors="0" skipped="{skipped}"'
    lines.append(f'<testsuite name="ash-bench gate" {numbers}>')
    for check in checks:
        group, _, name = check.what.partition(": ")
        head = f'  <testcase classname="{escaping.xml(group)}" name="{escaping.xml(name)}"'
        detail, verdict = escaping.xml(check.detail), escaping.xml(check.verdict)
        if check.verdict == "pass":
            lines.append(f"{head}/>")
        elif check.verdict == "not judged":
            lines.append(f'{head}><skipped message="{detail}"/></testcase>')
        else:
            lines.append(f'{head}><failure message="{verdict}">{detail}</failure></testcase>')
    return "\n".join([*lines, "</testsuite>", ""])


def _of(row: Row, results: Sequence[CellResult]) -> list[CellResult]:
    return [result for result in results if (result.config.place, result.config.method) == row]


def _entry(results: Sequence[CellResult], timed: Sequence[CellResult]) -> BaselineEntry:
    done = [result for result in sorted(results, key=lambda r: r.config.seed) if result.status == "done"]
    config = results[0].config
    return BaselineEntry(
        scene=config.place,
        method=config.method,
        truth=config.truth or config.capture,
        seeds=tuple(result.config.seed for result in done),
        predictions=tuple(_digest(result) for result in done),
        qualities={"/".join(name): _values(done, name) for name in GATED if _values(done, name)},
        counts={m: values[0] for m in EXACT_COUNTS if (values := _values(done, ("memory", "", m)))},
        memory_mb=max(_values(done, ("memory", "", "peak_rss_mb")), default=0.0),
        times=_times([*done, *(result for result in timed if result.status == "done")]),
        failed=len(results) - len(done),
    )


def _values(results: Iterable[CellResult], name: tuple[str, str, str]) -> tuple[float, ...]:
    return tuple(value for result in results if (value := result.value(*name)) is not None)


def _digest(result: CellResult) -> str:
    return sha256("".join(view.prediction for view in result.views).encode()).hexdigest()


def _times(results: Sequence[CellResult]) -> dict[str, float]:
    """Least time over the least of the reference workload, both over all seeds, for noise only ever adds."""
    timings = [(result, result.timing) for result in results if result.timing is not None]
    least: dict[str, float] = {}
    for result, timing in timings:
        measured = {"frame": timing.frame_ms, **timing.stage_ms}
        if (train_s := result.value("speed", "", "train_s")) is not None:
            measured["training"] = (1e3 * train_s,)
        least |= {name: min(least.get(name, math.inf), *values) for name, values in measured.items()}
    reference = min((min(timing.reference_ms) for _, timing in timings), default=math.nan)
    return {name: value / reference for name, value in least.items()}


def _quality_checks(compared: Sequence[tuple[BaselineEntry, BaselineEntry]]) -> list[Check]:
    checks: list[Check] = []
    tests: list[tuple[BaselineEntry, str, Comparison, Sequence[float], Sequence[float]]] = []
    for base, now in compared:
        if base.truth != now.truth:
            detail = "the ground truth changed, so qualities cannot be compared; update the baseline"
            checks.append(_check(base, "capture", "fail", detail))
        elif base.predictions == now.predictions:
            checks.append(_check(base, "quality", "pass", "identical predictions", kind="quality"))
        else:
            for name, before in base.qualities.items():
                after = now.qualities.get(name, ())
                if len(before) > 1 and len(after) > 1:
                    metric = METRICS[name.split("/")[-1]]
                    test = compare_samples(
                        {"": after}, {"": before}, margin=metric.abs_tol, higher_is_better=metric.direction == "up"
                    )
                    tests += [(base, name, test, before, after)] if test else []
                else:
                    checks.append(_single(base, name, before, after))
    corrected_tests = corrected([test for _, _, test, _, _ in tests])
    return checks + [
        _quality_check(base, name, test, before, after)
        for (base, name, _, before, after), test in zip(tests, corrected_tests, strict=True)
    ]


def _check(
    entry: BaselineEntry, what: str, verdict: Verdict, detail: str, *, kind: Kind = "presence", name: str = ""
) -> Check:
    """A check of one method on one scene."""
    return Check(
        what=f"{entry.title}: {what}",
        verdict=verdict,
        detail=detail,
        kind=kind,
        name=name,
        scene=entry.scene,
        method=entry.method,
    )


def _means(name: str, before: Sequence[float], after: Sequence[float]) -> str:
    """Means over seeds, before and after, with their unit."""
    unit = METRICS[name.split("/")[-1]].unit
    return f"{sum(before) / len(before):.4g} -> {sum(after) / len(after):.4g}{unit and ' ' + unit}"


def _quality_check(
    entry: BaselineEntry, name: str, test: Comparison, before: Sequence[float], after: Sequence[float]
) -> Check:
    detail = (
        f"{_means(name, before, after)} ({test.mean:+.4g} [{test.low:+.4g}, {test.high:+.4g}], p {test.p:.2g}, "
        f"{test.verdict}; detectable from {max(test.margin, test.detectable):.2g} on)"
    )
    return _check(entry, name, OF_VERDICT[test.verdict], detail, kind="quality", name=name)


def _single(entry: BaselineEntry, name: str, before: Sequence[float], after: Sequence[float]) -> Check:
    if not after and name.endswith("/lpips"):
        return _check(entry, name, "not judged", "n/a: no weights for LPIPS here", kind="quality", name=name)
    if not after or not before:
        return _check(entry, name, "fail", "not measured", kind="quality", name=name)
    margin = METRICS[name.split("/")[-1]].abs_tol * SINGLE_SEED_FACTOR
    change = sum(after) / len(after) - sum(before) / len(before)
    detail = f"{_means(name, before, after)} ({change:+.4g}; with one seed detectable from {margin:g} on)"
    verdict: Verdict = _direction(name, change) if abs(change) > margin else "pass"
    return _check(entry, name, verdict, detail, kind="quality", name=name)


def _direction(name: str, change: float) -> Verdict:
    higher_is_better = METRICS[name.split("/")[-1]].direction == "up"
    return "unexplained improvement" if (change > 0) == higher_is_better else "fail"


def _count_checks(base: BaselineEntry, now: BaselineEntry) -> list[Check]:
    checks = []
    for name, before in base.counts.items():
        after = now.counts.get(name)
        verdict: Verdict = "pass" if after == before else "fail"
        now_text = "not measured" if after is None else f"{after:g}"
        detail = f"{before:g} -> {now_text} (any change fails)"
        checks.append(_check(base, name, verdict, detail, kind="work", name=name))
    return checks


def _memory_check(base: BaselineEntry, now: BaselineEntry) -> Check:
    more = now.memory_mb > MORE_MEMORY * base.memory_mb
    detail = f"{base.memory_mb:.0f} -> {now.memory_mb:.0f} MB (a rise from {MORE_MEMORY - 1:.0%} on fails)"
    return _check(base, "peak memory", "fail" if more else "pass", detail, kind="memory")


def _time_checks(base: BaselineEntry, now: BaselineEntry) -> list[Check]:
    checks = []
    for name, before in base.times.items():
        after = now.times.get(name)
        if after is None or max(before, after) < STAGE_FLOOR:
            continue
        slower = OTHER_TRAINING if name == "training" else SLOWER
        detail = (
            f"{before:.4g} -> {after:.4g} times the reference workload ({after / before - 1:+.0%}; "
            f"a rise from {slower - 1:.0%} on fails)"
        )
        verdict: Verdict = "fail" if after > slower * before else "pass"
        if name == "training" and after * OTHER_TRAINING < before:
            verdict = "unexplained improvement"
        checks.append(_check(base, f"time of {name}", verdict, detail, kind="time", name=name))
    return checks


def _elsewhere(base: BaselineEntry, baseline: Baseline, head: Baseline) -> Check:
    detail = f"the baseline was made on {baseline.machine}, this run on {head.machine}"
    return _check(base, "memory and times", "not judged", detail, kind="time")


def _rows(checks: Sequence[Check]) -> list[str]:
    texts = [(check.what, check.verdict, check.detail) for check in checks]
    rows = ["| {} | {} | {} |".format(*map(escaping.markdown, row)) for row in texts]
    return ["| check | verdict | detail |", "|---|---|---|", *rows]
