"""Cells of methods that are fakes on the capture of boxes, and their run."""

import io
from collections.abc import Sequence
from pathlib import Path

from ash.fields import Changes
from benchmarks.cell.schema import Cell
from benchmarks.suites.engine import CellPlan, Limits, make_executor, plan_cells, run_cells
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import cell_for
from benchmarks.suites.suites import CaptureSpec, CellSpec

LIMITS = Limits(seconds=300.0, memory_mb=4096)


def fake_cell(method: str, capture: Path, out: Path, *, seed: int = 0, changes: Changes = ()) -> Cell:
    """A cell of the method `fake_METHOD`; nothing of it is written yet."""
    spec = CellSpec(
        capture=CaptureSpec(scene="boxes", size="ci"), method=f"fake_{method}", preset="ci", seed=seed, changes=changes
    )
    return cell_for(spec, capture, out)


def run(cells: Sequence[Cell], limits: Limits = LIMITS, *, gpus: tuple[str, ...] = ()) -> CellPlan:
    """Run the cells that have no result, all at a time, and return which these were."""
    plan = plan_cells(cells)
    progress = Progress("cells", len(plan.todo), expected_s=1.0, workers=1, stream=io.StringIO())
    with make_executor("local", workers=len(cells)) as executor:
        run_cells(plan, executor, limits, progress, gpus=gpus)
    return plan
