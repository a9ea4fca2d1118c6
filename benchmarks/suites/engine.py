"""Runs cells side by side, each in a process of its own, and goes on where an earlier run stopped."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import psutil

from ash.capture.manifest import read_manifest
from ash.files import InputError, one_line, read_json, sha256_of
from benchmarks.cell.run import DISK_FULL, KILLED
from benchmarks.cell.sandbox import clean_environment, kill_process_tree
from benchmarks.cell.schema import (
    Cell,
    CellResult,
    Status,
    failed_result,
    read_cell,
    result_of,
    write_config,
    write_result,
)
from benchmarks.suites.gpus import lent_gpu
from benchmarks.suites.progress import Progress

AnyCell = TypeVar("AnyCell")

POLL_S = 0.2
DISK_POLL_S = 2.0  # between two looks at the size of a cell's folder
ATTEMPTS = 2  # at a cell that is killed from outside, or whose result others change
TAIL = 1 << 16  # bytes of a log that are looked at
WRONG_INPUT = 2
GPU = "GPU"  # a resource of Dask's workers
INTERRUPTIONS = (130, -signal.SIGINT, -signal.SIGTERM)  # A scheduler's wish: no result, resumed later.

_children: set[subprocess.Popen[bytes]] = set()
_starting = threading.Lock()  # No child may start between the decision to stop and the end of the children.
_stopping = threading.Event()


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """What one cell may use before it is ended and recorded as failed."""

    seconds: float
    memory_mb: int
    disk_mb: int = 4096  # of the cell's folder


class Failure(NamedTuple):
    """Why a cell was ended."""

    status: Status
    reason: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Ending:
    """How a watched process ended: by itself, for exceeding a limit, or at somebody's wish."""

    exit_code: int
    failure: Failure | None = None
    interrupted: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class CellPlan:
    """Cells of a run: those to do, and those with a result. `reasons` says why a cell must run again."""

    todo: tuple[Cell, ...]
    done: tuple[Cell, ...]
    reasons: tuple[str, ...]


def plan_cells(cells: Sequence[Cell], *, retry_failed: bool = False) -> CellPlan:
    """Split cells into those with a result and those without; damaged ones are set aside and run again."""
    todo: list[Cell] = []
    done: list[Cell] = []
    reasons = []
    for cell in cells:
        result, damage = sound_result(cell)
        reasons += [damage] if damage else []
        if result is not None and retry_failed and result.status != "done":
            shutil.rmtree(cell.folder)
            reasons.append(f"{cell.config.title}: {result.status} before, tried again")
            result = None
        elif result is None and (reason := _why_stale(cell)):
            reasons.append(f"{cell.config.title}: {reason}")
        (todo if result is None else done).append(cell)
    return CellPlan(todo=tuple(todo), done=tuple(done), reasons=tuple(reasons))


def sound_result(cell: Cell) -> tuple[CellResult | None, str]:
    """The result of a cell, if there is one. A damaged one is moved beside it, as KEY.damaged, and a line says so."""
    try:
        return result_of(cell), ""
    except InputError as error:
        _set_aside(cell)
        return None, f"{cell.config.title}: run again, its result is damaged ({error})"


def _set_aside(cell: Cell) -> None:
    """Move a cell's folder out of the way, so that the cell is run from nothing."""
    aside = cell.folder.with_name(f"{cell.folder.name}.damaged")
    shutil.rmtree(aside, ignore_errors=True)
    cell.folder.rename(aside)


