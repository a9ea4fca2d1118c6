"""Puts the shards of a run together, from one machine or many."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from ash.files import InputError, read_json, write_json
from benchmarks.cell.cells import read_result, result_of
from benchmarks.suites.runs import RUN_FILE, read_run


def merge_runs(shards: Sequence[Path], out: Path) -> None:
    """Copy every finished cell of the shards into `out`; a cell that several have is taken once.

    Raises:
        InputError: the shards are not of one run, disagree about a cell, or together lack one.
    """
    runs = [read_run(shard) for shard in shards]
    descriptions = [read_json(shard / RUN_FILE) for shard in shards]
    for shard, description in zip(shards, descriptions, strict=True):
        for name in ("suite", "cells"):
            if description[name] != descriptions[0][name]:
                raise InputError(f"{shard}: its {name} differ from those of {shards[0]}: not shards of one run")
    finished: dict[str, Path] = {}
    for run in runs:
        for cell in run.cells:
            result = result_of(cell)
            if result is None:
                continue
            before = finished.setdefault(cell.config.key, cell.folder)
            if before != cell.folder and (earlier := read_result(before)) is not None and earlier.views != result.views:
                raise InputError(f"{cell.folder} and {before}: two results of one cell that differ")
    missing = [key for key in descriptions[0]["cells"] if key not in finished]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(descriptions[0]['cells'])} cells are in no shard, the first is {missing[0]}"
        )
    for key, folder in finished.items():
        target = out / "cells" / key
        if not (target / "result.json").exists():
            shutil.copytree(folder, target, dirs_exist_ok=True)
    write_json(out / RUN_FILE, descriptions[0])
