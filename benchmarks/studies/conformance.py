"""`ash-bench check-method`: does a method keep the rules of `docs/plugin.md`? It is trained a few times, never scored.

Four trials, each in a process of its own with limits: a seed, the same seed again, another seed, and the first one's
weights loaded afresh.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError, write_json
from benchmarks.cell.registry import ORACLES, find_method
from benchmarks.cell.sandbox import (
    BASE,
    ISOLATION,
    SANDBOX_UNAVAILABLE,
    TEST_VIEWS,
    WORK,
    SandboxSpec,
    copy,
    sandbox_for,
    sandboxed,
    seen_by_method,
)
from benchmarks.cell.worker import write_test_views
from benchmarks.studies.conformance_worker import Outcome, Trial, few_views, read_outcome
from benchmarks.suites.engine import Limits, last_line, watched_process


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleCheck:
    """One rule, whether the method keeps it (None: undecided), and what was observed."""

    rule: str
    passed: bool | None
    observed: str
    enforced: bool = True  # False: this system could only watch


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialRun:
    """How a trial's process ended: its outcome, or why there is none."""

    outcome: Outcome | None
    isolated: bool = True
    problem: str = ""  # in one line; of time and memory, see `over`
    over: str = ""  # "time" or "memory", where a limit was exceeded


def check_method(
    name: str, capture: Path, folder: Path, *, preset: str, limits: Limits, workers: int
) -> tuple[RuleCheck, ...]:
    """Run the trials in `folder` and judge them.

    Raises:
        InputError: there is no such method, or the capture is at fault.
    """
    bench = _Bench(name=name, capture=load_capture(capture), preset=preset, limits=limits)
    with ThreadPoolExecutor(workers) as pool:
        first = pool.submit(bench.run, folder / "first", seed=0, thorough=True)
        again, other = (pool.submit(bench.run, folder / key, seed=k) for key, k in (("again", 0), ("other", 1)))
        ran = {"first": first.result(), "again": again.result(), "other": other.result()}
    weights = folder / "first" / WORK / "model.safetensors"
    if weights.exists():
        ran["loaded"] = bench.run(folder / "loaded", seed=0, weights=weights)
    return judge_trials(ran, limits)


def judge_trials(ran: dict[str, TrialRun], limits: Limits) -> tuple[RuleCheck, ...]:
    """The rules, each with what the trials say about it."""
    outcomes = [r.outcome for r in ran.values() if r.outcome is not None]
    crashes = [r.problem for r in ran.values() if r.problem and not r.over]
    first, again, other = (ran[name].outcome for name in ("first", "again", "other"))
    loaded = ran["loaded"].outcome if "loaded" in ran else None
    slowest, largest = max((o.seconds for o in outcomes), default=0.0), max((o.peak_mb for o in outcomes), default=0.0)
    return (
        RuleCheck(rule="comes through", passed=not crashes, observed=crashes[0] if crashes else f"{len(ran)} trials"),
        _first_problem("keeps the protocol", [o.protocol or o.weights for o in outcomes], "every function is there"),
        _first_problem("draws as the protocol says", [o.images for o in outcomes], "float32, finite, premultiplied"),
        _same("same seed, same bits", _pictures(first), _pictures(again)),
        _seeds(first, other),
        _same("weights that are loaded draw the same", _pictures(first), _pictures(loaded)),
        _same("training again in its folder ends the same", _pictures(first), first.again if first else None),
        _first_problem(
            "refuses bad poses", [first.bad_poses] if first else [], "NaN, wrong shape, frame beyond the end"
        ),
        _held_out(outcomes, isolated=all(r.isolated for r in ran.values())),
        _first_problem("leaves its input as it was", [o.input for o in outcomes], "arrays and files are as before"),
        _limit("keeps to its time", ran, "time", f"{slowest:.0f} s of {limits.seconds:.0f} s"),
        _limit("keeps to its memory", ran, "memory", f"{largest:.0f} MB of {limits.memory_mb} MB"),
    )


def table(method: str, checks: tuple[RuleCheck, ...]) -> str:
    """One line per rule."""
    words = {True: "kept", False: "BROKEN", None: "undecided"}
    lines = [f"  {words[check.passed]:7} {check.rule:40} {check.observed}" for check in checks]
    broken = sum(check.passed is False for check in checks)
    undecided = sum(check.passed is None for check in checks)
    verdict = f"{broken} rules broken" if broken else f"{undecided} rules undecided" if undecided else "all rules kept"
    only = [check.rule for check in checks if not check.enforced]
    lines += [f"  not enforced on this system, only watched: {', '.join(only)}"] if only else []
    return "\n".join([f"{method}: {verdict}", *lines])