@contextlib.contextmanager
def copied_folder(source: Path, target: Path) -> Iterator[Path]:
    """A copy of a cell's folder, to be changed: at the end it takes the place of `target`, or nothing does."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".copy-") as made:
        whole = Path(shutil.copytree(source, Path(made) / target.name))
        yield whole
        shutil.rmtree(target, ignore_errors=True)
        whole.rename(target)


def shard_of(cells: Sequence[AnyCell], shard: str) -> tuple[AnyCell, ...]:
    """Shard `i/n` of the cells: every n-th, so that shards are of about equal work."""
    index, count = read_shard(shard)
    return tuple(cells[index - 1 :: count])


def read_shard(shard: str) -> tuple[int, int]:
    """The numbers of a shard `i/n`, from 1 on.

    Raises:
        InputError: it is none.
    """
    try:
        index, count = (int(part) for part in shard.split("/"))
        if not 1 <= index <= count:
            raise ValueError
    except ValueError:
        raise InputError(f"expected a shard i/n with 1 <= i <= n, got {shard!r}") from None
    return index, count


def run_cells(
    plan: CellPlan, executor: Executor, limits: Limits, progress: Progress, *, gpus: tuple[str, ...] = ()
) -> None:
    """Run the plan's cells. A failed cell leaves a result that says so; the others go on.

    Those that learn on CUDA each see one of `gpus`, as CUDA_VISIBLE_DEVICES names them; where none are given, what the
    environment shows them.

    Raises:
        InputError: a cell found its input wrong, or others changed its result again after it was made again; cells that
            wait are given up, results that are there stay.
        KeyboardInterrupt: the user's; all child processes have ended when it is seen.
    """
    _stopping.clear()  # Not when a run is over: a thread that the interruption kept from its executor may still look.
    futures: dict[Future[str], Cell] = {}
    repeats: Counter[Path] = Counter()
    digests = {cell.folder: (cell, _digest(cell)) for cell in plan.done}

    def submit(cell: Cell) -> Future[str]:
        write_config(cell)
        future = executor.submit(run_in_process, str(cell.folder), limits, gpus)
        futures[future] = cell
        return future

    try:
        pending = {submit(cell) for cell in plan.todo}
        while pending:
            finished, pending = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in finished:
                cell = futures[future]
                progress.finish(cell.config.title, status=future.result())
                digests[cell.folder] = (cell, _digest(cell))
            if finished:
                # A method that nothing isolates can write to the folders of other cells.
                for cell in [cell for cell, digest in digests.values() if _digest(cell) != digest]:
                    repeats[cell.folder] += 1
                    if repeats[cell.folder] == ATTEMPTS:
                        times = f"changed by other cells {ATTEMPTS} times, since nothing isolates methods here"
                        raise InputError(f"{cell.config.title}: its result was {times}; run its row alone")
                    progress.say(f"{cell.config.title}: run again, its result was changed while another cell ran")
                    progress.total += 1
                    del digests[cell.folder]
                    _set_aside(cell)
                    pending.add(submit(cell))
            progress.tick(running=[futures[f].config.title for f in pending if f.running()])
    except BaseException:
        for future in futures:
            future.cancel()
        stop_children()
        executor.shutdown(wait=True, cancel_futures=True)
        raise


def run_in_process(folder: str, limits: Limits, gpus: tuple[str, ...] = ()) -> str:
    """Run one cell in its own process, watched for time and memory. Returns the status of its result.

    Self-contained, so that an executor may carry it to another machine that sees the same folder.
    """
    cell = read_cell(Path(folder))
    for path in cell.folder.rglob(".*.*"):  # What a killed process left half-written.
        path.unlink(missing_ok=True)
    command = [sys.executable, "-P", "-m", "benchmarks.cell.run", str(cell.folder), "--follow-parent"]
    for _ in range(ATTEMPTS):
        with lent_gpu(gpus, cell.config) as environment:
            ending = watched_process(command, cell.folder / "output.log", limits, environment, disk=cell.folder)
        for left in ("input", "test_views", "sandbox"):  # By a method that was ended.
            shutil.rmtree(cell.folder / left, ignore_errors=True)
        if ending.interrupted:
            return "interrupted"
        if not _was_killed(ending):
            break
    return _outcome(cell, ending, limits).status


def watched_process(
    command: Sequence[str],
    log: Path,
    limits: Limits,
    environment: Mapping[str, str] | None = None,
    *,
    disk: Path | None = None,
) -> Ending:
    """Run a command, its output appended to `log`, until it ends or exceeds its time, memory or disk.

    `environment`: variables besides ours. `disk`: the folder that `limits.disk_mb` is about.
    """
    start = time.monotonic()
    with log.open("ab") as output, _starting:
        if _stopping.is_set():
            return Ending(exit_code=INTERRUPTIONS[0], interrupted=True)
        child = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            env={**_environment(), **(environment or {})},
            start_new_session=True,
        )
        _children.add(child)
    try:
        failure = _watch(child, limits, start, disk)
    finally:
        _kill(child)
        _children.discard(child)
    interrupted = _stopping.is_set() or (failure is None and child.returncode in INTERRUPTIONS)
    return Ending(exit_code=child.returncode, failure=failure, interrupted=interrupted)


def stop_children() -> None:
    """End every child process at once; their cells stay unfinished and can be resumed."""
    with _starting:
        _stopping.set()
        for child in list(_children):
            _kill(child)


@contextlib.contextmanager
def make_executor(spec: str, *, workers: int, gpu: bool = False) -> Iterator[Executor]:
    """An executor: `local`, or a Dask scheduler's address such as `dask://host:8786`.

    Locally, threads suffice, for each only waits for the process of its cell. `gpu`: on Dask each job takes one of the
    resource GPU, which workers offer that were started with `--resources GPU=1`.
    """
    require_executor(spec)
    if spec == "local":
        with ThreadPoolExecutor(workers) as executor:
            yield executor
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "the executor dask:// needs the extra dask: pip install 'ash-bench[dask]', or in a checkout"
            " .venv/bin/python -m pip install -c constraints.txt -e '.[dask]'"
        ) from None
    try:
        client = Client("tcp://" + spec.removeprefix("dask://"), timeout="10s", set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise InputError(f"no Dask scheduler answers at {spec} ({error})") from error
    with client:
        yield client.get_executor(retries=2, pure=False, **_gpu_on(client, spec) if gpu else {})


def require_executor(spec: str) -> None:
    """Refuse the name of an executor that there is not.

    Raises:
        InputError: it is neither `local` nor a Dask scheduler's address.
    """
    if spec != "local" and not spec.startswith("dask://"):
        raise InputError(f"unknown executor {spec!r}, expected local or dask://HOST:PORT")


def _gpu_on(client: Any, spec: str) -> dict[str, Any]:
    """What a job asks of a Dask cluster to have a GPU.

    Raises:
        InputError: there are workers, and none of them has one: the job would wait for ever.
    """
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    if workers and not any(worker["resources"].get(GPU) for worker in workers):
        raise InputError(f"{spec}: expected a worker with a GPU; each is one started with --resources {GPU}=1")
    return {"resources": {GPU: 1}}


def _watch(child: subprocess.Popen[bytes], limits: Limits, start: float, disk: Path | None) -> Failure | None:
    process, looked = psutil.Process(child.pid), start
    while True:
        try:
            child.wait(POLL_S)
            return None
        except subprocess.TimeoutExpired:
            pass
        if time.monotonic() - start > limits.seconds:
            return Failure("timeout", f"not finished after the limit of {limits.seconds / 60:.0f} min")
        with contextlib.suppress(psutil.Error):
            family = [process, *process.children(recursive=True)]
            if (used := sum(member.memory_info().rss for member in family) / 2**20) > limits.memory_mb:
                return _too_large(used, limits)
        if disk is None or time.monotonic() - looked < DISK_POLL_S:
            continue
        looked = time.monotonic()
        if (used := _folder_mb(disk)) > limits.disk_mb:
            return Failure("crashed", f"its folder takes {used:.0f} MB, the limit is {limits.disk_mb} MB")


def _folder_mb(folder: Path) -> float:
    """MiB of disk that the files below a folder take; links are not followed."""
    used = 0
    for place, _, names in os.walk(folder):  # Folders and files come and go.
        for name in names:
            with contextlib.suppress(OSError):
                used += Path(place, name).lstat().st_blocks * 512
    return used / 2**20


def _too_large(used_mb: float, limits: Limits) -> Failure:
    return Failure("out of memory", f"{used_mb:.0f} MB, the limit is {limits.memory_mb} MB")


def _outcome(cell: Cell, ending: Ending, limits: Limits) -> CellResult:
    """The result that the child left, or else one that says how it failed."""
    failure = ending.failure
    if failure is None:
        if ending.exit_code == WRONG_INPUT:
            raise InputError(last_line(cell.folder / "output.log"))
        if ending.exit_code == DISK_FULL:
            raise InputError(f"{cell.folder}: the disk is full; with more space the same command goes on")
        result = result_of(cell)
        peak = result.value("memory", "", "peak_rss_mb") if result is not None else None
        if result is not None and (peak is None or peak <= limits.memory_mb):
            return result
        if peak is not None:  # Too short a peak for the watch to see.
            failure = _too_large(peak, limits)
    if failure is None and _was_killed(ending):
        reason = f"killed from outside in each of {ATTEMPTS} attempts; the kernel does that when memory runs out"
        failure = Failure("crashed", f"{reason}; --retry-failed tries again")
    if failure is None:  # No code of the method runs in that process: this is no failure of the method.
        log = cell.folder / "output.log"
        ended = f"the process of {cell.config.title} ended with {_exit_name(ending.exit_code)}"
        raise InputError(f"{ended} before the method had a result: {last_line(log)} (more in {log})")
    splits = read_manifest(cell.capture_folder).splits
    result = failed_result(cell.config, failure.status, failure.reason, splits=splits)
    write_result(cell.folder, result)
    return result


def _was_killed(ending: Ending) -> bool:
    """Whether somebody else killed the cell: not we for a limit, and not the user, who resumes."""
    return ending.failure is None and ending.exit_code in (KILLED, -signal.SIGKILL)


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End a child with all processes that it started, also those that left its group, and those that outlived it."""
    if child.poll() is None:
        kill_process_tree(child)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    if child.stdin is not None:
        child.stdin.close()


