"""A run: a suite's captures, then its cells, then what they came to, all in one folder."""

import contextlib
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from ash.capture.formats import load_capture
from ash.capture.typed import from_json
from ash.fields import for_json
from ash.files import InputError, read_json, require_plain, run_lock, write_json
from benchmarks.cell import sandbox
from benchmarks.cell.metrics import PROTOCOL
from benchmarks.cell.predictions import open_predictions
from benchmarks.cell.registry import BROUGHT, ORACLES, brought_folder, code_version, configured, find_method, offered
from benchmarks.cell.schema import Cell, CellConfig, CellResult, printable, read_cell, result_of
from benchmarks.suites.captures import (
    make_capture,
    missing_captures,
    require_intact,
    require_space_for,
    subject_of,
    truth_of,
)
from benchmarks.suites.engine import (
    Limits,
    make_executor,
    plan_cells,
    read_shard,
    require_executor,
    run_cells,
    shard_of,
    sound_result,
)
from benchmarks.suites.progress import Progress
from benchmarks.suites.reuse import reuse
from benchmarks.suites.suites import CellSpec, Suite
from benchmarks.suites.tables import TableSpec
from synth.person.cast import VALIDATION

RUN_FILE = "run.json"
TRAINED_BY_HAND = "train"  # suite of a folder of cells that `train` made
IMPORT_S = 120.0  # of a method, before a run


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A run on disk: what was asked, and the cells that answer it."""

    folder: Path
    suite: str
    about: str
    command: str
    cells: tuple[Cell, ...]
    absent: tuple[str, ...] = ()  # keys of cells that have no folder: other shards have them
    titles: dict[str, str] = field(default_factory=dict)  # of methods, where the suite gives them
    table: tuple[TableSpec, ...] = ()  # what its own table shows


@dataclass(frozen=True, kw_only=True, slots=True)
class RunFile:
    """`run.json`."""

    protocol: str
    suite: str
    about: str
    command: str
    cells: tuple[str, ...]
    titles: dict[str, str] = field(default_factory=dict)
    table: tuple[TableSpec, ...] = ()
    cell_titles: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True)
class RunOptions:
    """How a suite is run: what does not change its results."""

    out: Path
    data: Path
    workers: int  # processes that make a capture
    cells: int | None = None  # side by side; None: as many as workers
    gpus: tuple[str, ...] = ()  # as CUDA_VISIBLE_DEVICES names them: each cell that learns on CUDA sees one
    executor: str = "local"
    shard: str | None = None
    retry_failed: bool = False
    reuse: tuple[Path, ...] = ()  # runs by other code, whose cells stay where today's code trains the same
    command: str = ""

    @property
    def side_by_side(self) -> int:
        """Cells at a time."""
        return self.cells or self.workers


def run_suite(suite: Suite, options: RunOptions) -> Run:
    """Make the captures, run the missing cells, and return the run; finished work is never repeated."""
    for folder in (options.out, options.data):
        require_utf8(folder)
    for note in require_runnable(suite, options):
        print(note, file=sys.stderr)
    options.out.mkdir(parents=True, exist_ok=True)
    with contextlib.nullcontext() if options.shard else run_lock(options.out):
        earlier = [cell for folder in options.reuse for cell in read_run(folder).cells]  # perhaps of this very folder
        run = prepared(suite, options)
        if earlier:
            say = partial(print, file=sys.stderr)
            for damage in filter(None, (sound_result(cell)[1] for cell in run.cells)):
                say(damage)
            reuse(run.cells, earlier, lambda cells: run_missing(cells, suite, options), say=say)
        run_missing(shard_of(run.cells, options.shard) if options.shard else run.cells, suite, options)
    return run


def require_utf8(folder: Path) -> None:
    """Refuse a folder whose path cannot be written to JSON.

    Raises:
        InputError: its absolute path is not UTF-8.
    """
    path = os.fsencode(folder.resolve())
    try:
        path.decode()
    except UnicodeDecodeError:
        raise InputError(f"expected a folder whose path is UTF-8, got {path!r}") from None


def require_runnable(suite: Suite, options: RunOptions) -> list[str]:
    """Refuse what is known to be wrong before anything is rendered; returns what is odd about rows, a line each.

    Raises:
        InputError: a shard, an executor, a method, a preset or a changed field is wrong, or the disk is too small.
    """
    if options.shard:
        read_shard(options.shard)
        if options.reuse:
            raise InputError("--reuse decides on whole rows: expected it without --shard")
    require_executor(options.executor)
    missing = missing_captures(suite, options.data)
    notes = []
    for row in suite.methods:
        of, preset = row.of or row.name, row.preset or suite.preset
        if (brought := brought_folder(of)) is not None:
            if not brought.is_dir():
                raise InputError(f"row {row.name!r}: expected the folder of its pictures, got {brought}")
            continue
        method = find_method(of)
        if row.changes:
            if configured(of, preset, row.changes) == offered(of, preset):
                fields = ", ".join(f"{key} = {value}" for key, value in row.changes)
                notes.append(f"row {row.name!r} equals {of!r}: preset {preset} has {fields} already")
        elif method.is_ours:
            offered(of, preset)
        elif missing:  # Code of others is not imported here; where cells start at once, the first one says as much.
            _require_importable(of, preset)
    require_space_for(missing, options.data)
    return notes


def _require_importable(method: str, preset: str) -> None:
    """Import a method in a process of its own; only what that process refuses counts, not how it ends otherwise."""
    code = (
        "import sys; from ash.files import InputError; from benchmarks.cell.sandbox import add_method_paths\n"
        "from benchmarks.cell.registry import offered; add_method_paths()\n"
        "try: offered(*sys.argv[1:])\nexcept InputError as error: sys.exit(f'refused: {error}')"
    )
    command = [sys.executable, "-P", "-c", code, method, preset]
    settings: dict[str, Any] = {"env": sandbox.clean_environment(), "stdin": subprocess.DEVNULL, "capture_output": True}
    with contextlib.suppress(subprocess.TimeoutExpired):
        ended = subprocess.run(command, timeout=IMPORT_S, check=False, **settings)
        last = ended.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        if last.startswith("refused: "):
            raise InputError(last.removeprefix("refused: "))


def prepared(suite: Suite, options: RunOptions) -> Run:
    """The captures made, and the run with all its cells written down; none is run.

    Raises:
        InputError: a capture is damaged, or brought pictures cannot be scored.
    """
    folders = {spec: make_capture(spec, options.data, workers=options.workers) for spec in suite.captures}
    for folder in folders.values():
        require_intact(folder)
    cells = [cell_for(spec, folders[spec.capture], options.out) for spec in suite.cells]
    run = Run(
        folder=options.out,
        suite=suite.name,
        about=suite.about,
        command=options.command,
        cells=tuple(cells),
        titles={method.name: method.title for method in suite.methods if method.title},
        table=suite.table,
    )
    write_run(run)
    return run


def run_missing(cells: Sequence[Cell], suite: Suite, options: RunOptions) -> None:
    """Run the cells that have no result, within the suite's limits, and show how far they are."""
    plan = plan_cells(cells, retry_failed=options.retry_failed)
    limits = Limits(seconds=suite.limit_minutes * 60, memory_mb=suite.limit_mb)
    progress = Progress("cells", len(plan.todo), expected_s=suite.cell_minutes * 60, workers=options.side_by_side)
    for reason in plan.reasons:
        progress.say(reason)
    if plan.done:
        progress.say(f"{len(plan.done)} of {len(plan.done) + len(plan.todo)} cells are there already")
    if plan.todo and options.executor == "local" and (problem := sandbox.problem()):
        progress.say(f"methods are not isolated here: {problem}; rows say so")
    gpu = any(cell.config.device != "cpu" for cell in plan.todo)
    with make_executor(options.executor, workers=options.side_by_side, gpu=gpu) as executor:
        run_cells(plan, executor, limits, progress, gpus=options.gpus)
    progress.close()


