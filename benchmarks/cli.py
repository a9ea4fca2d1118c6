"""The one door: `ash-bench VERB`. Each verb is a small function; what is heavy is imported when a verb needs it."""

import argparse
import contextlib
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from ash.files import InputError
from benchmarks import method_verbs
from benchmarks.capture_verbs import add_verbs
from benchmarks.errors import disk_problem

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130

ABOUT = """\
Judge animatable human avatars (ASH and its competitors) against exactly known ground truth:
render a synthetic human, train every method on it, and report how accurate and how fast each one is."""

EXAMPLES = """\
examples:
  ash-bench run                  the main comparison; ends with runs/quick/report.html
  ash-bench run ci               the same machinery, small, in about a minute
  ash-bench run quick --seeds 3  with error bars
  ash-bench train ash data/mannequin-ci-0 --preset ci
  ash-bench doctor               what this machine has, and what follows from it

exit codes: 0 done, 1 a cell or check failed, 2 wrong input, 130 interrupted (the same command goes on)"""


ON_A_CLUSTER = """\
on a cluster whose machines share a disk, as a Slurm array of 20 jobs, each one core:
  ash-bench synth tight && ash-bench synth loose                once, before the array
  sbatch --array=1-20 --cpus-per-task=1 --wrap 'ash-bench run table --out runs/table --workers 1 \\
      --shard $SLURM_ARRAY_TASK_ID/20'                         all into one folder; each resumes if started again
  ash-bench report runs/table
without a shared disk, give each shard its own --out and put them together with `ash-bench merge`;
on a Dask cluster, ash-bench run table --executor dask://HOST:8786"""


def main(argv: list[str] | None = None) -> int:
    """Run a verb and return the exit code."""
    arguments = _parser().parse_args(argv)
    arguments.command = shlex.join(["ash-bench", *(sys.argv[1:] if argv is None else argv)])
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # As cells run; read when torch and FLIP are loaded, so set it first.
    try:
        with _terminate_as_interrupt():
            verb: Callable[[argparse.Namespace], int] = arguments.verb
            return verb(arguments)
    except InputError as error:
        return _refuse(str(error))
    except BrokenPipeError:  # Whoever read our output has seen enough (`| head`).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        line = disk_problem(error)
        if line is None:
            raise
        return _refuse(line)
    except KeyboardInterrupt:
        print("\nash-bench: interrupted; the same command goes on where it was", file=sys.stderr)
        return INTERRUPTED


def run(arguments: argparse.Namespace) -> int:
    """Captures, cells, report."""
    from benchmarks.experiments import find_suite
    from benchmarks.provenance import cores
    from benchmarks.runs import RunOptions, failures, finished_results, run_suite

    suite = find_suite(arguments.suite, seeds=arguments.seeds)
    _use_lpips(arguments.lpips_weights)
    options = RunOptions(
        out=arguments.out or Path("runs") / suite.name,
        data=arguments.data,
        workers=arguments.workers or cores(),
        executor=arguments.executor,
        shard=arguments.shard,
        retry_failed=arguments.retry_failed,
        command=arguments.command,
    )
    if arguments.dry_run:
        from benchmarks.dry_run import estimate

        print(estimate(suite, options))
        return DONE
    finished = run_suite(suite, options)
    results = finished_results(finished)
    if len(results) < len(finished.cells):
        there = f"{len(results)} of {len(finished.cells)} cells are there"
        if options.shard is None:
            print(f"{there}, the others were interrupted; the same command goes on", file=sys.stderr)
            return INTERRUPTED
        print(f"{there}; the report waits for the other shards")
        return FAILED if failures(results) else DONE
    return _report(finished.folder)


def report(arguments: argparse.Namespace) -> int:
    """Write the report of a run again, and publish it where that is asked for."""
    code = _report(arguments.run)
    if arguments.publish is not None:
        from benchmarks.report import publish

        publish(arguments.run, arguments.publish)
    return code


