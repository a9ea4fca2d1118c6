"""More cells of a suite's methods, with other seeds, to measure times again."""

from collections.abc import Collection
from dataclasses import replace

from benchmarks.cell.registry import brought_folder
from benchmarks.cell.schema import CellResult, result_of
from benchmarks.gate.gate import Row
from benchmarks.suites.captures import make_capture
from benchmarks.suites.runs import RunOptions, cell_for, run_missing
from benchmarks.suites.suites import Suite


def remeasure(
    suite: Suite, options: RunOptions, seeds: Collection[int], rows: Collection[Row] | None = None
) -> list[CellResult]:
    """Results of more cells of all methods of a suite, or of `rows` alone; interrupted cells are left out."""
    methods = [spec for spec in suite.narrowed(seeds=1).cells if brought_folder(spec.factory) is None]
    specs = [replace(spec, seed=seed) for seed in seeds for spec in methods]
    folders = {spec.capture: make_capture(spec.capture, options.data, workers=options.workers) for spec in specs}
    cells = [cell_for(spec, folders[spec.capture], options.out) for spec in specs]
    chosen = [cell for cell in cells if rows is None or (cell.config.place, cell.config.method) in rows]
    run_missing(chosen, suite, options)
    return [result for cell in chosen if (result := result_of(cell)) is not None]
