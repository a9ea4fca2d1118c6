"""Our rows beside the paper's, and the agreement of the two orders."""

import pytest
from helpers.cells import cell

from benchmarks.analysis import paper
from benchmarks.analysis.scores import Scores, scores_of
from benchmarks.cell.methods import offered
from benchmarks.report.content import Bullets, Table
from benchmarks.report.sections import beside_the_paper
from benchmarks.suites.files import find_suite


def run(levels: dict[str, float], seeds: int = 3) -> Scores:
    return scores_of([cell(m, level + 0.1 * seed, seed=seed) for m, level in levels.items() for seed in range(seeds)])


def test_the_papers_numbers_are_the_papers() -> None:
    comparison = {row.title: row for row in paper.PAPER_TABLES[1].rows}
    assert comparison["ASH"].view[0] - comparison["DDC"].view[0] == pytest.approx(7.37)  # "7.4 dB" in the text
    assert [len(table.rows) for table in paper.PAPER_TABLES] == [5, 5, 5, 5, 2]


def test_the_same_order_agrees_and_the_opposite_does_not() -> None:
    like = {"wo_mot": 20.0, "wo_disp": 21.0, "res_128": 22.0, "res_512": 23.0, "ash": 24.0}
    (view, _) = next(found for table, found in paper.tables_beside(run(like)) if "components" in table.title)
    assert (view.tau, view.low, view.high, view.methods) == (1.0, 1.0, 1.0, 5)
    against = dict(zip(like, reversed(like.values()), strict=True))
    (view, _) = next(found for table, found in paper.tables_beside(run(against)) if "components" in table.title)
    assert view.tau == -1.0


def test_orders_within_the_spread_of_seeds_leave_a_wide_interval() -> None:
    close = {"wo_mot": 20.0, "wo_disp": 20.05, "res_128": 20.0, "res_512": 20.02, "ash": 20.04}
    view = paper.tables_beside(run(close))[0][1][0]
    assert view.low is not None and view.high is not None and view.high - view.low > 0.5


def test_methods_that_were_not_run_are_not_made_up() -> None:
    scores = run({"ash": 24.0, "ddc": 22.0}, seeds=1)
    (section,) = beside_the_paper(scores, "table")
    table, told = section.blocks[:2]
    assert isinstance(table, Table) and isinstance(told, Bullets)
    rows = {row.name: [entry.whole for entry in row.entries] for row in table.rows}
    assert rows["TAVA"] == ["27.31", "37.55", "26.31", "50.11", *["n/a"] * 7]
    assert rows["ASH"][4] == "24.00" and rows["ASH"][6] == "n/a"  # no weights for LPIPS
    assert paper.tables_beside(scores)[0][1][0].low is None
    assert paper.tables_beside(run({"ash": 24.0})) == ()
    assert told.items[0] == "Kendall's tau, novel view: +1.00 over 2 methods"


def components(levels: dict[str, float]) -> tuple[Table, tuple[str, ...]]:
    """The ablation of components as it is printed, and what is told below it."""
    (section,) = beside_the_paper(run(levels), "table")
    at = next(i for i, block in enumerate(section.blocks) if isinstance(block, Table) and "components" in block.title)
    table, told = section.blocks[at : at + 2]
    assert isinstance(table, Table) and isinstance(told, Bullets)
    return table, told.items


def test_the_papers_static_row_is_compared_with_ours_of_as_few_frames() -> None:
    table, told = components({"wo_mot": 30.0, "wo_mot_truncated": 20.0, "ash": 24.0})
    assert table.rows[0].name == "w/o mot." and table.rows[0].entries[4].text == "20.10"
    assert [item.rpartition(": ")[2][:5] for item in told] == ["+1.00", "+1.00"], "the order of the row of few frames"


def test_where_ours_saw_all_frames_it_is_compared_and_that_is_said() -> None:
    table, told = components({"wo_mot": 30.0, "ash": 24.0})
    assert table.rows[0].entries[4].text == "30.10" and told[0].startswith("Kendall's tau, novel view: -1.00")
    assert told[2:] == ("w/o mot.: ours saw all frames, the paper's 1,000 of 27,000 frames.",)
    assert not any("saw all" in item for item in components({"wo_disp": 20.0, "ash": 24.0})[1]), "neither was run"


@pytest.mark.parametrize("method", paper.SEEN)
def test_rows_on_a_part_of_the_views_train_on_the_papers_share(method: str) -> None:
    part, whole, what = paper.SEEN[method].replace(",", "").replace(" of ", " ").split()
    shares = {"cameras": "camera_share", "frames": "frame_share"}
    training = offered(method, "paper").training
    assert {name: getattr(training, share) for name, share in shares.items()} == {
        name: int(part) / int(whole) if name == what else 1.0 for name in shares
    }


def test_the_suite_of_the_paper_has_all_of_its_rows_that_we_have() -> None:
    ours = {row.method for table in paper.PAPER_TABLES for row in table.rows} - {None}
    assert ours <= {row.name for row in find_suite("paper").methods}