def cell_for(spec: CellSpec, capture_folder: Path, out: Path, *, info: Path | None = None) -> Cell:
    """The cell of a method on a capture, in its folder under `out`; of brought pictures, `info` says what they are.

    Pictures for several captures lie each in a folder that is called as its capture's.

    Raises:
        InputError: brought pictures cannot be scored, or the method is an oracle and the capture has no truth.
    """
    capture = load_capture(capture_folder)
    if (spec.factory or spec.method) in ORACLES and not (capture_folder / "truth" / "template.npz").is_file():
        raise InputError(f"{spec.method}: an oracle is shown the truth, and {capture_folder} has none")
    brought = brought_folder(spec.factory)
    if brought is not None and (own := brought / capture_folder.resolve().name).is_dir():
        brought = own
    if brought is None:
        code = code_version(spec.factory or spec.method)
    else:
        code = open_predictions(brought, capture, info=info).digest
    config = CellConfig(
        scene=spec.capture.scene,
        size=spec.capture.size,
        capture_seed=spec.capture.seed,
        capture=capture.identity,
        truth=truth_of(capture.manifest),
        method=spec.method,
        preset=spec.preset,
        seed=spec.seed,
        code=code,
        factory=spec.factory if brought is None else BROUGHT,
        changes=for_json(spec.changes),
        axis=spec.capture.stress.axis if spec.capture.stress else "",
        severity=spec.capture.stress.severity if spec.capture.stress else 0.0,
        subject=subject_of(capture.manifest),
    )
    folder = out / "cells" / config.key
    return Cell(config=config, folder=folder, capture_folder=capture_folder, predictions=brought, info=info)


