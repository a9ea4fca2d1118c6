"""One cell, in a process of its own: train, render, score, time; `python -m benchmarks.cell.run FOLDER`.

No code of the method runs in this process: it learns and draws in another (`benchmarks.cell.worker`), and ends before
anything is scored. So these exit codes are the harness's own word: 0 a result was written (also that of a method that
failed), 2 wrong input (on stderr), 75 the disk is full, 130 interrupted, 76 the method's process was killed by somebody
else; the last three without a result.
"""

import argparse
import errno
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import cast

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.capture.manifest import verify_capture
from ash.files import InputError, disk_problem
from ash.protocol import Avatar
from benchmarks import provenance
from benchmarks.cell.evaluation import (
    MethodOutputs,
    draw_all,
    quality_summary,
    score_outputs,
    scored_views,
    time_frames,
)
from benchmarks.cell.predictions import open_predictions, score_predictions
from benchmarks.cell.registry import BROUGHT, ORACLES, code_version, find_method, make_avatar, offered
from benchmarks.cell.sandbox import WORK, add_method_paths, adopt_orphans, seen_by_method, watched
from benchmarks.cell.schema import (
    CHECKPOINT,
    CaptureModifiedError,
    Cell,
    CellConfig,
    CellResult,
    HarnessFailed,
    Killed,
    MethodFailed,
    Provenance,
    Timing,
    TrainingTime,
    failed_result,
    prediction_path,
    read_cell,
    result_of,
    write_result,
)
from benchmarks.cell.worker import MethodClient, open_client, stage_in, stage_out

DISK_FULL, KILLED = 75, 76  # exit codes
FULL = 1 << 20  # bytes; a disk with less free space is full
TEMPLATES = "templates"  # Beside the captures: learned once, shared by methods and runs.


