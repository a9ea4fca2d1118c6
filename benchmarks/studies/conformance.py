"""`ash-bench check-method`: does a method keep the rules of `docs/plugin.md`? It is trained a few times, never scored.

Four trials, each in a process of its own with limits: a seed, the same seed again, another seed, and the first one's
weights loaded afresh.
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ash.files import InputError, write_json
from benchmarks.cell.methods import ORACLES, find_method
from benchmarks.studies.trial import Outcome, Trial, read_outcome
from benchmarks.suites.engine import Limits, last_line, watched_process


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleCheck:
    """One rule, whether the method keeps it (None: it could not be told), and what was seen."""

    rule: str
    kept: bool | None
    seen: str


@dataclass(frozen=True, kw_only=True, slots=True)
class TrialRun:
    """How a trial's process ended: its outcome, or why there is none."""

    outcome: Outcome | None
    problem: str = ""  # in one line; of time and memory, see `over`
    over: str = ""  # "time" or "memory", where a limit was exceeded


def check_method(
    name: str, capture: Path, folder: Path, *, preset: str, limits: Limits, workers: int
) -> tuple[RuleCheck, ...]:
    """Run the trials in `folder` and judge them.

    Raises:
        InputError: there is no such method, or the capture is at fault.
    """
    target = find_method(name).target
    again = Trial(target=target, oracle=name in ORACLES, capture=str(capture.resolve()), preset=preset, seed=0)
    trials = {"first": replace(again, thorough=True), "again": again, "other": replace(again, seed=1)}
    with ThreadPoolExecutor(workers) as pool:
        ran = dict(zip(trials, pool.map(lambda n: _run(trials[n], folder / n, limits), trials), strict=True))
    weights = folder / "first" / "model.safetensors"
    if weights.exists():
        loaded = replace(again, weights=str(weights))
        ran["loaded"] = _run(loaded, folder / "loaded", limits)
    return judge(ran, limits)


def judge(ran: dict[str, TrialRun], limits: Limits) -> tuple[RuleCheck, ...]:
    """The rules, each with what the trials say about it."""
    outcomes = [r.outcome for r in ran.values() if r.outcome is not None]
    crashes = [r.problem for r in ran.values() if r.problem and not r.over]
    first, again, other = (ran[name].outcome for name in ("first", "again", "other"))
    loaded = ran["loaded"].outcome if "loaded" in ran else None
    slowest, largest = max((o.seconds for o in outcomes), default=0.0), max((o.peak_mb for o in outcomes), default=0.0)
    return (
        RuleCheck(rule="comes through", kept=not crashes, seen=crashes[0] if crashes else f"{len(ran)} trials"),
        _first_problem("keeps the protocol", [o.protocol or o.weights for o in outcomes], "every function is there"),
        _first_problem("draws as the protocol says", [o.images for o in outcomes], "float32, finite, premultiplied"),
        _same("same seed, same bits", first, again),
        _seeds(first, other),
        _same("weights that are loaded draw the same", first, loaded),
        _resumes(first),
        _first_problem(
            "refuses bad poses", [first.bad_poses] if first else [], "NaN, wrong shape, frame beyond the end"
        ),
        _first_problem(
            "leaves held-out views alone", [o.held_out for o in outcomes], "only the training copy was opened"
        ),
        _first_problem("leaves its input as it was", [o.input for o in outcomes], "arrays and files are as before"),
        _limit("keeps to its time", ran, "time", f"{slowest:.0f} s of {limits.seconds:.0f} s"),
        _limit("keeps to its memory", ran, "memory", f"{largest:.0f} MB of {limits.memory_mb} MB"),
    )


def table(method: str, checks: tuple[RuleCheck, ...]) -> str:
    """One line per rule."""
    words = {True: "kept", False: "BROKEN", None: "untold"}
    lines = [f"  {words[check.kept]:7} {check.rule:40} {check.seen}" for check in checks]
    broken = sum(check.kept is False for check in checks)
    untold = sum(check.kept is None for check in checks)
    verdict = f"{broken} rules broken" if broken else f"{untold} rules untold" if untold else "all rules kept"
    return "\n".join([f"{method}: {verdict}", *lines])


def _run(trial: Trial, folder: Path, limits: Limits) -> TrialRun:
    write_json(folder / "trial.json", asdict(trial))
    log = folder / "output.log"
    ending = watched_process([sys.executable, "-m", "benchmarks.studies.trial", str(folder)], log, limits)
    if ending.failure is not None:
        return TrialRun(
            outcome=None, problem=ending.failure.reason, over="time" if ending.failure.status == "timeout" else "memory"
        )
    outcome = read_outcome(folder)
    if outcome is None:
        if ending.exit_code == 2:
            raise InputError(last_line(log))
        return TrialRun(outcome=None, problem=f"seed {trial.seed}: {last_line(log)}")
    if outcome.peak_mb > limits.memory_mb:
        return TrialRun(outcome=outcome, problem=f"{outcome.peak_mb:.0f} MB for a moment", over="memory")
    return TrialRun(outcome=outcome)


def _first_problem(rule: str, problems: list[str], fine: str) -> RuleCheck:
    if not problems:
        return RuleCheck(rule=rule, kept=None, seen="no trial came so far")
    found = next((problem for problem in problems if problem), "")
    return RuleCheck(rule=rule, kept=not found, seen=found or fine)


def _same(rule: str, one: Outcome | None, other: Outcome | None) -> RuleCheck:
    if one is None or other is None or not one.pictures or not other.pictures:
        return RuleCheck(rule=rule, kept=None, seen="no trial came so far")
    equal = sum(a == b for a, b in zip(one.pictures, other.pictures, strict=True))
    return RuleCheck(
        rule=rule, kept=equal == len(one.pictures), seen=f"{equal} of {len(one.pictures)} images are equal"
    )


def _seeds(one: Outcome | None, other: Outcome | None) -> RuleCheck:
    """Error bars are the spread over seeds: a method that always draws the same would have none, and look certain."""
    rule = "the seed is what is random"
    if one is None or other is None or not one.pictures or not other.pictures:
        return RuleCheck(rule=rule, kept=None, seen="no trial came so far")
    if one.seedless:
        same = one.pictures == other.pictures
        return RuleCheck(
            rule=rule, kept=same, seen="seedless, as it says" if same else "says seedless, and seeds differ"
        )
    if one.pictures == other.pictures:
        return RuleCheck(
            rule=rule,
            kept=False,
            seen="two seeds draw the same bits; a method without randomness has `seedless = True`",
        )
    return RuleCheck(rule=rule, kept=True, seen="another seed draws other bits")


def _resumes(first: Outcome | None) -> RuleCheck:
    rule = "training again in its folder ends the same"
    if first is None or first.again is None or not first.pictures:
        return RuleCheck(rule=rule, kept=None, seen="no trial came so far")
    equal = sum(a == b for a, b in zip(first.pictures, first.again, strict=True))
    return RuleCheck(
        rule=rule, kept=equal == len(first.pictures), seen=f"{equal} of {len(first.pictures)} images are equal"
    )


def _limit(rule: str, ran: dict[str, TrialRun], what: str, fine: str) -> RuleCheck:
    over = [r.problem for r in ran.values() if r.over == what]
    return RuleCheck(rule=rule, kept=not over, seen=over[0] if over else fine)
