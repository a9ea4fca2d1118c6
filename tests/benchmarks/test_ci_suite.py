"""The suite `ci`, for real: a capture is rendered, methods are trained, and the numbers are those of working parts."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import cli
from benchmarks.analysis.results import Quantity, RunTables, foreground, read_csv
from benchmarks.cell import metrics
from benchmarks.cell.schema import CellResult
from benchmarks.suites.files import find_suite
from benchmarks.suites.runs import read_run, results_of


@pytest.fixture(scope="module")
def run(ci_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suite's run, with LPIPS."""
    out = tmp_path_factory.mktemp("ci")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(metrics.LPIPS_WEIGHTS)
        assert cli.main(["run", "ci", "--out", str(out), "--data", str(ci_data)]) == cli.DONE
    return out


@pytest.fixture(scope="module")
def results(run: Path) -> list[CellResult]:
    assert (run / "report.html").stat().st_size > 100_000
    assert (run / "worst_mannequin.webp").exists()
    assert "of the squared error on" in (run / "report.md").read_text()
    assert (run / "report.md").read_text().count("given the exact surface") == 2, "below the chart and below the table"
    return results_of(read_run(run))


@pytest.fixture(scope="module")
def tables(results: list[CellResult]) -> RunTables:
    return RunTables(results)


def test_every_method_of_the_suite_came_through(tables: RunTables, run: Path) -> None:
    assert tables.methods("mannequin") == tuple(method.name for method in find_suite("ci").methods)
    assert set(tables.rows["status"]) == {"done"} == set(read_csv(run / "results.csv")["status"])


HELD_OUT = ("novel_view", "novel_pose")


@pytest.mark.parametrize(
    ("method", "splits", "least_psnr", "least_iou"),
    [
        # Colours that depend on the view are learned from four cameras: they hold for these alone.
        ("ash", ("train_view",), 18.5, 0.92),
        ("ash_truth", ("train_view",), 19.0, 0.93),
        ("ash_plus", HELD_OUT, 18.3, 0.92),
        ("ddc_plus", HELD_OUT, 20.5, 0.93),
        ("ddc_truth", HELD_OUT, 19.0, 0.955),
    ],
)
def test_quality_is_what_working_parts_reach(
    tables: RunTables, method: str, splits: tuple[str, ...], least_psnr: float, least_iou: float
) -> None:
    for split in splits:
        require_quality(tables, method, split, least_psnr, least_iou)


def require_quality(tables: RunTables, method: str, split: str, least_psnr: float, least_iou: float) -> None:
    asked = foreground(split), Quantity(split, "full", "iou")
    psnr, iou = (tables.get("mannequin", method, quantity) for quantity in asked)
    assert psnr is not None and psnr.value > least_psnr
    assert iou is not None and iou.value > least_iou


def test_lpips_is_measured_where_its_weights_are(tables: RunTables, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(metrics.LPIPS_WEIGHTS)
    if metrics.weights_file() is None:
        pytest.skip("no weights for LPIPS here")
    for method in tables.methods("mannequin"):
        value = tables.get("mannequin", method, Quantity("novel_view", "full", "lpips"))
        assert value is not None and 1 < value.value < 400


def test_an_oracle_has_no_template_error_and_the_others_have_an_honest_one(tables: RunTables) -> None:
    errors = {
        m: tables.get("mannequin", m, Quantity("novel_pose", "", "template_mm")) for m in tables.methods("mannequin")
    }
    assert errors["ash_truth"].value < 0.01 and errors["ddc_truth"].value < 0.01
    assert 1 < errors["ash"].value < 30


def test_every_stage_is_timed_and_they_add_up_to_the_frame(results: list[CellResult]) -> None:
    for timing in (result.timing for result in results):
        assert timing is not None and list(timing.stage_ms) == [f"stg{i}" for i in range(1, 5)]
        frames = np.asarray(timing.frame_ms)
        shares = np.sum(list(timing.stage_ms.values()), axis=0) / frames
        assert (shares <= 1).all() and np.median(shares) > 0.8
