"""The gate's error rates: false alarms on unchanged code, and which planted defects it reports.

`python -m benchmarks.gate.calibration --help`; it needs a checkout, because the defects lie in tests/helpers.

Baseline: three seeds of `ash_plus` on the suite `ci`. A rerun of unchanged code is three other seeds. A defect is three
seeds of a method of `planted_defects.py` under its name.
"""

import argparse
import importlib
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ash.files import InputError, write_atomic, write_json
from benchmarks.analysis.statistics import wilson
from benchmarks.cell.sandbox import METHOD_PATH, add_method_paths
from benchmarks.cell.schema import CellResult
from benchmarks.gate.gate import FINE, TIMED_AGAIN, Baseline, Check, judge_with_retries, summarise
from benchmarks.gate.remeasure import remeasure
from benchmarks.provenance import cores
from benchmarks.suites.captures import make_capture, require_intact
from benchmarks.suites.files import find_suite
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import RunOptions

SEEDS = 3
SOUND = "ash_plus"
DEFECTS = "helpers.planted_defects"  # below tests/
SOUND_FOR = {"sh_frame": f"{DEFECTS}:sound_sh"}  # the sound method of a defect, where it is not `ash_plus`


@dataclass(frozen=True, kw_only=True, slots=True)
class GateTrial:
    """The gate's verdict on a run that is known to be sound or defective."""

    name: str
    about: str
    flagged: tuple[Check, ...]  # the checks that did not pass


@dataclass(frozen=True, kw_only=True, slots=True)
class GateCalibration:
    """All trials."""

    unchanged: tuple[GateTrial, ...]
    defects: tuple[GateTrial, ...]


def calibrate(*, reruns: int, out: Path, data: Path, workers: int) -> GateCalibration:
    """Train and judge `reruns` unchanged runs and every planted defect; write calibration.md and .json into `out`.

    Raises:
        InputError: a cell failed, so that the gate had nothing to judge.
        KeyboardInterrupt: trainings were interrupted; the next call resumes.
    """
    folders = [os.environ.get(METHOD_PATH, ""), str(Path(__file__).parents[2] / "tests")]
    os.environ[METHOD_PATH] = os.pathsep.join(filter(None, folders))
    add_method_paths()
    suite = find_suite("ci")
    options = RunOptions(out=out, data=data, workers=workers, cells=1)
    for capture in suite.captures:
        require_intact(make_capture(capture, data, workers=workers))

    def run(method: str, seeds: Sequence[int]) -> list[CellResult]:
        """Results of a method, renamed to the sound one."""
        results = remeasure(suite.narrowed(methods=(method,)), options, seeds)
        if len(results) < len(seeds):
            raise KeyboardInterrupt("some trainings were interrupted")
        return [_renamed(result) for result in results]

    def baseline(method: str) -> Baseline:
        own, more = _seeds(0)
        return summarise("ci", run(method, own), run(method, more))

    def trial(name: str, about: str, before: Baseline, method: str, block: int) -> GateTrial:
        own, more = _seeds(block)
        _, checks = judge_with_retries(before, "ci", run(method, own), lambda _, attempt: run(method, [more[attempt]]))
        progress.finish(name)
        return GateTrial(name=name, about=about, flagged=tuple(check for check in checks if check.verdict not in FINE))

    defects = importlib.import_module(DEFECTS).DEFECTS
    expected_s = 60 * suite.cell_minutes * (SEEDS + 1)
    progress = Progress("trials", reruns + len(defects), expected_s=expected_s, workers=1)
    before = {method: baseline(method) for method in (SOUND, *SOUND_FOR.values())}
    unchanged = [trial(f"rerun {block}", "", before[SOUND], SOUND, block) for block in range(1, reruns + 1)]
    planted = []
    for defect in defects:
        name, about = defect.__name__, (defect.__doc__ or "").strip()
        planted.append(trial(name, about, before[SOUND_FOR.get(name, SOUND)], _target(name), 1))
    progress.close()
    result = GateCalibration(unchanged=tuple(unchanged), defects=tuple(planted))
    write_json(out / "calibration.json", asdict(result))
    write_atomic(out / "calibration.md", markdown(result).encode())
    return result


def markdown(calibration: GateCalibration) -> str:
    """Both rates and the table of defects."""
    lines = ["# Calibration of the gate", "", f"Suite ci, ASH, {SEEDS} seeds on either side."]
    lines += [_rate("False alarms", calibration.unchanged), _rate("Planted defects reported", calibration.defects)]
    lines += ["", "| planted defect | reported by | size |", "|---|---|---|"]
    for trial in calibration.defects:
        by = "; ".join(check.what.partition(": ")[2] for check in trial.flagged[:3]) or "**not reported**"
        lines.append(f"| {trial.about} | {by} | {trial.flagged[0].detail if trial.flagged else ''} |")
    for trial in calibration.unchanged:
        lines += [f"\nFalse alarm on {trial.name}: {check.what}, {check.detail}." for check in trial.flagged]
    return "\n".join([*lines, ""])


def _rate(what: str, trials: Sequence[GateTrial]) -> str:
    if not trials:
        return f"{what}: not measured."
    count = sum(bool(trial.flagged) for trial in trials)
    low, high = wilson(count, len(trials))
    return f"{what}: {count} of {len(trials)} (95 % interval {100 * low:.0f} to {100 * high:.0f} %)."


def _seeds(block: int) -> tuple[range, range]:
    """Seeds of one block alone: those of a run, and those whose times alone are measured."""
    first = block * (SEEDS + TIMED_AGAIN)
    return range(first, first + SEEDS), range(first + SEEDS, first + SEEDS + TIMED_AGAIN)


def _target(defect: str) -> str:
    return f"{DEFECTS}:{defect}"


def _renamed(result: CellResult) -> CellResult:
    if result.status != "done":
        name, seed = result.config.method, result.config.seed
        raise InputError(f"{name}, seed {seed}: expected a result to judge, got {result.reason}")
    return replace(result, config=replace(result.config, method=SOUND))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=calibrate.__doc__)
    parser.add_argument("--reruns", type=int, default=20, help="runs of unchanged code")
    parser.add_argument("--out", type=Path, default=Path("runs/gate-calibration"))
    parser.add_argument("--data", type=Path, default=Path("data"), help="where captures are stored")
    parser.add_argument("--workers", type=int, default=cores(), help="cells side by side")
    print(markdown(calibrate(**vars(parser.parse_args()))))
