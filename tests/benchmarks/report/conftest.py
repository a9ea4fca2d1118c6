"""A finished run to report."""

import io

import pytest
from helpers import fakes

from benchmarks.report.page import write_report
from benchmarks.suites.engine import Limits, make_executor, plan_cells, run_cells
from benchmarks.suites.progress import Progress
from benchmarks.suites.runs import Run, cell_for, write_run
from benchmarks.suites.suites import CaptureSpec, CellSpec


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A finished run of fake methods, one of which fails."""
    folder = tmp_path_factory.mktemp("report")
    capture = fakes.write_capture(folder / "capture")
    out, spec = folder / "run", CaptureSpec(scene="boxes", size="ci")
    with pytest.MonkeyPatch.context() as patch:
        fakes.use(folder / "plugins", patch)
        names = ("fake_good", "fake_bad", "fake_nan")
        specs = [CellSpec(capture=spec, method=name, preset="ci", seed=0) for name in names]
        cells = tuple(cell_for(cell, capture, out) for cell in specs)
        found = Run(folder=out, suite="fakes", about="boxes", command="ash-bench run fakes", cells=cells)
        write_run(found)
        plan = plan_cells(cells)
        progress = Progress("cells", 3, expected_s=1.0, workers=2, stream=io.StringIO())
        with make_executor("local", workers=2) as executor:
            run_cells(plan, executor, Limits(seconds=60.0, memory_mb=4096), progress)
        write_report(found)
    return found