def write_run(run: Run) -> None:
    """Write `run.json`: the whole matrix, also the cells that other shards will fill."""
    write_json(run.folder / RUN_FILE, description_of(run))


def description_of(run: Run) -> dict[str, Any]:
    """What `run.json` says of a run."""
    file = RunFile(
        protocol=PROTOCOL,
        suite=run.suite,
        about=run.about,
        command=run.command,
        cells=tuple(cell.config.key for cell in run.cells),
        titles=run.titles,
        table=run.table,
        cell_titles={cell.config.key: cell.config.title for cell in run.cells},
    )
    return {name: value for name, value in asdict(file).items() if value or name not in ("titles", "table")}


def read_run(folder: Path) -> Run:
    """Read a run's folder; a single cell's folder is a run of one cell.

    Raises:
        InputError: no run is there, it is of another protocol, or a cell's config is damaged.
    """
    if (folder / "config.json").exists():
        cell = read_cell(folder)
        return Run(folder=folder, suite="one cell", about=cell.config.title, command="", cells=(cell,))
    path = folder / RUN_FILE
    if not path.exists() and (trained := sorted(folder.glob("cells/*/config.json"))):  # As `train` leaves them.
        cells = tuple(read_cell(each.parent) for each in trained)
        return Run(folder=folder, suite=TRAINED_BY_HAND, about="cells trained by hand", command="", cells=cells)
    content = read_json(path)
    try:
        file: RunFile = from_json(RunFile, content)
        keys = [require_plain(key, what="cell") for key in file.cells]
        require_plain(file.suite, what="suite")
    except ValueError as error:
        raise InputError(f"{path}: expected the description of a run ({error})") from error
    if file.protocol != PROTOCOL:
        raise InputError(f"{path}: expected protocol {PROTOCOL}, got {file.protocol}; results do not mix")
    names = {"suite": file.suite, "about": printable(file.about), "command": printable(file.command)}
    titles = {name: printable(title) for name, title in file.titles.items()}
    present = [key for key in keys if (folder / "cells" / key / "config.json").exists()]
    cells = tuple(read_cell(folder / "cells" / key) for key in present)
    absent = tuple(key for key in keys if key not in present)
    return Run(folder=folder, cells=cells, absent=absent, titles=titles, table=file.table, **names)


def gathered(runs: Sequence[Run], out: Path, *, command: str, leave_out: Callable[[str], None] | None = None) -> Run:
    """The finished cells of several runs as one, to be reported in `out`; a cell that several have is taken once.

    Where one scene's name stands for different captures of a subject, each is called as its capture's folder is. The
    commands of the runs and then `command` are the command of the whole. `leave_out`: is told which cells are left out,
    where an earlier run has their row trained differently or their scene from other captures; none: see Raises.

    Raises:
        InputError: people for validation are among others, or two cells of one name were trained differently: a
            report would take them for two seeds.
    """
    cells = list({cell.config.key: cell for run in runs for cell in run.cells}.values())
    if leave_out is not None:
        cells = _first_of_each(cells, leave_out)
    mixed = mixed_places(cell.config for cell in cells)
    if len({cell.config.subject >= VALIDATION for cell in cells}) > 1:
        raise InputError(
            f"{out}: people from {VALIDATION} on are there to choose by, expected a report without the others"
        )
    named = [
        replace(cell, config=replace(cell.config, scene=cell.capture_folder.resolve().name))
        if cell.config.place in mixed
        else cell
        for cell in cells
    ]
    require_one_of_each(named)
    about = f"cells of {', '.join(str(run.folder) for run in runs)}"
    titles = {name: title for run in reversed(runs) for name, title in run.titles.items()}  # The first run's first.
    table = next((run.table for run in runs if run.table), ())
    there = {cell.config.key for cell in cells}
    absent = tuple(dict.fromkeys(key for run in runs for key in run.absent if key not in there))
    whole = joined(*(run.command for run in runs), command)
    given: dict[str, Any] = {"suite": out.name, "about": about, "command": whole, "titles": titles, "table": table}
    return Run(folder=out, cells=tuple(named), absent=absent, **given)


