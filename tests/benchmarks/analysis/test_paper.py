"""Our rows beside the paper's, and the agreement of the two orders."""

import itertools
import math

import pytest
from helpers.cells import cell, config, people

from benchmarks.analysis import paper
from benchmarks.analysis.results import RunTables, foreground
from benchmarks.cell.registry import offered
from benchmarks.cell.schema import CellResult, Summary
from benchmarks.report.content import Table, Text
from benchmarks.report.sections import beside_the_paper
from benchmarks.suites.files import find_suite


def run(levels: dict[str, float], seeds: int = 3) -> RunTables:
    return RunTables([cell(m, level + 0.1 * seed, seed=seed) for m, level in levels.items() for seed in range(seeds)])


def test_the_papers_numbers_are_the_papers() -> None:
    tables = paper.paper_tables()
    comparison = {row.title: row.given for row in tables[1].rows[0]}
    assert comparison["ASH"]["view_psnr"] - comparison["DDC"]["view_psnr"] == pytest.approx(7.37)  # "7.4 dB" there
    assert [len(spec.rows[0]) for spec in tables] == [5, 5, 5, 2, 2, 4]


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


def test_orders_are_compared_on_each_person() -> None:
    given = {"ash": 4.0, "ddc": 3.0, "tava": 2.0, "hdhumans": 1.0}
    same, swapped = [30.0, 28.0, 26.0, 24.0], [28.0, 30.0, 26.0, 24.0]  # one of six pairs
    rows = RunTables(people(dict(zip(given, zip(same, swapped, same, strict=True), strict=True)))).of("loose")
    found = paper.order_agreement(rows, given, foreground())
    assert found is not None and (found.rows, found.people) == (4, 3)
    taus = [1.0, 4 / 6, 1.0]
    assert found.tau.mean == pytest.approx(sum(taus) / 3)
    assert found.tau.low == pytest.approx(8 / 9 - 4.30265 * 0.19245 / math.sqrt(3), abs=1e-4)
    assert found.tau.high == 1.0, "no order agrees better"
    assert found.chance == pytest.approx(1 / math.factorial(4)), "the means stand in the given order"
    assert found.tau_text == "+0.89 [+0.41, +1.00]"


def test_two_rows_are_no_order_and_equal_orders_have_no_interval() -> None:
    levels = {"ash": [30.0, 31.0], "ddc": [28.0, 29.0], "tava": [26.0, 27.0]}
    rows = RunTables(people(levels)).of("loose")
    found = paper.order_agreement(rows, dict(zip(levels, (1.0, 2.0, 3.0), strict=True)), foreground())
    assert found is not None and found.tau_text == "-1.00" and found.chance == 1.0
    assert paper.order_agreement(rows, {"ash": 1.0, "ddc": 2.0}, foreground()) is None
    assert paper.order_agreement(rows.head(0), {"ash": 1.0, "ddc": 2.0}, foreground()) is None


def test_chance_is_the_share_of_all_orders() -> None:
    given = {"ash": 1.0, "ddc": 2.0, "tava": 3.0, "hdhumans": 4.0, "neural_actor": 5.0}
    ours = dict(zip(given, ([1.0], [3.0], [2.0], [5.0], [4.0]), strict=True))
    found = paper.order_agreement(RunTables(people(ours)).of("loose"), given, foreground())
    swapped = [sum(a > b for a, b in itertools.combinations(order, 2)) for order in itertools.permutations(range(5))]
    assert found is not None and found.chance == pytest.approx(sum(n <= 2 for n in swapped) / 120)
    assert found.tau.mean == pytest.approx(1 - 2 * 2 / 10)


def test_the_report_prints_the_order_of_the_papers_rows() -> None:
    (section,) = beside_the_paper(run({"ash": 24.0, "ddc": 22.0, "tava": 20.0}), "table")
    _, _, order = (block for block in section.blocks if isinstance(block, Table) or block is section.blocks[1])
    assert isinstance(order, Table) and order.title == "The order of rows"
    assert order.frame.loc["Paper, seen motion: PSNR"].tolist() == ["+1.00", "3", "1", "17%"]
    assert "Paper, seen motion: LPIPS" not in order.frame.index, "no weights for LPIPS"


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
    ours = {row.method for spec in paper.paper_tables() for row in spec.rows[0]} - {""}
    assert ours <= {row.name for row in find_suite("paper").methods}
