"""Claims: their file, what decides them, and the command."""

import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from helpers import cells

from ash.files import InputError
from benchmarks import cli
from benchmarks.analysis.claims import Claim, broken, judge, read_claims
from benchmarks.analysis.results import load
from benchmarks.cell.schema import Cell, result_of, write_config, write_result
from benchmarks.commands.arguments import FAILED
from benchmarks.report.claims import write_claims
from benchmarks.suites.archive import write_archive
from benchmarks.suites.files import find_suite, suite_files
from benchmarks.suites.runs import Run, read_run, write_run
from benchmarks.suites.suites import Suite

PAPER = {"view_psnr": ("novel_view", "psnr"), "pose_psnr": ("novel_pose", "psnr")}
PAPER |= {"view_lpips": ("novel_view", "lpips"), "pose_lpips": ("novel_pose", "lpips")}
PUBLISHED = {"double_texels": "res_512", "ash_plus": "ash"}  # what stands for a row of the paper


@pytest.fixture(scope="module")
def suites() -> dict[str, Suite]:
    """Ours by name; reading them takes seconds."""
    return {name: find_suite(name) for name in suite_files()}


def test_every_contrast_can_be_run_by_a_suite_of_ours(suites: dict[str, Suite]) -> None:
    rows = {
        (scene.name, method)
        for suite in suites.values()
        for scene in suite.scenes
        for method in (scene.methods or [row.name for row in suite.methods])
    }
    judged = [claim for claim in read_claims() if not claim.cannot]
    missing = [(c.name, s, m) for c in judged for s in c.scenes for m in (c.a, c.b) if (s, m) not in rows]
    assert len(judged) > 30 and missing == []


def test_published_differences_are_those_of_the_tables_beside_ours(suites: dict[str, Suite]) -> None:
    """`paper.toml` and `cameras.toml` have the paper's numbers."""
    given: dict[tuple[str, str], dict[str, float]] = {}
    for table in (*suites["paper"].table, *suites["cameras"].table):
        for row in (row for group in table.rows for row in group):
            given[table.scene, row.method] = given[table.scene, row.instead or row.method] = dict(row.given)
    checked = 0
    for claim in read_claims():
        for scene, difference in claim.paper.items():
            column = next(k for k, asked in PAPER.items() if asked == (claim.split, claim.metric))
            a, b = (given[scene, PUBLISHED.get(row, row.removesuffix("_6_min"))] for row in (claim.a, claim.b))
            expected = a[column] - b[column]
            assert difference == pytest.approx(expected, abs=0.015), claim.name
            checked += 1
    assert checked > 20


def rows(a: Sequence[float], b: Sequence[float]) -> pd.DataFrame:
    return load(cells.people({"ash": a, "ddc": b}))


CLAIM = Claim(name="n", says="s", where="w", a="ash", b="ddc", scenes=("loose",))


def verdict(claim: Claim, table: pd.DataFrame) -> str:
    (row,) = judge([claim], table).itertuples()
    return str(row.verdict)


BETTER, SAME, UNCLEAR = (30.0, 31.0, 32.1), (28.0, 29.01, 30.0), (30.0, 28.0, 31.5)
OTHER = (28.0, 29.0, 30.0)


@pytest.mark.parametrize(
    ("expect", "a", "found"),
    [
        ("better", BETTER, "confirmed"),
        ("better", SAME, "contradicted"),
        ("better", UNCLEAR, "not shown"),
        ("worse", BETTER, "contradicted"),
        ("equivalent", SAME, "confirmed"),
        ("equivalent", BETTER, "contradicted"),
        ("equivalent", UNCLEAR, "not shown"),
        ("not better", SAME, "confirmed"),
        ("not better", BETTER, "contradicted"),
        ("not worse", BETTER, "confirmed"),
        ("not worse", SAME, "confirmed"),
        ("not worse", (28.2, 29.5, 30.4), "confirmed"),  # Unclear which is better, but no loss that counts.
    ],
)
def test_a_contrast_decides(expect: str, a: Sequence[float], found: str) -> None:
    claim = replace(CLAIM, expect=expect)
    assert verdict(claim, rows(a, OTHER)) == found
    mirrored = {"better": "worse", "worse": "better", "not better": "not worse", "not worse": "not better"}
    turned = replace(CLAIM, a="ddc", b="ash", expect=mirrored.get(expect, expect))
    assert verdict(turned, rows(a, OTHER)) == found


def test_what_is_not_shown_says_how_many_people_would_decide() -> None:
    def needed(claim: Claim, a: Sequence[float]) -> float:
        return float(judge([claim], rows(a, OTHER)).needed.item())

    assert needed(CLAIM, UNCLEAR) > 3 and math.isnan(needed(CLAIM, BETTER)) and math.isnan(needed(CLAIM, SAME))
    wide = (29.0, 31.1, 32.2)  # Better, but not surely by a decibel and a half.
    assert needed(replace(CLAIM, least=1.5), wide) > needed(replace(CLAIM, least=1.0), wide) > 3


