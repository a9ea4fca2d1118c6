"""What a change is compared with: a run of code that is known to be good, small enough for a repository.

- `SUITE.toml`: the suite. Its content counts, not its name.
- `run.json`, `cells/KEY/config.json` and `result.json`: every number of every seed, as a run has them.
- Of the first seed of each row `log.jsonl`, the beginning of its training log, and of all but oracles
  `model.safetensors`, the trained avatar, and `images/`, some of its pictures.
- `gate.json`: the least times of these avatars, and the changes that were accepted.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from ash.capture.typed import from_json
from ash.files import InputError, open_regular, read_json, write_atomic, write_json
from benchmarks.cell.evaluation import spread
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import (
    CHECKPOINT,
    Cell,
    CellConfig,
    CellResult,
    ViewScore,
    is_trained,
    prediction_path,
    printable,
    result_of,
    write_config,
    write_result,
)
from benchmarks.suites.archive import numbers_of
from benchmarks.suites.runs import Run, read_run

FILE = "gate.json"
LOG_LINES = 16  # of a training log
LARGEST_LOG = 1 << 22  # bytes that are read of it
LARGEST_CHECKPOINT = 8 << 20  # bytes of one avatar; a larger one is left out, and the row is judged by training alone
PICTURES = 2  # of each split


@dataclass(frozen=True, kw_only=True, slots=True)
class Accepted:
    """A change that somebody accepted: which row, why, and at which commit."""

    row: str
    because: str
    commit: str


@dataclass(frozen=True, kw_only=True, slots=True)
class GateFile:
    """`gate.json`. Times are ratios to the reference workload, by row and by what was timed."""

    machine: str  # processor
    times: dict[str, dict[str, float]]
    accepted: tuple[Accepted, ...] = ()


@dataclass(frozen=True, slots=True)
class Entry:
    """One cell and its result."""

    cell: Cell
    result: CellResult


@dataclass(frozen=True, kw_only=True, slots=True)
class Baseline:
    """A baseline that was read."""

    folder: Path
    suite: Path  # its file
    rows: dict[str, list[Entry]]  # seeds in order
    file: GateFile
    commit: str


def row_of(config: CellConfig) -> str:
    """The row of a cell: scene, person and method."""
    return config.title.rpartition(" · ")[0]


def rows_of(run: Run) -> dict[str, list[Entry]]:
    """The finished cells of a run by row, seeds in order."""
    rows: dict[str, list[Entry]] = {}
    for cell in sorted(run.cells, key=lambda cell: cell.config.seed):
        if (result := result_of(cell)) is not None:
            rows.setdefault(row_of(cell.config), []).append(Entry(cell, replace(result, config=cell.config)))
    return rows


def read_baseline(folder: Path) -> Baseline:
    """Read a baseline.

    Raises:
        InputError: there is none, it is damaged, or it is of another protocol version.
    """
    suites = sorted(folder.glob("*.toml")) if folder.is_dir() else []
    if len(suites) != 1 or not (folder / FILE).is_file():
        raise InputError(f"{folder}: expected a baseline of the gate; make one with `gate --update-baseline`")
    rows = rows_of(read_run(folder))
    if not rows:
        raise InputError(f"{folder}: expected a baseline of the gate, got one without a finished cell")
    provenance = next(iter(rows.values()))[0].result.provenance
    commit = provenance.commit if provenance else "unknown"
    return Baseline(folder=folder, suite=suites[0], rows=rows, file=read_gate_file(folder / FILE), commit=commit)


def read_gate_file(path: Path) -> GateFile:
    """Read `gate.json`.

    Raises:
        InputError: it is damaged.
    """
    content = read_json(path)
    try:
        file: GateFile = from_json(GateFile, content)
    except ValueError as error:
        raise InputError(f"{path}: expected what the gate wrote ({error})") from error
    texts = [
        Accepted(row=printable(a.row), because=printable(a.because), commit=printable(a.commit)) for a in file.accepted
    ]
    return replace(file, machine=printable(file.machine), accepted=tuple(texts))


def require_replaceable(folder: Path, rows: Mapping[str, Sequence[Entry]]) -> None:
    """Refuse a run that may not become the baseline in `folder`, which need not exist.

    Raises:
        InputError: a cell of it failed, or it lacks a row that the baseline has.
    """
    failed = [row for row, entries in rows.items() if any(entry.result.status != "done" for entry in entries)]
    if failed:
        raise InputError(f"a baseline needs cells that are done, and cells of {', '.join(failed)} failed")
    before = read_baseline(folder).rows if (folder / FILE).exists() else {}
    if dropped := [row for row in before if row not in rows]:
        raise InputError(
            f"{folder} holds {', '.join(dropped)}, which this run lacks; to drop them, remove that folder first"
        )


def write_baseline(folder: Path, suite: Path, run: Run, file: GateFile) -> None:
    """Write a run as the baseline; what was there is replaced as a whole.

    Raises:
        InputError: as `require_replaceable`, or `folder` holds something else.
    """
    rows = rows_of(run)
    require_replaceable(folder, rows)
    if folder.exists() and any(folder.iterdir()) and not (folder / FILE).exists():
        raise InputError(f"{folder}: expected a baseline, an empty folder or none")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as space:
        made = Path(space) / "new"
        for name, content in numbers_of(run):
            write_atomic(made / name, content)
        for entries in rows.values():
            _write_first(entries[0], made / "cells" / entries[0].cell.config.key)
        write_atomic(made / f"{suite.stem}.toml", suite.read_bytes())
        write_json(made / FILE, asdict(file))
        if folder.exists():
            folder.rename(Path(space) / "old")
        made.rename(folder)


def _write_first(first: Entry, folder: Path) -> None:
    """Of the first seed of a row the beginning of its log, the avatar and some of its pictures."""
    if (log := first.cell.folder / "log.jsonl").exists():
        with open_regular(log, most=LARGEST_LOG) as file:
            write_atomic(folder / "log.jsonl", b"".join(islice(file, LOG_LINES)))
    if keeps_avatar(first.cell):
        names = [Path(CHECKPOINT), *(prediction_path(Path(), view) for view in stored_views(first.result))]
        for name in names:
            write_atomic(folder / name, (first.cell.folder / name).read_bytes())


def keeps_avatar(cell: Cell) -> bool:
    """Whether a baseline keeps the avatar of a row's first cell; the rendering of an oracle is its method's."""
    checkpoint = cell.folder / CHECKPOINT
    kept = is_trained(cell) and checkpoint.stat().st_size <= LARGEST_CHECKPOINT
    return kept and not is_oracle(cell.config.method)


def with_row(
    baseline: Baseline, row: str, entries: Sequence[Entry], *, because: str, commit: str
) -> tuple[Run, tuple[Accepted, ...]]:
    """The baseline's cells as a run with those of one row replaced, and the changes accepted so far with this one."""
    rows = {**baseline.rows, row: list(entries)}
    cells = tuple(entry.cell for each in rows.values() for entry in each)
    acceptance = Accepted(row=row, because=printable(because), commit=commit)
    return replace(read_run(baseline.folder), cells=cells), (*baseline.file.accepted, acceptance)


def stored_views(result: CellResult) -> list[ViewScore]:
    """The views whose pictures a baseline keeps: `PICTURES` of each split, spread evenly."""
    by_split = [[v for v in result.views if v.split == split] for split in dict.fromkeys(v.split for v in result.views)]
    return [of_one[index] for of_one in by_split for index in spread(len(of_one), PICTURES)]


def copied(entry: Entry, here: Cell, out: Path) -> Cell:
    """The cell of a baseline's avatar in `out`, to be drawn again on the capture of this machine.

    `here`: a cell of the same row on this machine; its capture may be rounded by another processor.
    """
    folder = out / entry.cell.config.key
    shutil.rmtree(folder, ignore_errors=True)
    config = replace(entry.cell.config, capture=here.config.capture)
    cell = Cell(config=config, folder=folder, capture_folder=here.capture_folder)
    write_config(cell)
    write_result(folder, replace(entry.result, config=config))
    shutil.copyfile(entry.cell.folder / CHECKPOINT, folder / CHECKPOINT)
    return cell