def gate(arguments: argparse.Namespace) -> int:
    """Compare a run with the baseline, or make a run the new baseline."""
    from ash.files import write_atomic
    from benchmarks import gate as rules
    from benchmarks.runs import read_run, results_of

    path, baseline = arguments.baseline, None
    if not arguments.update_baseline:
        baseline = rules.read_baseline(path)
    if arguments.head is None:
        suite = arguments.suite if baseline is None else baseline.suite
        command = ["run", suite, "--seeds", str(arguments.seeds), "--data", str(arguments.data)]
        if (code := main(command)) not in (DONE, FAILED):
            return code
        arguments.head = Path("runs") / suite
    found = read_run(arguments.head)
    head = rules.summarise(found.suite, results_of(found))
    if baseline is None:
        rules.write_baseline(path, head)
        print(f"{path}: now holds {len(head.entries)} methods at commit {head.commit}")
        return DONE
    checks = rules.judge(baseline, head)
    summary = rules.markdown(baseline, head, checks)
    print(summary)
    if arguments.markdown:
        write_atomic(arguments.markdown, summary.encode())
    if arguments.junit:
        write_atomic(arguments.junit, rules.junit(checks).encode())
    return DONE if all(check.verdict in rules.FINE for check in checks) else FAILED


def gate_rates(arguments: argparse.Namespace) -> int:
    """Measure how far the gate can be trusted."""
    from benchmarks.provenance import cores
    from benchmarks.trust import markdown, measure

    found = measure(arguments.out, arguments.data, reruns=arguments.reruns, workers=arguments.workers or cores())
    print(markdown(found))
    return DONE


def merge(arguments: argparse.Namespace) -> int:
    """Put the cells of shards together and report."""
    from benchmarks.merge import merge_runs

    merge_runs(arguments.shards, arguments.out)
    return _report(arguments.out)


def train(arguments: argparse.Namespace) -> int:
    """One cell by hand."""
    from ash.dataset import load_capture
    from benchmarks.cells import write_config
    from benchmarks.engine import plan_cells
    from benchmarks.experiments import CaptureSpec, CellSpec, find_method
    from benchmarks.run import run_cell
    from benchmarks.runs import cell_for, require_intact

    find_method(arguments.method)
    capture = load_capture(arguments.capture)
    require_intact(arguments.capture)
    spec = CaptureSpec(scene=capture.scene, size="as given", seed=int(capture.manifest["seed"]))
    cell_spec = CellSpec(capture=spec, method=arguments.method, preset=arguments.preset, seed=arguments.seed)
    cell = cell_for(cell_spec, arguments.capture, arguments.out)
    plan_cells([cell], retry_failed=True)
    write_config(cell)
    print(f"training {cell.config.title} in {cell.folder}", file=sys.stderr)
    return _tell(cell.folder, run_cell(cell))


def evaluate(arguments: argparse.Namespace) -> int:
    """Render and score the cells of a run again."""
    from benchmarks.run import evaluate_cell

    return _again(arguments.run, evaluate_cell)


def rescore(arguments: argparse.Namespace) -> int:
    """Recompute every quality of a run from the stored predictions."""
    from benchmarks.run import rescore_cell

    _use_lpips(arguments.lpips_weights)
    return _again(arguments.run, rescore_cell)


def speed(arguments: argparse.Namespace) -> int:
    """Time the kernels or whole frames."""
    if arguments.what == "frame":
        from benchmarks.speed_frame import main as measure_frames

        return measure_frames(arguments.json)
    from benchmarks.speed import main as measure

    return measure(arguments.what, arguments.json)


def doctor(arguments: argparse.Namespace) -> int:
    """Say what this machine has."""
    from benchmarks.doctor import examine, table

    findings = examine(Path())
    print(table(findings))
    return DONE if all(finding.good for finding in findings) else FAILED