@dataclass(frozen=True, kw_only=True, slots=True)
class _Bench:
    """What all trials of a check share."""

    name: str
    capture: Capture
    preset: str
    limits: Limits

    def run(self, place: Path, *, seed: int, thorough: bool = False, weights: Path | None = None) -> TrialRun:
        """A trial in `place / WORK`: in a sandbox, or where there is none, watched."""
        place = place.resolve()
        oracle, whole = self.name in ORACLES, self.capture
        for name in (WORK, TEST_VIEWS, BASE):
            (place / name).mkdir(parents=True, exist_ok=True)
        write_test_views(place / TEST_VIEWS, whole)
        if weights is not None:
            copy(weights, place / WORK / "given.safetensors")
        with seen_by_method(whole, place / "input", oracle=oracle) as seen:
            trial = Trial(
                target=find_method(self.name).target,
                oracle=oracle,
                capture=str(whole.folder.resolve()),
                input=str(seen.folder.resolve()),
                test_views=str(place / TEST_VIEWS),
                views=tuple(few_views(whole)),
                preset=self.preset,
                seed=seed,
                weights=str(place / WORK / "given.safetensors") if weights is not None else "",
                thorough=thorough,
            )
            write_json(place / WORK / "trial.json", asdict(trial))
            spec = None
            if not oracle and os.environ.get(ISOLATION) != "off":
                spec = sandbox_for(place, whole, seen, find_method(self.name), None)
            ran, refused = self._attempt(place, trial, spec)
            return self._attempt(place, trial, None)[0] if refused else ran

    def _attempt(self, place: Path, trial: Trial, spec: SandboxSpec | None) -> tuple[TrialRun, bool]:
        """How a trial ended, and whether that was for want of a sandbox."""
        work, log = place / WORK, place / "output.log"
        command = sandboxed(spec, "benchmarks.studies.conformance_worker", str(work))
        ending = watched_process(command, log, self.limits)
        isolated = spec is not None
        if isolated and ending.exit_code == SANDBOX_UNAVAILABLE:
            return TrialRun(outcome=None), True
        if ending.failure is not None:
            over = "time" if ending.failure.status == "timeout" else "memory"
            return TrialRun(outcome=None, isolated=isolated, problem=ending.failure.reason, over=over), False
        outcome = read_outcome(work)
        if outcome is None and ending.exit_code == 2:
            raise InputError(last_line(log))
        if outcome is None:
            return TrialRun(outcome=None, isolated=isolated, problem=f"seed {trial.seed}: {last_line(log)}"), False
        if outcome.peak_mb > self.limits.memory_mb:
            problem = f"{outcome.peak_mb:.0f} MB for a moment"
            return TrialRun(outcome=outcome, isolated=isolated, problem=problem, over="memory"), False
        return TrialRun(outcome=outcome, isolated=isolated), False


def _first_problem(rule: str, problems: list[str], fine: str) -> RuleCheck:
    if not problems:
        return _undecided(rule)
    problem = next((each for each in problems if each), "")
    return RuleCheck(rule=rule, passed=not problem, observed=problem or fine)


def _held_out(outcomes: list[Outcome], *, isolated: bool) -> RuleCheck:
    fine = "they were out of reach" if isolated else "only the training copy was opened, as far as Python tells"
    check = _first_problem("leaves held-out views alone", [o.held_out for o in outcomes], fine)
    return replace(check, enforced=isolated)


def _undecided(rule: str) -> RuleCheck:
    return RuleCheck(rule=rule, passed=None, observed="no trial came so far")


def _pictures(outcome: Outcome | None) -> tuple[str, ...]:
    return outcome.pictures if outcome else ()


def _same(rule: str, ones: tuple[str, ...], others: tuple[str, ...] | None) -> RuleCheck:
    if not ones or not others:
        return _undecided(rule)
    equal = sum(a == b for a, b in zip(ones, others, strict=True))
    return RuleCheck(rule=rule, passed=equal == len(ones), observed=f"{equal} of {len(ones)} images are equal")


def _seeds(one: Outcome | None, other: Outcome | None) -> RuleCheck:
    """Error bars are the spread over seeds: a method that always draws the same would have none, and look certain."""
    rule = "the seed is what is random"
    if one is None or not one.pictures or not _pictures(other):
        return _undecided(rule)
    same = one.pictures == _pictures(other)
    sentences = {
        (True, True): "seedless, as it says",
        (True, False): "says seedless, and seeds differ",
        (False, True): "two seeds draw the same bits; a method without randomness has `seedless = True`",
        (False, False): "another seed draws other bits",
    }
    return RuleCheck(rule=rule, passed=same == one.seedless, observed=sentences[one.seedless, same])


def _limit(rule: str, ran: dict[str, TrialRun], what: str, fine: str) -> RuleCheck:
    over = [r.problem for r in ran.values() if r.over == what]
    return RuleCheck(rule=rule, passed=not over, observed=over[0] if over else fine)
