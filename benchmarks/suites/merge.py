"""Puts the shards of a run together, from one machine or many."""

from collections.abc import Sequence
from pathlib import Path

from ash.files import InputError, read_json, write_json
from benchmarks.cell.schema import read_result, result_of
from benchmarks.suites.engine import copied_folder
from benchmarks.suites.runs import RUN_FILE, read_run


def are_shards(folders: Sequence[Path]) -> bool:
    """Whether several folders hold parts of one run: the same suite and the same cells."""
    descriptions = [read_json(path) if (path := folder / RUN_FILE).is_file() else None for folder in folders]
    identities = [(each.get("suite"), each.get("cells")) if isinstance(each, dict) else None for each in descriptions]
    return len(folders) > 1 and None not in identities and all(each == identities[0] for each in identities)


def merge_runs(shards: Sequence[Path], out: Path) -> None:
    """Copy every finished cell of the shards into `out`; a cell that several have is taken once.

    Raises:
        InputError: the shards disagree about a cell, or together lack one.
    """
    runs = [read_run(shard) for shard in shards]
    description = read_json(shards[0] / RUN_FILE)
    finished: dict[str, Path] = {}
    for run in runs:
        for cell in run.cells:
            result = result_of(cell)
            if result is None:
                continue
            before = finished.setdefault(cell.config.key, cell.folder)
            if before != cell.folder and (earlier := read_result(before)) is not None and earlier.views != result.views:
                raise InputError(f"{cell.folder} and {before}: two results of one cell that differ")
    missing = [key for key in description["cells"] if key not in finished]
    if missing:
        first = description.get("cell_titles", {}).get(missing[0], missing[0])
        raise InputError(f"{len(missing)} of {len(description['cells'])} cells are in no shard, the first: {first}")
    for key, folder in finished.items():
        target = out / "cells" / key
        if not (target / "result.json").exists():
            with copied_folder(folder, target):
                pass
    write_json(out / RUN_FILE, description)