def test(arguments: argparse.Namespace) -> int:
    """Every check that CI runs, on the checkout."""
    from benchmarks.provenance import cores

    root = Path(__file__).parent.parent
    if not (root / "tests").is_dir() or not (root / "pyproject.toml").is_file():
        raise InputError(f"{root}: expected a checkout with tests/; an installed package has none")
    module = [sys.executable, "-m"]
    checks = {
        "ruff check": [*module, "ruff", "check", "."],
        "ruff format": [*module, "ruff", "format", "--check", "."],
        "import-linter": [sys.executable, "-c", "from importlinter.cli import lint_imports_command as f; f()"],
        "mypy": [*module, "mypy"],
        "pytest": [*module, "pytest", "-n", str(cores()), "--dist", "loadfile", *arguments.pytest],
    }
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    failed = []
    for name, command in checks.items():
        print(f"--- {name}", flush=True)
        if subprocess.run(command, cwd=root, env=environment, check=False).returncode:
            failed.append(name)
    print(f"--- failed: {', '.join(failed)}" if failed else "--- all checks passed")
    return FAILED if failed else DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ash-bench", description=ABOUT, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    _add_run(verbs)
    add_verbs(partial(_verb, verbs), natural=_natural, positive=_positive)
    verb = _verb(verbs, train, "train", "train and evaluate one method on one capture")
    verb.add_argument("method", metavar="METHOD")
    verb.add_argument("capture", type=Path, metavar="CAPTURE")
    verb.add_argument("--preset", default="cpu", help="budget of the method: ci, cpu, ... (default: %(default)s)")
    verb.add_argument("--seed", type=_natural, default=0)
    verb.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/train"), help="default: %(default)s")
    verb = _verb(verbs, evaluate, "eval", "render and score a run's cells again from their checkpoints")
    verb.add_argument("run", type=Path, metavar="RUN")
    verb = _verb(verbs, rescore, "rescore", "recompute every quality from a run's stored predictions")
    verb.add_argument("run", type=Path, metavar="RUN")
    _add_lpips(verb)
    verb = _verb(verbs, report, "report", "write the report of a run again")
    verb.add_argument("run", type=Path, metavar="RUN")
    verb.add_argument("--publish", type=Path, metavar="DIR", help="copy all of it but the page there, to be committed")
    _add_gate(verbs)
    verb = _verb(verbs, merge, "merge", "put the cells of shards together and report")
    verb.add_argument("shards", type=Path, metavar="RUN", nargs="+")
    verb.add_argument("--out", type=Path, metavar="DIR", required=True)
    method_verbs.add_verbs(partial(_verb, verbs), positive=_positive)
    verb = _verb(verbs, speed, "speed", "time the kernels, or whole frames by stage, beside their definitions")
    verb.add_argument("what", choices=("kernels", "frame"))
    verb.add_argument("--json", type=Path, metavar="FILE", help="write the rows there as well")
    _verb(verbs, doctor, "doctor", "what this machine has, and what follows from it")
    verb = _verb(verbs, test, "test", "run every check that CI runs")
    verb.add_argument("pytest", nargs="*", metavar="ARG", help="passed to pytest (after --)")
    return parser


def _add_run(verbs: Any) -> None:
    verb = _verb(verbs, run, "run", "run a suite: capture, train, evaluate, report")
    verb.formatter_class = argparse.RawDescriptionHelpFormatter
    verb.epilog = ON_A_CLUSTER
    verb.add_argument("suite", nargs="?", default="quick", metavar="SUITE", help="quick (default), ci, ...")
    verb.add_argument("--out", type=Path, metavar="DIR", help="where results go (default: runs/SUITE)")
    verb.add_argument(
        "--data", type=Path, metavar="DIR", default=Path("data"), help="where captures are kept (default: %(default)s)"
    )
    verb.add_argument("--seeds", type=_positive, metavar="N", help="train every method with N seeds")
    verb.add_argument("--workers", type=_positive, metavar="N", help="cells side by side (default: all cores)")
    verb.add_argument("--executor", default="local", help="local (default), or dask://HOST:PORT for a cluster")
    verb.add_argument("--shard", metavar="i/n", help="do only every n-th cell, from the i-th; for job arrays")
    _add_lpips(verb)
    verb.add_argument("--retry-failed", action="store_true", help="run cells again that failed before")
    verb.add_argument("--dry-run", action="store_true", help="print cells, hours and gigabytes, and do nothing")


def _add_lpips(verb: argparse.ArgumentParser) -> None:
    about = "AlexNet's weights of torchvision, for LPIPS (default: torch's cache; without them LPIPS is n/a)"
    verb.add_argument("--lpips-weights", type=Path, metavar="FILE", help=about)