def main(argv: list[str] | None = None) -> int:
    """Run the cell whose folder is given, unless it is finished."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cell.run")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--follow-parent", action="store_true", help="end when standard input ends")
    arguments = parser.parse_args(argv)
    add_method_paths()
    if arguments.follow_parent:  # Its own process, whose children are all the method's.
        os.environ["ASH_BENCH_CELL_PROCESS"] = str(os.getpid())
        adopt_orphans()
        threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        run_cell(read_cell(arguments.folder))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):  # Nothing can be printed: the log lies on that disk.
            return DISK_FULL
        print(disk_problem(error) or _reraise(error), file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(f"interrupted {interruption}", file=sys.stderr)
        return 130
    except HarnessFailed as error:
        print(error, file=sys.stderr)
        return 2
    except Killed:
        print("the method's process was killed from outside", file=sys.stderr)
        return KILLED
    return 0


def run_cell(cell: Cell) -> CellResult:
    """Train and evaluate a cell and write its result; whatever the method does wrong is a result too.

    Raises:
        InputError: the capture or the method's name is at fault, not the method.
        OSError: the cell's folder cannot be written.
        Killed: somebody else killed the method's process.
    """
    finished = result_of(cell)
    if finished is not None:
        return finished
    start = time.perf_counter()
    capture = _capture_of(cell)
    _clear(cell)
    resumed = _has_left(cell)
    try:
        brought = cell.config.source == BROUGHT
        result = _score_brought(cell, capture) if brought else _train_and_evaluate(cell, capture)
    except MethodFailed as error:
        # What an earlier attempt left may be damaged, and a whole training ends the same.
        if resumed and not isinstance(error, CaptureModifiedError):
            print(f"{cell.config.title}: {error.status}: {error}; once more, from nothing", file=sys.stderr)
            shutil.rmtree(cell.folder / WORK)
            return run_cell(cell)
        print(f"{cell.config.title}: {error.status}: {error}", file=sys.stderr)
        result = failed_result(cell.config, error.status, str(error), splits=capture.splits)
    except MemoryError as error:
        reason = str(error) or "the process could not allocate memory"
        result = failed_result(cell.config, "out of memory", reason, splits=capture.splits)
    result = replace(result, provenance=_provenance(time.perf_counter() - start))
    write_result(cell.folder, result)
    return result


def evaluate_cell(cell: Cell, *, device: str | None = None) -> CellResult:
    """Load a cell's checkpoint, render and score again, and write the result anew; training is not repeated.

    It is drawn on `device`, which the result names, or where it learned. The result names the code that drew and
    scored it, where that is not the code that trained it.

    Raises:
        InputError: the cell is unfinished, or its method does not load or draw any more.
    """
    before = _finished(cell)
    if before.brought is not None:
        raise InputError(f"{cell.folder}: its pictures were brought; `eval --scores-only` scores them again")
    capture = _capture_of(cell)
    spent = _spent_before(before)
    try:
        there = cell if device is None else replace(cell, config=placed_on(cell.config, device))
        with trained_client(there, capture) as client:
            drawn = draw_all(cell, capture, client)
        judged = score_outputs(cell, capture, drawn, spent, before.training)
        code = code_version(cell.config.source)
        result = replace(
            judged,
            provenance=before.provenance,
            drawn_on=there.config.device,
            evaluated_code="" if code == cell.config.code else code,
        )
    except (MethodFailed, Killed) as error:
        raise InputError(f"{cell.folder}: {error or 'its process was killed'}; the result stays as it was") from error
    write_result(cell.folder, result)
    return result


def time_cell(cell: Cell) -> Timing:
    """Load a cell's checkpoint and time its frames; no picture and no result is written.

    Raises:
        InputError: the cell is unfinished, or its method does not load or draw any more.
    """
    _finished(cell)
    capture = _capture_of(cell)
    try:
        with trained_client(cell, capture) as client:
            return time_frames(cell, capture, client)
    except (MethodFailed, Killed) as error:
        raise InputError(f"{cell.folder}: {error or 'its process was killed'}") from error


@contextmanager
def load_avatar(
    cell: Cell, capture: Capture, *, device: str = "cpu", trust: bool = False
) -> Iterator[tuple[Avatar, Capture]]:
    """A cell's trained avatar in this process, on a device, and the capture as it sees it, as long as the body runs.

    Code that is loaded here can do what the user can: a method of others is refused unless it is trusted.

    Raises:
        InputError: the method is of others and not trusted, or its weights do not load.
    """
    method = find_method(cell.config.source)
    if not trust and not method.is_ours:
        raise InputError(
            f"{cell.folder}: {cell.config.method} ({method.target}) is not ours, and its code would run here without"
            " isolation; --trust lets it"
        )
    factory = method.load()
    with _seen(cell, capture) as seen:
        with watched(capture, seen):
            config = placed_on(cell.config, device)
            avatar = make_avatar(
                factory, seen, of=config.source, seed=config.seed, preset=config.preset, changes=config.changes
            )
            avatar.load(cell.folder / CHECKPOINT)
        yield avatar, seen


def rescore_cell(cell: Cell) -> CellResult:
    """Recompute every quality from the stored predictions and write the result anew; costs stay as measured."""
    before = _finished(cell)
    capture = _capture_of(cell)
    scored = scored_views(cell, capture, before.views, alpha=before.has_alpha)
    for old, new in zip(before.views, scored, strict=True):
        if old.prediction != new.prediction:
            name = prediction_path(cell.folder, new)
            raise InputError(f"{name}: altered since it was scored (SHA-256 differs from result.json)")
    recomputed = quality_summary(cell, capture, scored)
    names = {(row.split, row.region, row.metric) for row in recomputed}
    others = tuple(row for row in before.summary if (row.split, row.region, row.metric) not in names)
    result = replace(before, views=tuple(scored), summary=recomputed + others)
    write_result(cell.folder, result)
    return result


def _train_and_evaluate(cell: Cell, capture: Capture) -> CellResult:
    """The method learns and draws in a process of its own, then ends; what it drew is scored in this one."""
    with _with_client(cell, capture) as client:
        made = client.make()
        client.fit()
        client.save()
        drawn = draw_all(cell, capture, client)
    stage_out(cell)
    return score_outputs(cell, capture, drawn, _training_time(cell, made, drawn))


def _score_brought(cell: Cell, capture: Capture) -> CellResult:
    """Check the brought pictures again, and score them.

    Raises:
        InputError: they are not what they were when the cell was planned.
    """
    if cell.predictions is None:
        raise InputError(f"{cell.folder}: expected the folder of its predictions in config.json")
    predictions = open_predictions(cell.predictions, capture, info=cell.info)
    if predictions.digest != cell.config.code:
        raise InputError(f"{cell.predictions}: the pictures changed since the run began; start it again")
    return score_predictions(cell, capture, predictions)


def _training_time(cell: Cell, made: TrainingTime, drawn: MethodOutputs) -> TrainingTime:
    """What training took: everything before the first picture, but for a template that ours learned for all methods.

    A method of others that learns a template has that in its training; what it says about it is not believed.
    """
    template_s = drawn.described.template_s if find_method(cell.config.source).is_ours else None
    whole = drawn.prepared
    assert whole.cpu_s is not None and made.cpu_s is not None
    return TrainingTime(
        wall_s=whole.wall_s - min(template_s or 0.0, made.wall_s),
        cpu_s=whole.cpu_s - min(template_s or 0.0, made.cpu_s),
    )


@contextmanager
def trained_client(cell: Cell, capture: Capture, *, secret: tuple[Path, ...] = ()) -> Iterator[MethodClient]:
    """A process that holds a cell's trained avatar, to be drawn by; it sees nothing of `secret` either.

    Raises:
        MethodFailed: the method does not load any more, or what the body asks of it goes wrong.
    """
    stage_in(cell)
    with _with_client(cell, capture, secret=secret) as client:
        client.make()
        client.load()
        yield client


@contextmanager
def _with_client(cell: Cell, capture: Capture, *, secret: tuple[Path, ...] = ()) -> Iterator[MethodClient]:
    method, oracle = find_method(cell.config.source), cell.config.source in ORACLES
    exposed = False
    try:
        with (
            _seen(cell, capture) as seen,
            open_client(cell, capture, seen, method, oracle=oracle, secret=secret) as client,
        ):
            if not client.isolated and (damage := _damage(cell, capture)):
                raise InputError(f"{cell.capture_folder}: {damage}")
            exposed = not client.isolated
            try:
                yield client
            except MethodFailed as error:
                require_disk(cell.folder, error)
                raise
    except (MethodFailed, Killed) as error:
        if exposed and (damage := _damage(cell, capture)):
            raise CaptureModifiedError(damage) from error
        raise
    if exposed and (damage := _damage(cell, capture)):
        raise CaptureModifiedError(damage)


def require_disk(folder: Path, failure: MethodFailed) -> None:
    """Whether a method failed for want of disk, while its files are still there: a full disk is not its failure.

    Raises:
        OSError: the disk that holds the cell is full, so the cell has no result.
    """
    if shutil.disk_usage(folder).free < FULL:
        raise OSError(errno.ENOSPC, f"the disk is full ({failure})", str(folder)) from failure


def _damage(cell: Cell, capture: Capture) -> str:
    """What is wrong with a capture's files, each hashed again; nothing if they are as they were made."""
    try:
        if capture.identity != cell.config.capture:
            return "its manifest is altered"
        return next(iter(verify_capture(capture.folder)), "")
    except (InputError, OSError) as error:
        return str(error)


