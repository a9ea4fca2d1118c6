"""Our rows beside the paper's, and the agreement of the two orders."""

import math

import pytest
from helpers.cells import cell, config

from benchmarks.analysis import paper
from benchmarks.analysis.results import RunTables
from benchmarks.cell.registry import offered
from benchmarks.cell.schema import CellResult, Summary
from benchmarks.report.content import Bullets, Table
from benchmarks.report.sections import beside_the_paper
from benchmarks.suites.files import find_suite


def run(levels: dict[str, float], seeds: int = 3) -> RunTables:
    return RunTables([cell(m, level + 0.1 * seed, seed=seed) for m, level in levels.items() for seed in range(seeds)])


def test_the_papers_numbers_are_the_papers() -> None:
    comparison = {row.title: row for row in paper.PAPER_TABLES[1].rows}
    assert comparison["ASH"].view[0] - comparison["DDC"].view[0] == pytest.approx(7.37)  # "7.4 dB" in the text
    assert [len(table.rows) for table in paper.PAPER_TABLES] == [5, 5, 5, 2, 4, 2]


def test_a_table_needs_two_of_its_methods() -> None:
    assert [table.title for table in paper.tables_beside(run({"wo_disp": 20.0, "ash": 24.0}))] == [
        "Ablation of components (Table 3)"
    ]
    assert paper.tables_beside(run({"ash": 24.0})) == ()


def test_methods_that_were_not_run_are_not_made_up() -> None:
    (section,) = beside_the_paper(run({"ash": 24.0, "ddc": 22.0}, seeds=1), "table")
    table = section.blocks[0]
    assert isinstance(table, Table)
    assert table.frame.loc["TAVA"].tolist() == ["27.31", "37.55", "26.31", "50.11", *["n/a"] * 5]
    assert table.frame.loc["ASH"].tolist()[4:6] == ["24.00", "n/a"], "no weights for LPIPS"


def components(levels: dict[str, float]) -> tuple[Table, tuple[str, ...]]:
    """The ablation of components as it is printed, and the notes below it."""
    (section,) = beside_the_paper(run(levels), "table")
    at = next(i for i, block in enumerate(section.blocks) if isinstance(block, Table) and "components" in block.title)
    table, below = section.blocks[at : at + 2]
    assert isinstance(table, Table)
    return table, below.items if isinstance(below, Bullets) else ()


def test_the_papers_static_row_is_compared_with_ours_of_as_few_frames_or_it_is_said() -> None:
    table, notes = components({"wo_mot": 30.0, "wo_mot_truncated": 20.0, "ash": 24.0})
    assert table.frame.iloc[0, 4].startswith("20.10") and notes == ()
    table, notes = components({"wo_mot": 30.0, "ash": 24.0})
    assert table.frame.iloc[0, 4].startswith("30.10")
    assert notes == ("w/o mot.: ours saw all frames, the paper's 40 s of footage.",)
    assert components({"wo_disp": 20.0, "ash": 24.0})[1] == (), "neither was run"


def test_conventions_score_the_same_renders_and_leave_oracles_out() -> None:
    def scored(method: str, values: tuple[float, ...]) -> CellResult:
        rows = [
            Summary(split="novel_view", region=region, metric="psnr", value=value)
            for region, value in zip(paper.CONVENTIONS, values, strict=True)
        ]
        return CellResult(config=config(method, 0), status="done", summary=tuple(rows))

    results = [
        scored("ash", (27.0, 30.0, 25.0, 36.0)),
        scored("ddc", (25.0, 31.0, 24.0, 37.0)),
        scored("mlp", (24.0, 28.0, 26.0, 35.0)),
        scored("ash_truth", (40.0, 40.0, 40.0, 40.0)),
    ]
    found = paper.conventions(RunTables(results), "loose", "novel_view", "psnr")
    assert found is not None and list(found.index) == ["ash", "ddc", "mlp"]
    assert found.loc["ddc"].tolist() == [25.0, 31.0, 24.0, 37.0]
    assert paper.conventions(RunTables(results[:1]), "loose", "novel_view", "psnr") is None


@pytest.mark.parametrize("method", paper.SEEN)
def test_rows_on_a_part_of_the_views_train_on_the_papers_share(method: str) -> None:
    training = offered(method, "paper").training
    if method == "wo_mot_truncated":
        assert paper.SEEN[method] == f"{training.footage_s:.0f} s of footage" and training.camera_share == 1
    else:
        part, whole = paper.SEEN[method].removesuffix(" cameras").split(" of ")
        assert training.camera_share == int(part) / int(whole) and training.footage_s == math.inf


def test_the_suite_of_the_paper_has_all_of_its_rows_that_we_have() -> None:
    ours = {row.method for table in paper.PAPER_TABLES for row in table.rows} - {None}
    assert ours <= {row.name for row in find_suite("paper").methods}
