"""How far the gate can be trusted: its false alarms on unchanged code, and which planted defects it catches.

Baseline: seeds 0 to 2 of ASH on the suite `ci`. A re-run of unchanged code is three other seeds; a defect is
`benchmarks.gate.defects` with seeds 3 to 5 under ASH's name.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ash.files import InputError, write_atomic, write_json
from benchmarks.analysis.statistics import wilson
from benchmarks.cell.cells import Cell, CellResult, result_of
from benchmarks.gate.defects import DEFECTS
from benchmarks.gate.gate import FINE, Baseline, Check, judge, summarise
from benchmarks.suites.captures import make_capture, require_intact
from benchmarks.suites.files import find_suite
from benchmarks.suites.runs import RunOptions, cell_for, run_missing
from benchmarks.suites.suites import CellSpec

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
    """Train what is missing, one cell at a time as the gate does, judge, and write `rates.md` and `rates.json`.

    Raises:
        InputError: a cell failed, so that the gate had nothing to judge: that is no defect caught.
        KeyboardInterrupt: trainings were interrupted; the next call goes on with them.
    """
    suite = find_suite("ci")
    spec = suite.captures[0]
    folder = make_capture(spec, data, workers=workers)
    require_intact(folder)

    def cells_of(method: str, seeds: range) -> list[Cell]:
        return [
            cell_for(CellSpec(capture=spec, method=method, preset=suite.preset, seed=seed), folder, out)
            for seed in seeds
        ]

    base, other = range(SEEDS), range(SEEDS, 2 * SEEDS)
    unchanged = [range(SEEDS * (i + 1), SEEDS * (i + 2)) for i in range(reruns)]
    wanted = [cells_of(SOUND, range(SEEDS * (reruns + 1)))]
    wanted += [cells_of(method, base) for method in SOUND_FOR.values()]
    wanted += [cells_of(_target(defect.__name__), other) for defect in DEFECTS]
    cells = [cell for group in wanted for cell in group]
    run_missing(cells, suite, RunOptions(out=out, data=data, workers=workers, cells=1))
    for cell in cells:
        result = result_of(cell)
        if result is None:
            raise KeyboardInterrupt("some trainings were interrupted")
        if result.status != "done":
            raise InputError(
                f"{cell.config.method}, seed {cell.config.seed}: expected a result to judge, got {result.reason}"
            )

    def baseline(method: str, seeds: range) -> Baseline:
        return summarise("ci", [_as(SOUND, cell) for cell in cells_of(method, seeds)])

    found = Trust(
        unchanged=tuple(
            _trial(f"seeds {seeds.start} to {seeds.stop - 1}", "", baseline(SOUND, base), baseline(SOUND, seeds))
            for seeds in unchanged
        ),
        defects=tuple(
            _trial(
                defect.__name__.replace("_", " "),
                (defect.__doc__ or "").strip(),
                baseline(SOUND_FOR.get(defect.__name__, SOUND), base),
                baseline(_target(defect.__name__), other),
            )
            for defect in DEFECTS
        ),
    )
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


def _trial(name: str, about: str, before: Baseline, after: Baseline) -> GateTrial:
    flagged = tuple(check for check in judge(before, after) if check.verdict not in FINE)
    return GateTrial(name=name, about=about, flagged=flagged)


def _target(defect: str) -> str:
    return f"benchmarks.gate.defects:{defect}"


def _as(method: str, cell: Cell) -> CellResult:
    result = result_of(cell)
    assert result is not None, cell.folder
    return replace(result, config=replace(result.config, method=method))