def _clear(cell: Cell) -> None:
    """Remove what an earlier attempt drew: nothing of it may be scored as if it were of this one."""
    shutil.rmtree(cell.folder / "images", ignore_errors=True)


def _has_left(cell: Cell) -> bool:
    """Whether an earlier attempt left something that training takes up."""
    work = cell.folder / WORK
    return work.is_dir() and any(work.iterdir())


def placed_on(config: CellConfig, device: str) -> CellConfig:
    """The same avatar on a device, wherever it was trained: who looks at one needs no GPU.

    As it is where its method is of others, or has no device to choose.
    """
    if not find_method(config.source).is_ours or not hasattr(offered(config.source, config.preset), "device"):
        return config
    elsewhere = {} if device == "cpu" else {"device": device}
    return replace(config, changes={k: v for k, v in config.changes.items() if k != "device"} | elsewhere)


def _seen(cell: Cell, capture: Capture) -> AbstractContextManager[Capture]:
    """What a method may see: the training part; oracles, which stand for a bound and no method, see the truth."""
    store = cell.capture_folder.parent / TEMPLATES
    return seen_by_method(capture, cell.folder / "input", oracle=cell.config.source in ORACLES, store=store)


def _capture_of(cell: Cell) -> Capture:
    capture = load_capture(cell.capture_folder)
    if capture.identity != cell.config.capture:
        raise InputError(
            f"{cell.capture_folder}: expected the capture {cell.config.capture[:12]}, got {capture.identity[:12]}"
        )
    return capture


def _finished(cell: Cell) -> CellResult:
    result = result_of(cell)
    if result is None or result.status != "done":
        raise InputError(
            f"{cell.folder}: expected a finished cell, got {result.status if result else 'no result.json'}"
        )
    return result


def _spent_before(result: CellResult) -> TrainingTime:
    """What a finished cell's training took."""
    clock, cpu_s, whole = (result.value("speed", "", name) for name in ("train_wall_s", "train_cpu_s", "train_s"))
    return TrainingTime(wall_s=clock or whole or 0.0, cpu_s=cpu_s)


def _provenance(wall_s: float) -> Provenance:
    return Provenance(
        commit=provenance.commit(), machine=provenance.machine(), versions=provenance.versions(), wall_s=wall_s
    )


def _end_with_parent() -> None:
    """Leave when the engine is gone, however it went: its end of our standard input closes then."""
    while os.read(0, 4096):
        pass
    os._exit(130)


def _reraise(error: OSError) -> str:
    raise error


if __name__ == "__main__":
    sys.exit(main(cast(list[str], sys.argv[1:])))