def _environment() -> dict[str, str]:
    """One thread per cell: two buy 1.35x alone and cost 6x when cells run side by side."""
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    return {**clean_environment(), **threads, "PYTHONUNBUFFERED": "1"}


def _digest(cell: Cell) -> str:
    """SHA-256 of a cell's result as it lies on disk; empty where there is none."""
    try:
        return sha256_of(cell.folder / "result.json")
    except OSError:
        return ""


def _why_stale(cell: Cell) -> str | None:
    """Which input changed since this method and seed were last run in this folder, if they were."""
    inputs = ("code", "capture", "protocol")
    for path in cell.folder.parent.glob("*/config.json"):
        content = read_json(path)
        old = content.get("config", {}) if isinstance(content, dict) else {}
        if path.parent == cell.folder or not isinstance(old, dict) or not (path.parent / "result.json").exists():
            continue
        # Other versions of this program knew other fields, so one that is absent counts as empty.
        differ = {name for name, value in asdict(cell.config).items() if (old.get(name) or 0) != (value or 0)}
        changed = [name for name in inputs if name in differ]
        if changed and differ <= {*inputs, "truth"}:
            return f"the {' and the '.join(changed)} changed since its last result"
    return None


def last_line(log: Path) -> str:
    """The last line of a log: mostly what went wrong."""
    if not log.exists():
        return "(it printed nothing)"
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - TAIL))
        lines = file.read(TAIL).decode(errors="replace").strip().splitlines()
    return one_line(lines[-1]) if lines else "(it printed nothing)"


def _exit_name(code: int) -> str:
    try:
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"
    except ValueError:
        return f"signal {-code}"
