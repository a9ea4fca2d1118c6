"""`ash-bench check-method`: does a method keep the rules of `docs/plugin.md`? It is trained a few times, never scored.

Four trials, each in a process of its own with limits: a seed, the same seed again, another seed, and the first one's
weights loaded afresh.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
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
    SandboxUnavailable,
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
    passed: bool | None = None
    observed: str = "no trial came so far"
    enforced: bool = True  # False: this system could only watch


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialRun:
    """How a trial's process ended: its outcome, or why there is none."""

    outcome: Outcome | None = None
    isolated: bool
    problem: str = ""  # in one line; of time and memory, see `over`
    over: str = ""  # "time" or "memory", where a limit was exceeded


def check_method(
    name: str, capture: Path, folder: Path, *, preset: str, limits: Limits, workers: int
) -> tuple[RuleCheck, ...]:
    """Run the trials in `folder` and judge them.

    Raises:
        InputError: there is no such method, or the capture is at fault.
    """
    run = partial(run_trial, name, load_capture(capture), preset=preset, limits=limits)
    with ThreadPoolExecutor(workers) as pool:
        first = pool.submit(run, folder / "first", seed=0, thorough=True)
        again, other = (pool.submit(run, folder / key, seed=k) for key, k in (("again", 0), ("other", 1)))
        ran = {"first": first.result(), "again": again.result(), "other": other.result()}
    weights = folder / "first" / WORK / "model.safetensors"
    if weights.exists():
        ran["loaded"] = run(folder / "loaded", seed=0, weights=weights)
    return judge_trials(ran, limits)


def judge_trials(ran: dict[str, TrialRun], limits: Limits) -> tuple[RuleCheck, ...]:
    """The rules, each with what the trials say about it."""
    outcomes = [r.outcome for r in ran.values() if r.outcome is not None]
    crashes = [r.problem for r in ran.values() if r.problem and not r.over]
    first, again, other, loaded = (
        ran[name].outcome if name in ran else None for name in ("first", "again", "other", "loaded")
    )
    isolated = all(r.isolated for r in ran.values())
    out_of_reach = "they were out of reach" if isolated else "only the training copy was opened, as far as Python tells"
    held_out = _first_problem("leaves held-out views alone", [o.held_out for o in outcomes], out_of_reach)
    bad_poses = [first.bad_poses] if first else []
    slowest, largest = max((o.seconds for o in outcomes), default=0.0), max((o.peak_mb for o in outcomes), default=0.0)
    return (
        RuleCheck(rule="comes through", passed=not crashes, observed=crashes[0] if crashes else f"{len(ran)} trials"),
        _first_problem("keeps the protocol", [o.protocol or o.weights for o in outcomes], "every function is there"),
        _first_problem("draws as the protocol says", [o.images for o in outcomes], "float32, finite, premultiplied"),
        _same("same seed, same bits", _pictures(first), _pictures(again)),
        _seeds(first, other),
        _same("weights that are loaded draw the same", _pictures(first), _pictures(loaded)),
        _same("training again in its folder ends the same", _pictures(first), first.again if first else None),
        _first_problem("refuses bad poses", bad_poses, "NaN, wrong shape, frame beyond the end"),
        replace(held_out, enforced=isolated),
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


def run_trial(
    name: str,
    whole: Capture,
    place: Path,
    *,
    preset: str,
    limits: Limits,
    seed: int,
    thorough: bool = False,
    weights: Path | None = None,
) -> TrialRun:
    """A trial of a method in `place / WORK`: in a sandbox, or where there is none, watched."""
    place, method, oracle = place.resolve(), find_method(name), name in ORACLES
    for part in (WORK, TEST_VIEWS, BASE):
        (place / part).mkdir(parents=True, exist_ok=True)
    write_test_views(place / TEST_VIEWS, whole)
    if weights is not None:
        copy(weights, place / WORK / "given.safetensors")
    with seen_by_method(whole, place / "input", oracle=oracle) as seen:
        trial = Trial(
            target=method.target,
            oracle=oracle,
            capture=str(whole.folder.resolve()),
            input=str(seen.folder.resolve()),
            test_views=str(place / TEST_VIEWS),
            views=tuple(few_views(whole)),
            preset=preset,
            seed=seed,
            weights=str(place / WORK / "given.safetensors") if weights is not None else "",
            thorough=thorough,
        )
        write_json(place / WORK / "trial.json", asdict(trial))
        if oracle or os.environ.get(ISOLATION) == "off":
            return _ended(place, seed, None, limits)
        try:
            return _ended(place, seed, sandbox_for(place, whole, seen, method, None), limits)
        except SandboxUnavailable:
            return _ended(place, seed, None, limits)


def _ended(place: Path, seed: int, spec: SandboxSpec | None, limits: Limits) -> TrialRun:
    """Run a trial to its end."""
    work, log, isolated = place / WORK, place / "output.log", spec is not None
    ending = watched_process(sandboxed(spec, "benchmarks.studies.conformance_worker", str(work)), log, limits)
    if isolated and ending.exit_code == SANDBOX_UNAVAILABLE:
        raise SandboxUnavailable
    if ending.failure is not None:
        over = "time" if ending.failure.status == "timeout" else "memory"
        return TrialRun(isolated=isolated, problem=ending.failure.reason, over=over)
    outcome = read_outcome(work)
    if outcome is None and ending.exit_code == 2:
        raise InputError(last_line(log))
    if outcome is None:
        return TrialRun(isolated=isolated, problem=f"seed {seed}: {last_line(log)}")
    if outcome.peak_mb > limits.memory_mb:
        problem = f"{outcome.peak_mb:.0f} MB for a moment"
        return TrialRun(outcome=outcome, isolated=isolated, problem=problem, over="memory")
    return TrialRun(outcome=outcome, isolated=isolated)


def _first_problem(rule: str, problems: list[str], fine: str) -> RuleCheck:
    if not problems:
        return RuleCheck(rule=rule)
    problem = next((each for each in problems if each), "")
    return RuleCheck(rule=rule, passed=not problem, observed=problem or fine)


def _pictures(outcome: Outcome | None) -> tuple[str, ...]:
    return outcome.pictures if outcome else ()


def _same(rule: str, ones: tuple[str, ...], others: tuple[str, ...] | None) -> RuleCheck:
    if not ones or not others:
        return RuleCheck(rule=rule)
    equal = sum(a == b for a, b in zip(ones, others, strict=True))
    return RuleCheck(rule=rule, passed=equal == len(ones), observed=f"{equal} of {len(ones)} images are equal")


def _seeds(one: Outcome | None, other: Outcome | None) -> RuleCheck:
    """Error bars are the spread over seeds: a method that always draws the same would have none, and look certain."""
    rule = "the seed is what is random"
    if one is None or not one.pictures or not _pictures(other):
        return RuleCheck(rule=rule)
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
