"""A run: a suite's captures, then its cells, then what they came to, all in one folder."""

import contextlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ash.dataset import load_capture, read_manifest, verify_capture
from ash.files import InputError, hash_of, read_json, write_json
from benchmarks import splats_rung
from benchmarks.cells import Cell, CellConfig, CellResult, read_cell, read_result
from benchmarks.engine import Limits, make_executor, plan_cells, run_cells, shard_of
from benchmarks.experiments import CaptureSpec, CellSpec, Suite, code_version, find_method
from benchmarks.locks import only_run_in
from benchmarks.metrics import PROTOCOL
from benchmarks.progress import Progress
from benchmarks.stress import Stress
from synth.perturb import perturb
from synth.presets import scene

RUN_FILE = "run.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A run on disk: what was asked, and the cells that answer it."""

    folder: Path
    suite: str
    about: str
    command: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunOptions:
    """How a suite is run: what does not change its results."""

    out: Path
    data: Path
    workers: int
    executor: str = "local"
    shard: str | None = None
    retry_failed: bool = False
    command: str = ""


def run_suite(suite: Suite, options: RunOptions) -> Run:
    """Make the captures, run the missing cells, and return the run; finished work is never repeated."""
    for method in suite.methods:
        find_method(method)
    options.out.mkdir(parents=True, exist_ok=True)
    with contextlib.nullcontext() if options.shard else only_run_in(options.out):
        return _run_suite(suite, options)


def _run_suite(suite: Suite, options: RunOptions) -> Run:
    folders = {spec: make_capture(spec, options.data, workers=options.workers) for spec in suite.captures}
    for folder in folders.values():
        require_intact(folder)
    cells = [cell_for(spec, folders[spec.capture], options.out) for spec in suite.cells]
    run = Run(folder=options.out, suite=suite.name, about=suite.about, command=options.command, cells=tuple(cells))
    write_run(run)
    run_missing(shard_of(cells, options.shard) if options.shard else cells, suite, options)
    return run


def run_missing(cells: Sequence[Cell], suite: Suite, options: RunOptions) -> None:
    """Run the cells that have no result, within the suite's limits, and show how far they are."""
    plan = plan_cells(cells, retry_failed=options.retry_failed)
    limits = Limits(seconds=suite.limit_minutes * 60, memory_mb=suite.limit_mb)
    progress = Progress("cells", len(plan.todo), expected_s=suite.cell_minutes * 60, workers=options.workers)
    for reason in plan.reasons:
        progress.say(reason)
    if plan.done:
        progress.say(f"{len(plan.done)} of {len(plan.done) + len(plan.todo)} cells are there already")
    with make_executor(options.executor, workers=options.workers) as executor:
        run_cells(plan, executor, limits, progress)
    progress.close()


def make_capture(spec: CaptureSpec, data: Path, *, workers: int) -> Path:
    """The folder of a finished capture under `data`, rendering what is missing of it.

    A capture that an older version of the scene left under the same name is not touched: the new one goes beside it.
    """
    if spec.stress is not None:
        return _spoilt_capture(spec, spec.stress, make_capture(replace(spec, stress=None), data, workers=workers), data)
    folder = data / spec.name
    if spec.scene == splats_rung.SCENE:
        splats_rung.draw_capture(folder, size=spec.size, seed=spec.seed)
        return folder
    wanted = scene(spec.scene, size=spec.size, seed=spec.seed).identity
    if (folder / "manifest.json").exists() and read_manifest(folder).get("identity", wanted) != wanted:
        folder = data / f"{spec.name}-{wanted[:8]}"
    make_capture_in(spec, folder, workers=workers)
    return folder


def _spoilt_capture(spec: CaptureSpec, stress: Stress, clean: Path, data: Path) -> Path:
    """The clean capture, spoilt; made anew where an earlier attempt did not come to its manifest, the last file."""
    capture = load_capture(clean)
    folder = data / f"{spec.name}-{capture.identity[:8]}"
    if not (folder / "manifest.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        perturb(clean, folder, stress.perturbation(capture), seed=spec.seed)
    return folder


def make_capture_in(spec: CaptureSpec, folder: Path, *, workers: int) -> None:
    """Render into `folder` what is missing of a capture."""
    from synth.capture import make_capture as render

    progress = Progress(f"images of {spec.name}", 0, expected_s=0.0, workers=workers)
    if not (folder / "cameras.json").exists():  # Written last before the images.
        progress.say(f"preparing {spec.name}: body, motion, clothes, texture (up to two minutes)")
    render(scene(spec.scene, size=spec.size, seed=spec.seed), folder, workers=workers, progress=progress.advance)
    progress.close()


def require_intact(folder: Path) -> None:
    """Hash a capture again before anything is learned from it.

    Raises:
        InputError: a file is missing, altered or foreign; names the first.
    """
    problems = verify_capture(folder)
    if problems:
        more = f" (and {len(problems) - 1} more, see ash-bench verify)" if len(problems) > 1 else ""
        raise InputError(f"{folder}: {problems[0]}{more}")


def cell_for(spec: CellSpec, capture_folder: Path, out: Path) -> Cell:
    """The cell of a method on a capture, in its folder under `out`."""
    capture = load_capture(capture_folder)
    config = CellConfig(
        scene=spec.capture.scene,
        size=spec.capture.size,
        capture_seed=spec.capture.seed,
        capture=capture.identity,
        truth=_truth_of(capture.manifest),
        method=spec.method,
        preset=spec.preset,
        seed=spec.seed,
        code=code_version(spec.method),
        axis=spec.capture.stress.axis if spec.capture.stress else "",
        severity=spec.capture.stress.severity if spec.capture.stress else 0.0,
    )
    return Cell(config=config, folder=out / "cells" / config.key, capture_folder=capture_folder)


def _truth_of(manifest: dict[str, Any]) -> str:
    """A name for what a capture shows that does not depend on the machine that rendered it."""
    spoilt = {name: value for name, value in manifest.get("perturbed", {}).items() if name != "of"}
    return hash_of([manifest.get("identity"), manifest.get("source"), spoilt])


def write_run(run: Run) -> None:
    """Write `run.json`: the whole matrix, also the cells that other shards will fill."""
    content = {
        "protocol": PROTOCOL,
        "suite": run.suite,
        "about": run.about,
        "command": run.command,
        "cells": [cell.config.key for cell in run.cells],
    }
    write_json(run.folder / RUN_FILE, content)


def read_run(folder: Path) -> Run:
    """Read a run's folder; a single cell's folder is a run of one cell.

    Raises:
        InputError: no run is there, it is of another protocol, or a cell's config is damaged.
    """
    if (folder / "config.json").exists():
        cell = read_cell(folder)
        return Run(folder=folder, suite="one cell", about=cell.config.title, command="", cells=(cell,))
    path = folder / RUN_FILE
    content = read_json(path)
    try:
        if content["protocol"] != PROTOCOL:
            raise InputError(f"{path}: expected protocol {PROTOCOL}, got {content['protocol']}; results do not mix")
        keys = [str(key) for key in content["cells"]]
        names = {name: str(content[name]) for name in ("suite", "about", "command")}
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: expected the description of a run ({error})") from error
    found = [folder / "cells" / key for key in keys if (folder / "cells" / key / "config.json").exists()]
    return Run(folder=folder, cells=tuple(read_cell(cell) for cell in found), **names)


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
    return [result for cell in run.cells if (result := read_result(cell.folder)) is not None]


def failures(results: Sequence[CellResult]) -> list[CellResult]:
    """The results of cells that did not come through."""
    return [result for result in results if result.status != "done"]