def _use_lpips(weights: Path | None) -> None:
    """Hand the user's weights on to the cells' processes, once they are known to load."""
    if weights is None:
        return
    from benchmarks.lpips import Lpips
    from benchmarks.weights import ENVIRONMENT

    os.environ[ENVIRONMENT] = str(weights.resolve())
    Lpips(weights)


def _add_gate(verbs: Any) -> None:
    verb = _verb(verbs, gate, "gate", "compare a run with a committed baseline; exit code 1 where it is worse")
    verb.add_argument("--baseline", type=Path, metavar="FILE", default=Path("reports/baseline.json"))
    verb.add_argument("--head", type=Path, metavar="RUN", help="the run to judge (default: run the suite now)")
    verb.add_argument("--suite", default="ci", help="suite of a new baseline (default: %(default)s)")
    verb.add_argument("--seeds", type=_positive, default=3, metavar="N", help="seeds of the run (default: %(default)s)")
    verb.add_argument("--data", type=Path, metavar="DIR", default=Path("data"), help="where captures are kept")
    verb.add_argument("--markdown", type=Path, metavar="FILE", help="write the summary there, for a pull request")
    verb.add_argument("--junit", type=Path, metavar="FILE", help="write the checks there as JUnit")
    verb.add_argument("--update-baseline", action="store_true", help="make the run the new baseline")
    verb = _verb(verbs, gate_rates, "gate-rates", "measure the gate's false alarms and the planted defects it catches")
    verb.add_argument("--reruns", type=_natural, default=20, metavar="N", help="unchanged runs (default: %(default)s)")
    verb.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/gate-rates"), help="default: %(default)s")
    verb.add_argument("--data", type=Path, metavar="DIR", default=Path("data"), help="where captures are kept")
    verb.add_argument("--workers", type=_positive, metavar="N", help="default: one per core")


def _verb(verbs: Any, function: Callable[[argparse.Namespace], int], name: str, about: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
    parser.set_defaults(verb=function)
    return parser


def _report(folder: Path) -> int:
    from benchmarks.report import write_report
    from benchmarks.runs import failures, read_run, results_of

    run_read = read_run(folder)
    lines = write_report(run_read)
    print("\n".join(lines))
    failed = failures(results_of(run_read))
    for result in failed:
        print(f"{result.config.title}: {result.status}: {result.reason}", file=sys.stderr)
    return FAILED if failed else DONE


def _again(folder: Path, function: Callable[[Any], Any]) -> int:
    from benchmarks.runs import read_run, results_of

    found = read_run(folder)
    results_of(found)
    worst = DONE
    for cell in found.cells:
        if (cell.folder / "result.json").exists():
            worst = max(worst, _tell(cell.folder, function(cell)))
    return worst


def _tell(folder: Path, result: Any) -> int:
    """Print what came out of one cell in one line."""
    if result.status != "done":
        print(f"{result.config.title}: {result.status}: {result.reason}", file=sys.stderr)
        return FAILED
    parts = []
    for split in ("novel_view", "novel_pose"):
        if (value := result.value(split, "foreground", "psnr")) is not None:
            parts.append(f"{split.replace('_', ' ')} {value:.2f} dB")
    parts.append(f"{result.value('speed', '', 'frame_ms'):.1f} ms per frame")
    print(f"{result.config.title}: {', '.join(parts)} (foreground PSNR) in {folder}")
    return DONE


def _refuse(line: str) -> int:
    print(f"ash-bench: {line}", file=sys.stderr)
    return WRONG_INPUT


@contextlib.contextmanager
def _terminate_as_interrupt() -> Any:
    """Treat a polite request to end (a scheduler's SIGTERM) like Ctrl-C."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def _positive(text: str) -> int:
    return _at_least(text, 1)


def _natural(text: str) -> int:
    return _at_least(text, 0)


def _at_least(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
    if number < least:
        raise argparse.ArgumentTypeError(f"expected at least {least}, got {number}")
    return number


if __name__ == "__main__":
    sys.exit(main())