def test_a_published_difference_above_the_interval_makes_it_smaller() -> None:
    assert verdict(replace(CLAIM, paper={"loose": 7.4}), rows(BETTER, OTHER)) == "confirmed but smaller"
    other_way = replace(CLAIM, a="ddc", b="ash", expect="worse", paper={"loose": -2.0})
    assert verdict(other_way, rows(BETTER, OTHER)) == "confirmed"


def test_by_more_than_so_much_asks_for_the_whole_interval() -> None:
    claim = replace(CLAIM, least=1.5)
    assert verdict(claim, rows(BETTER, OTHER)) == "confirmed"
    wide = rows((29.0, 31.1, 32.2), OTHER)
    assert verdict(claim, wide) == "not shown" and verdict(replace(claim, least=None), wide) == "confirmed"


def test_trainings_that_ended_before_their_plateau_are_named() -> None:
    table = rows(BETTER, OTHER)
    ended = table.drop_duplicates(["method", "capture"]).assign(split="speed", region="", metric="plateau", value=1.0)
    assert judge([CLAIM], pd.concat([table, ended])).short_of_plateau.item() == ""
    short = ended.assign(value=(ended["method"] != "ash").astype(float))
    assert judge([CLAIM], pd.concat([table, short])).short_of_plateau.item() == "ASH"


def test_what_cannot_be_judged_says_why() -> None:
    told = [
        judge([CLAIM], table).because.item()
        for table in (
            rows((30.0,), (20.0,)),
            load(cells.people({"ash": BETTER})),
            load(cells.people({"ash": BETTER, "ddc": OTHER}, scene="tight")),
            rows(BETTER, OTHER).assign(status="crashed"),
            rows(BETTER, OTHER).assign(subject=100),
        )
    ]
    assert told == [
        "one person",
        "no row ddc",
        "no run of this scene",
        "3 cells of ash failed",
        "no run of this scene",
    ]


def test_p_is_corrected_over_all_claims() -> None:
    many = [replace(CLAIM, name=str(k)) for k in range(20)]
    table = rows((28.9, 30.3, 30.9), OTHER)  # p is 0.016
    assert judge([CLAIM], table).verdict.item() == "confirmed"
    assert set(judge(many, table).verdict) == {"not shown"}


def test_claims_that_are_run_later_take_no_verdict_away() -> None:
    others = [replace(CLAIM, name=str(k), a="mine") for k in range(20)]
    table = rows((28.9, 30.3, 30.9), OTHER)
    planned = judge([CLAIM, *others], table)
    assert planned["verdict"][0] == "not shown" and set(planned["verdict"][1:]) == {"cannot be judged here"}
    never = [replace(each, cannot="needs a GPU") for each in others]  # No test of these will be made.
    assert judge([CLAIM, *never], table)["verdict"][0] == "confirmed"