def joined(*commands: str) -> str:
    """Commands of runs as that of one run: one line, separated by semicolons, each once."""
    return "; ".join(dict.fromkeys(each for command in commands for each in commands_of(command)))


def commands_of(command: str) -> list[str]:
    """The commands that made a run, in order: those that `joined` put into one line."""
    return command.split("; ") if command else []


def require_one_of_each(cells: Iterable[Cell]) -> None:
    """Refuse two cells of one name that were trained differently: they would be taken for two seeds.

    Raises:
        InputError: names both folders.
    """
    for cell, other in _clashes(cells):
        raise InputError(
            f"{cell.folder}: expected one cell {cell.config.title}, another with other settings or code is"
            f" {other.folder}; `train --row NAME` names a row, `compare` compares runs"
        )


def _first_of_each(cells: Sequence[Cell], leave_out: Callable[[str], None]) -> list[Cell]:
    """The finished cells that agree with those before them in their scene's captures and in their row's settings."""
    cells = [cell for cell in cells if (cell.folder / "result.json").exists()]
    truths: dict[tuple[str, int], str] = {}
    alike = [
        cell
        for cell in cells
        if truths.setdefault((cell.config.place, cell.config.subject), cell.config.truth) == cell.config.truth
    ]
    kept = {cell.folder for cell in alike} - {cell.folder for cell, _ in _clashes(alike)}
    left = Counter((cell.config.method, cell.config.place) for cell in cells if cell.folder not in kept)
    for (method, place), count in left.items():
        leave_out(f"{method} on {place}: {count} left out, an earlier run has others in their place")
    return [cell for cell in cells if cell.folder in kept]


def _clashes(cells: Iterable[Cell]) -> Iterator[tuple[Cell, Cell]]:
    """Cells that differ from an earlier one of their name, or of their row in how it was trained; and that one."""
    names: dict[tuple[Any, ...], Cell] = {}
    rows: dict[tuple[str, str], Cell] = {}
    for cell in cells:
        config = cell.config
        row = (config.place, config.method)
        if row in rows and _settings(rows[row]) != _settings(cell):
            yield cell, rows[row]
            continue
        twin = names.setdefault((*row, config.subject, config.capture_seed, config.seed), cell)
        if twin is not cell:
            yield cell, twin
        rows.setdefault(row, cell)


def _settings(cell: Cell) -> tuple[Any, ...]:
    config = cell.config
    return config.preset, config.source, config.changes, config.code


def mixed_places(configs: Iterable[CellConfig]) -> set[str]:
    """Names of scenes that stand for different captures of one subject."""
    shown: dict[tuple[str, int], set[str]] = {}
    for config in configs:
        shown.setdefault((config.place, config.subject), set()).add(config.truth)
    return {place for (place, _), truths in shown.items() if len(truths) > 1}


def require_for_choosing(run: Run) -> Run:
    """The run, if it is one of people for validation.

    Raises:
        InputError: it is of people whom tables of results have.
    """
    if any(cell.config.subject < VALIDATION for cell in run.cells):
        raise InputError(f"{run.folder}: expected a run of `--validation`, on people from {VALIDATION} on alone")
    return run


def capture_name_of(cell: Cell) -> str:
    """What a report calls the capture of a cell: its folder."""
    return printable(cell.capture_folder.name)


def results_of(run: Run) -> list[CellResult]:
    """The results of a run's finished cells, in the suite's order.

    Raises:
        InputError: nothing is finished yet, or a result is damaged.
    """
    results = finished_results(run)
    if not results:
        raise InputError(f"{run.folder}: no cell is finished, so there is nothing to report")
    return results


def finished_results(run: Run) -> list[CellResult]:
    """The results that are there, in the suite's order; perhaps none."""
    present = [(cell, result_of(cell)) for cell in run.cells]
    return [replace(result, config=cell.config) for cell, result in present if result is not None]


def failures(results: Sequence[CellResult]) -> list[CellResult]:
    """The results of cells that did not come through."""
    return [result for result in results if result.status != "done"]
