"""Our rows beside the paper's, and the agreement of the two orders."""

import math
import tomllib

import pytest
from helpers.cells import cell, config

from benchmarks.analysis import paper
from benchmarks.analysis.results import RunTables
from benchmarks.cell.registry import offered
from benchmarks.cell.schema import CellResult, Summary
from benchmarks.report.content import Table, Text
from benchmarks.report.sections import PAPER_SUITES, beside_the_paper
from benchmarks.suites.files import find_suite, suite_file
from benchmarks.suites.tables import TableSpec, tables_of


def run(levels: dict[str, float], seeds: int = 3) -> RunTables:
    return RunTables([cell(m, level + 0.1 * seed, seed=seed) for m, level in levels.items() for seed in range(seeds)])


def specs() -> list[TableSpec]:
    files = [suite_file(name) for name in PAPER_SUITES]
    return [spec for path in files for spec in tables_of(tomllib.loads(path.read_text())["table"], place=path.name)]


def test_the_papers_numbers_are_the_papers() -> None:
    comparison = {row.title: row.given for row in specs()[1].rows[0]}
    assert comparison["ASH"]["view_psnr"] - comparison["DDC"]["view_psnr"] == pytest.approx(7.37)  # "7.4 dB" there
    assert [len(spec.rows[0]) for spec in specs()] == [5, 5, 5, 2, 2, 4]


def test_a_table_needs_two_of_its_methods() -> None:
    (section,) = beside_the_paper(run({"wo_disp": 20.0, "ash": 24.0}), "table")
    assert sum(isinstance(block, Table) for block in section.blocks) == 1
    assert beside_the_paper(run({"ash": 24.0}), "table") == []


def test_methods_that_were_not_run_are_not_made_up() -> None:
    (section,) = beside_the_paper(run({"ash": 24.0, "ddc": 22.0}, seeds=1), "table")
    table = section.blocks[0]
    assert isinstance(table, Table)
    assert table.frame.loc["TAVA"].tolist() == ["27.31", "37.55", "26.31", "50.11", *["n/a"] * 5]
    assert table.frame.loc["ASH"].tolist()[4:6] == ["24.00", "n/a"], "no weights for LPIPS"


def test_the_papers_static_row_is_compared_with_ours_of_as_few_frames_or_it_is_said() -> None:
    def components(levels: dict[str, float]) -> tuple[str, bool]:
        (section,) = beside_the_paper(run(levels), "table")
        table, caption = section.blocks[:2]
        assert isinstance(table, Table) and isinstance(caption, Text) and "components (Table 3)" in caption.text
        return str(table.frame.iloc[0, 4]), "ours saw all frames, the paper's 40 s of footage" in caption.text

    text, said = components({"wo_mot": 30.0, "wo_mot_truncated": 20.0, "ash": 24.0})
    assert text.startswith("20.10") and not said
    text, said = components({"wo_mot": 30.0, "ash": 24.0})
    assert text.startswith("30.10") and said
    assert components({"wo_disp": 20.0, "ash": 24.0}) == ("n/a", False), "neither was run"


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


def test_the_suites_of_the_paper_have_all_of_its_rows_that_we_have() -> None:
    ours = {row.method for spec in specs() for row in spec.rows[0]} - {""}
    assert ours <= {row.name for row in find_suite("paper").methods}
