"""How far the gate can be trusted: its false alarms on unchanged code, and which planted defects it catches.

Baseline: three seeds of ASH on the suite `ci`. A re-run of unchanged code is three other seeds; a defect is three seeds
of `benchmarks.gate.defects` under ASH's name.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ash.files import InputError, write_atomic, write_json
from benchmarks.analysis.statistics import wilson
from benchmarks.cell.cells import CellResult
from benchmarks.gate.again import run_again
from benchmarks.gate.defects import DEFECTS
from benchmarks.gate.gate import FINE, TIMED_AGAIN, Baseline, Check, settle, summarise
from benchmarks.suites.captures import make_capture, require_intact
from benchmarks.suites.files import find_suite
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import RunOptions

SEEDS = 3
SOUND = "ash"
SOUND_FOR = {"sh_frame": "benchmarks.gate.defects:sound_sh"}  # what a defect is compared with, where that is not ASH


@dataclass(frozen=True, kw_only=True, slots=True)
class GateTrial:
    """A gate's verdict on a run of which it is known whether anything is wrong with it."""

    name: str
    about: str
    flagged: tuple[Check, ...]  # the checks that did not pass

    @property
    def alarm(self) -> bool:
        """Whether the gate would have stopped the change."""
        return bool(self.flagged)


@dataclass(frozen=True, kw_only=True, slots=True)
class Trust:
    """What the gate did."""

    unchanged: tuple[GateTrial, ...]
    defects: tuple[GateTrial, ...]


def measure(out: Path, data: Path, *, reruns: int, workers: int) -> Trust:
    """Train, judge as the gate does, trial by trial, and write `rates.md` and `rates.json` into `out`.

    Raises:
        InputError: a cell failed, so that the gate had nothing to judge: that is no defect caught.
        KeyboardInterrupt: trainings were interrupted; the next call goes on with them.
    """
    suite = find_suite("ci")
    options = RunOptions(out=out, data=data, workers=workers, cells=1)
    for capture in suite.captures:
        require_intact(make_capture(capture, data, workers=workers))

    def run(method: str, seeds: Sequence[int]) -> list[CellResult]:
        """Results of a method under the sound one's name."""
        results = run_again(suite.narrowed(methods=(method,)), options, seeds)
        if len(results) < len(seeds):
            raise KeyboardInterrupt("some trainings were interrupted")
        return [_as(SOUND, result) for result in results]

    def baseline(method: str) -> Baseline:
        own, more = _seeds(0)
        return summarise("ci", run(method, own), run(method, more))

    def trial(name: str, about: str, before: Baseline, method: str, block: int) -> GateTrial:
        own, more = _seeds(block)
        _, checks = settle(before, "ci", run(method, own), lambda _, attempt: run(method, [more[attempt]]))
        progress.finish(name)
        return GateTrial(name=name, about=about, flagged=tuple(check for check in checks if check.verdict not in FINE))

    expected_s = 60 * suite.cell_minutes * (SEEDS + 1)
    progress = Progress("trials", reruns + len(DEFECTS), expected_s=expected_s, workers=1)
    before = {method: baseline(method) for method in (SOUND, *SOUND_FOR.values())}
    unchanged = tuple(
        trial(f"seeds {seeds[0]} to {seeds[-1]}", "", before[SOUND], SOUND, block)
        for block in range(1, reruns + 1)
        for seeds in [_seeds(block)[0]]
    )
    defects = tuple(
        trial(
            defect.__name__.replace("_", " "),
            (defect.__doc__ or "").strip(),
            before[SOUND_FOR.get(defect.__name__, SOUND)],
            _target(defect.__name__),
            1,
        )
        for defect in DEFECTS
    )
    progress.close()
    found = Trust(unchanged=unchanged, defects=defects)
    write_json(out / "rates.json", asdict(found))
    write_atomic(out / "rates.md", markdown(found).encode())
    return found


def markdown(trust: Trust) -> str:
    """The two rates and the table of defects."""
    alarms, caught = (sum(trial.alarm for trial in trials) for trials in (trust.unchanged, trust.defects))
    lines = ["# How far the gate can be trusted", ""]
    lines.append(f"Suite ci, ASH, {SEEDS} seeds on either side. {_rate('False alarms', alarms, len(trust.unchanged))}")
    lines.append(_rate("Planted defects caught", caught, len(trust.defects)))
    lines += ["", "| planted defect | caught by | size |", "|---|---|---|"]
    for trial in trust.defects:
        by = "; ".join(check.what.partition(": ")[2] for check in trial.flagged[:3]) or "**not caught**"
        size = trial.flagged[0].detail if trial.flagged else ""
        lines.append(f"| {trial.about} | {by} | {size} |")
    for trial in trust.unchanged:
        lines += [f"\nFalse alarm on {trial.name}: {check.what}, {check.detail}." for check in trial.flagged]
    return "\n".join([*lines, ""])


def _rate(what: str, count: int, trials: int) -> str:
    if trials == 0:
        return f"{what}: not measured."
    low, high = wilson(count, trials)
    return f"{what}: {count} of {trials} (95 % interval {100 * low:.0f} to {100 * high:.0f} %)."


def _seeds(block: int) -> tuple[range, range]:
    """Seeds that no other block has: those of a run, and those whose times alone are measured."""
    first = block * (SEEDS + TIMED_AGAIN)
    return range(first, first + SEEDS), range(first + SEEDS, first + SEEDS + TIMED_AGAIN)


def _target(defect: str) -> str:
    return f"benchmarks.gate.defects:{defect}"


def _as(method: str, result: CellResult) -> CellResult:
    """A result under another method's name."""
    if result.status != "done":
        name, seed = result.config.method, result.config.seed
        raise InputError(f"{name}, seed {seed}: expected a result to judge, got {result.reason}")
    return replace(result, config=replace(result.config, method=method))