def test_a_claim_that_held_and_does_not_any_more_is_named() -> None:
    held, lost = (judge([CLAIM], rows(a, OTHER)) for a in (BETTER, SAME))
    assert broken(held, held) == [] and broken(lost, held) == []
    assert broken(held, lost) == ["n, loose: confirmed before, contradicted now"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected entries"),
        ('[[claim]]\nname = "n"\nsays = "s"\n', "'where' is missing"),
        ('[[claim]]\nname = "n"\nsays = "s"\nwhere = "w"\n', "expected a, b and scenes, or cannot"),
        ('[[claim]]\nname = "n"\nsays = "s"\nwhere = "w"\na = "x"\nb = "y"\nscenes = ["z"]\nmetric = "m"\n', "metric"),
        ('[[claim]]\nname = "n"\nsays = "s"\nwhere = "w"\nexpect = "good"\n', "expect"),
        (2 * '[[claim]]\nname = "n"\nsays = "s"\nwhere = "w"\ncannot = "c"\n', "two claims are called n"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "claims.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        read_claims(path)
    assert "\n" not in str(error.value)


@pytest.fixture
def two_people(finished: Path, tmp_path: Path) -> Run:
    """The finished run of the suite boxes, with its cells once more as those of another person."""
    run = read_run(finished)
    other = Path(shutil.copytree(run.cells[0].capture_folder, tmp_path / "other"))
    more = []
    for cell in run.cells:
        config = replace(cell.config, subject=1)
        folder = Path(shutil.copytree(cell.folder, tmp_path / "more" / config.key))
        result = result_of(cell)
        assert result is not None
        write_result(folder, replace(result, config=config))
        more.append(Cell(config=config, folder=folder, capture_folder=other))
    return replace(run, cells=(*run.cells, *more))


BOXES = """[[claim]]
name = "detail"
says = "more detail is more accurate"
where = "here"
a = "fake_good"
b = "fake_bad"
scenes = ["boxes"]
"""


def test_a_page_shows_what_was_judged(two_people: Run, tmp_path: Path) -> None:
    file = tmp_path / "claims.toml"
    file.write_text(BOXES.replace('["boxes"]', '["boxes", "loose", "tight"]'))
    page_of_row = {("boxes", "fake_bad"): tmp_path / "run" / "report.html"}
    lines, lost = write_claims(two_people, read_claims(file), tmp_path / "judged", reports=page_of_row)
    assert "confirmed 1" in lines[-1] and lost == []
    page = (tmp_path / "judged" / "claims.html").read_text()
    assert "the view of the median difference" in page and 'href="../run/report.html"' in page
    assert "80 % power" in page
    text = (tmp_path / "judged" / "claims.md").read_text()
    (row,) = (line for line in text.splitlines() if line.startswith("| detail | boxes | **confirmed** "))
    assert row.endswith("| run |") and "[Report of run](<../run/report.html>)" in text
    told = "- **detail.** More detail is more accurate (here). Not judged on loose and tight: no run of this scene."
    assert told in text


def part_of(run: Run, method: str, folder: Path, /, **other: str) -> Path:
    """A run of one row of another, perhaps trained in another way."""
    made = []
    for cell in (cell for cell in run.cells if cell.config.method == method):
        config, result = replace(cell.config, **other), result_of(cell)
        assert result is not None
        made.append(replace(cell, config=config, folder=folder / "cells" / config.key))
        write_config(made[-1])
        write_result(made[-1].folder, replace(result, config=config))
    write_run(replace(run, folder=folder, cells=tuple(made), absent=()))
    return folder


@pytest.mark.parametrize("other_way", [{"preset": "brief"}, {"code": "0123456789abcdef"}, {"capture": "rendered anew"}])
def test_rows_of_several_runs_are_compared_and_of_one_trained_in_two_ways_the_first(
    two_people: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], other_way: dict[str, str]
) -> None:
    file = tmp_path / "claims.toml"
    file.write_text(BOXES)
    good, bad = (part_of(two_people, f"fake_{name}", tmp_path / name) for name in ("good", "bad"))
    worse = part_of(two_people, "fake_bad", tmp_path / "worse", method="fake_good", **other_way)
    asked = ["--claims", str(file), "--out", str(tmp_path / "judged")]
    assert cli.main(["claims", str(good), str(bad), *asked]) == cli.DONE
    alone = capsys.readouterr().out
    assert "confirmed 1" in alone
    assert cli.main(["claims", str(good), str(bad), str(worse), *asked]) == cli.DONE
    printed = capsys.readouterr()
    assert printed.out == alone and "fake_good on boxes: 2 left out" in printed.err
    assert cli.main(["claims", str(worse), str(bad), str(good), *asked]) == cli.DONE
    printed = capsys.readouterr()
    assert "contradicted 1" in printed.out and "fake_good on boxes: 2 left out" in printed.err


def test_published_reports_are_judged_from_their_numbers(
    two_people: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "claims.toml"
    file.write_text(BOXES)
    published = []
    for name in ("good", "bad"):
        made = read_run(part_of(two_people, f"fake_{name}", tmp_path / "runs" / name))
        published.append(tmp_path / name / "cells.zip")
        write_archive(made, published[-1])
        (tmp_path / name / "report.md").write_text("# Report")
    asked = ["--claims", str(file), "--out", str(tmp_path / "judged")]
    assert cli.main(["claims", *map(str, published), *asked]) == cli.DONE
    assert "confirmed 1" in capsys.readouterr().out
    page = (tmp_path / "judged" / "claims.md").read_text()
    assert "[Report of good](<../good/report.md>)" in page and "../bad/report.md" in page


def test_the_command(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "claims.toml", tmp_path / "judged"
    file.write_text(BOXES)
    asked = ["claims", str(finished), "--claims", str(file), "--out", str(out)]
    assert cli.main(asked) == cli.DONE
    assert "cannot be judged here 1" in capsys.readouterr().out
    before = tmp_path / "before.csv"
    before.write_text((out / "claims.csv").read_text().replace("cannot be judged here", "confirmed"))
    assert cli.main([*asked, "--before", str(before)]) == FAILED
    told = "no longer holds: detail, boxes: confirmed before, cannot be judged here now"
    assert told in capsys.readouterr().err
    assert cli.main([*asked, "--before", str(file)]) == cli.WRONG_INPUT
    assert cli.main(["claims", str(finished), "--out", str(out)]) == cli.DONE
