"""The verdict on a change: a run against a committed baseline, with known error rates.

Three levels. Identical predictions prove that nothing changed. Otherwise qualities are compared by seed means: a loss
fails when it is larger than the metric's margin and is established (Welch's test, corrected by Holm over all
comparisons); an equally established rise is flagged as well, for a leak looks like progress. Costs: exact work counts,
and, on a processor like the baseline's, peak memory and times of frames and training, these as a ratio to a reference
workload that was timed between the frames, because the machine's mood is in both. A training that became much shorter
is flagged as well: it may have left something out. Elsewhere memory and times are not judged.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import escape, quoteattr

from ash.files import InputError, read_json, write_json
from benchmarks.cells import CellResult
from benchmarks.metrics import METRICS, PROTOCOL
from benchmarks.statistics import Difference, holm, welch

Verdict = Literal["pass", "fail", "unexplained improvement", "not judged"]
FINE = ("pass", "not judged")

GATED = (  # (split, region, metric): few, so that the correction for many comparisons leaves power
    ("novel_view", "foreground", "psnr"),
    ("novel_pose", "foreground", "psnr"),
    ("novel_view", "foreground", "flip"),
    ("novel_view", "full", "iou"),
    ("novel_pose", "", "template_mm"),
)
EXACT_COUNTS = ("params", "gaussians")
ALPHA = 0.05
SLOWER = 1.15  # ratio of minima; run to run it varies by 3 % (8 % at worst) on a busy machine
OTHER_TRAINING = 1.25  # ratio of training times, either way; unchanged code gave 0.93 to 1.08 in 20 runs
STAGE_FLOOR = 0.1  # stages below this share of the reference workload are noise
MORE_MEMORY = 1.10
SINGLE_SEED_FACTOR = 5.0  # one seed knows no spread: only losses of several margins are believed


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """What the gate remembers of one method on one scene; lists run over seeds."""

    scene: str
    method: str
    truth: str  # what its capture shows; equal on machines whose renders differ by rounding
    seeds: tuple[int, ...]
    predictions: tuple[str, ...]  # one digest per seed over all predicted images
    qualities: dict[str, tuple[float, ...]]
    counts: dict[str, float]
    memory_mb: float
    times: dict[str, float]  # frame, stages, training: least time over least time of the reference workload
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
    entries: tuple[Entry, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """One comparison and its outcome."""

    what: str
    verdict: Verdict
    detail: str


def summarise(suite: str, results: Sequence[CellResult]) -> Baseline:
    """What the gate needs to know of a run."""
    known = [result.provenance for result in results if result.provenance is not None]
    pairs = dict.fromkeys((result.config.place, result.config.method) for result in results)
    entries = [_entry([r for r in results if (r.config.place, r.config.method) == pair]) for pair in pairs]
    commit = known[0].commit if known else "unknown"
    machine = known[0].machine.get("processor", "unknown") if known else "unknown"
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
    try:
        if content["protocol"] != PROTOCOL:
            raise InputError(f"{path}: expected protocol {PROTOCOL}, got {content['protocol']}; make a new baseline")
        entries = tuple(_entry_from(row) for row in content["entries"])
        return Baseline(
            suite=str(content["suite"]), commit=str(content["commit"]), machine=str(content["machine"]), entries=entries
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected a baseline of the gate ({error})") from error


def judge(baseline: Baseline, head: Baseline) -> list[Check]:
    """Every comparison of a run with the baseline."""
    if baseline.suite != head.suite:
        raise InputError(f"expected a run of suite {baseline.suite}, as the baseline is, got {head.suite}")
    found = {(entry.scene, entry.method): entry for entry in head.entries}
    checks: list[Check] = []
    compared: list[tuple[Entry, Entry]] = []
    for base in baseline.entries:
        now = found.get((base.scene, base.method))
        if now is None:
            checks.append(Check(what=f"{base.title}: present", verdict="fail", detail="no such cell in this run"))
        elif now.failed > base.failed:
            checks.append(
                Check(what=f"{base.title}: came through", verdict="fail", detail=f"{now.failed} seeds failed")
            )
        else:
            compared.append((base, now))
    checks += _quality_checks(compared)
    here = baseline.machine == head.machine
    for base, now in compared:
        checks += _count_checks(base, now)
        checks += [_memory_check(base, now), *_time_checks(base, now)] if here else [_elsewhere(base, baseline, head)]
    return checks


def markdown(baseline: Baseline, head: Baseline, checks: Sequence[Check]) -> str:
    """A summary for a pull request: the verdict, what failed, and all checks folded away."""
    bad = [check for check in checks if check.verdict not in FINE]
    title = "passed" if not bad else f"**{len(bad)} of {len(checks)} checks did not pass**"
    lines = [f"## ash-bench gate: {title}", ""]
    lines.append(f"Suite {head.suite}, commit {head.commit} against baseline {baseline.commit}, on {head.machine}.")
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
        head = f"  <testcase classname={quoteattr(group)} name={quoteattr(name)}"
        if check.verdict == "pass":
            lines.append(f"{head}/>")
        elif check.verdict == "not judged":
            lines.append(f"{head}><skipped message={quoteattr(check.detail)}/></testcase>")
        else:
            reason = f"<failure message={quoteattr(check.verdict)}>{escape(check.detail)}</failure>"
            lines.append(f"{head}>{reason}</testcase>")
    return "\n".join([*lines, "</testsuite>", ""])


def _entry(results: Sequence[CellResult]) -> Entry:
    done = [result for result in sorted(results, key=lambda r: r.config.seed) if result.status == "done"]
    config = results[0].config
    return Entry(
        scene=config.place,
        method=config.method,
        truth=config.truth or config.capture,
        seeds=tuple(result.config.seed for result in done),
        predictions=tuple(_digest(result) for result in done),
        qualities={"/".join(name): _values(done, name) for name in GATED if _values(done, name)},
        counts={m: values[0] for m in EXACT_COUNTS if (values := _values(done, ("memory", "", m)))},
        memory_mb=max(_values(done, ("memory", "", "peak_rss_mb")), default=0.0),
        times=_times(done),
        failed=len(results) - len(done),
    )


def _entry_from(row: dict[str, Any]) -> Entry:
    lists = {name: tuple(row[name]) for name in ("seeds", "predictions")}
    return Entry(**{**row, **lists, "qualities": {name: tuple(v) for name, v in row["qualities"].items()}})


def _values(results: Iterable[CellResult], name: tuple[str, str, str]) -> tuple[float, ...]:
    return tuple(value for result in results if (value := result.value(*name)) is not None)


def _digest(result: CellResult) -> str:
    return sha256("".join(view.prediction for view in result.views).encode()).hexdigest()


def _times(results: Sequence[CellResult]) -> dict[str, float]:
    """Least time over least time of the reference workload; the least over seeds, for noise only ever adds."""
    ratios: dict[str, float] = {}
    for result in results:
        if result.timing is not None:
            reference = min(result.timing.reference_ms)
            measured = {"frame": result.timing.frame_ms, **result.timing.stage_ms}
            if (train_s := result.value("speed", "", "train_s")) is not None:
                measured["training"] = (1e3 * train_s,)
            for name, values in measured.items():
                ratios[name] = min(ratios.get(name, math.inf), min(values) / reference)
    return ratios


def _quality_checks(compared: Sequence[tuple[Entry, Entry]]) -> list[Check]:
    checks: list[Check] = []
    tests: list[tuple[str, str, Difference]] = []
    for base, now in compared:
        if base.truth != now.truth:
            detail = "the ground truth changed, so qualities cannot be compared; update the baseline"
            checks.append(Check(what=f"{base.title}: capture", verdict="fail", detail=detail))
        elif base.predictions == now.predictions:
            checks.append(Check(what=f"{base.title}: quality", verdict="pass", detail="identical predictions"))
        else:
            for name, before in base.qualities.items():
                after, what = now.qualities.get(name, ()), f"{base.title}: {name}"
                if len(before) > 1 and len(after) > 1:
                    tests.append((what, name, welch(after, before)))
                else:
                    checks.append(_single(what, name, before, after))
    adjusted = holm([test.p for _, _, test in tests])
    return checks + [_established(what, name, test, p) for (what, name, test), p in zip(tests, adjusted, strict=True)]


def _established(what: str, name: str, test: Difference, p: float) -> Check:
    margin = METRICS[name.split("/")[-1]].abs_tol
    detail = f"{test.mean:+.4g} [{test.low:+.4g}, {test.high:+.4g}], p {p:.2g}, margin {margin:g}"
    beyond = abs(test.mean) > margin and p < ALPHA
    return Check(what=what, verdict=_direction(name, test.mean) if beyond else "pass", detail=detail)


def _single(what: str, name: str, before: Sequence[float], after: Sequence[float]) -> Check:
    if not after or not before:
        return Check(what=what, verdict="fail", detail="not measured")
    margin = METRICS[name.split("/")[-1]].abs_tol * SINGLE_SEED_FACTOR
    change = sum(after) / len(after) - sum(before) / len(before)
    detail = f"{change:+.4g}, margin {margin:g} (one seed: no interval)"
    return Check(what=what, verdict=_direction(name, change) if abs(change) > margin else "pass", detail=detail)


def _direction(name: str, change: float) -> Verdict:
    higher_is_better = METRICS[name.split("/")[-1]].direction == "up"
    return "unexplained improvement" if (change > 0) == higher_is_better else "fail"


def _count_checks(base: Entry, now: Entry) -> list[Check]:
    checks = []
    for name, before in base.counts.items():
        after = now.counts.get(name)
        verdict: Verdict = "pass" if after == before else "fail"
        checks.append(Check(what=f"{base.title}: {name}", verdict=verdict, detail=f"{before:g} before, {after} now"))
    return checks


def _memory_check(base: Entry, now: Entry) -> Check:
    more = now.memory_mb > MORE_MEMORY * base.memory_mb
    detail = f"{base.memory_mb:.0f} MB before, {now.memory_mb:.0f} MB now"
    return Check(what=f"{base.title}: peak memory", verdict="fail" if more else "pass", detail=detail)


def _time_checks(base: Entry, now: Entry) -> list[Check]:
    checks = []
    for name, before in base.times.items():
        after = now.times.get(name)
        if after is None or max(before, after) < STAGE_FLOOR:
            continue
        detail = f"{after / before:.2f} times the baseline's, each over the reference workload"
        slower = OTHER_TRAINING if name == "training" else SLOWER
        verdict: Verdict = "fail" if after > slower * before else "pass"
        if name == "training" and after * OTHER_TRAINING < before:
            verdict = "unexplained improvement"
        checks.append(Check(what=f"{base.title}: time of {name}", verdict=verdict, detail=detail))
    return checks


def _elsewhere(base: Entry, baseline: Baseline, head: Baseline) -> Check:
    detail = f"the baseline was made on {baseline.machine}, this run on {head.machine}"
    return Check(what=f"{base.title}: memory and times", verdict="not judged", detail=detail)


def _rows(checks: Sequence[Check]) -> list[str]:
    rows = [f"| {check.what} | {check.verdict} | {check.detail} |" for check in checks]
    return ["| check | verdict | detail |", "|---|---|---|", *rows]
