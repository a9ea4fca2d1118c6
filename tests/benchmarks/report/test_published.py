"""What is published under reports/: its front page has the numbers of its csv files and says whose code made them."""

import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from helpers.cells import people

from ash.files import InputError
from benchmarks import cli
from benchmarks.analysis.claims import read_claims
from benchmarks.analysis.results import csv_of, load
from benchmarks.analysis.style import style_of
from benchmarks.cell.registry import code_version
from benchmarks.report.published import FOLDER, NAME, Numbers, read_me
from benchmarks.suites.archive import without_places


def test_the_front_page_has_the_numbers_of_the_reports() -> None:
    assert read_me() == (FOLDER / NAME).read_text(), "`python -m benchmarks.report.published` writes it anew"


def test_the_readme_has_the_numbers_of_the_reports() -> None:
    text, numbers = " ".join((FOLDER.parent / "README.md").read_text().split()), Numbers(FOLDER)
    outfits, splits = ("loose", "tight"), ("novel_view", "novel_pose")
    for a, b in (("ash", "ddc"), ("ash", "wo_mot"), ("ash_plus", "ash"), ("ash_plus", "ddc_plus")):
        cells = [numbers.difference("table", scene, a, b, split) for scene in outfits for split in splits]
        row = " | ".join((f"{style_of(a).title} - {style_of(b).title}", *(cell.replace(" dB", "") for cell in cells)))
        assert f"| {row} |" in text
    for changed in ("ash_truth", "smpl", "wo_disp"):
        assert numbers.difference("table", "loose", changed, "ash") in text
    assert numbers.difference("budget", "loose", "ash", "ddc") in text
    assert numbers.difference("factors", "turning", "plus_heading", "ash", "novel_pose") in text


def test_the_readme_has_the_scores_of_the_main_job() -> None:
    text, numbers = (FOLDER.parent / "README.md").read_text(), Numbers(FOLDER)
    splits = ("novel_view", "near_pose", "novel_pose", "far_pose")
    quantities = [(split, metric) for split in splits for metric in ("psnr", "lpips")]
    quantities += [("speed", "frame_ms"), ("speed", "train_s")]
    for method in ("ash", "ddc", "wo_mot", "ash_plus", "ddc_plus"):
        cells = [numbers.score("quick", "loose", method, *quantity) for quantity in quantities]
        assert "n/a" not in cells
        row = " +".join(map(re.escape, (style_of(method).title, *cells)))
        assert re.search(f"^{row}$", text, re.MULTILINE), method


def test_the_claims_are_judged_by_the_numbers_of_the_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the command that stands on their page, but for where it writes."""
    monkeypatch.chdir(FOLDER.parent)
    page = (FOLDER / "claims" / "claims.md").read_text()
    again = re.search(r"^    \S+ (claims .*) --out reports/claims$", page, re.MULTILINE)
    assert again is not None
    assert cli.main([*again[1].split(), "--out", str(tmp_path)]) == cli.DONE
    assert (tmp_path / "claims.csv").read_text() == (FOLDER / "claims" / "claims.csv").read_text()


def test_every_claim_that_does_not_hold_names_an_experiment() -> None:
    table = pd.read_csv(FOLDER / "claims" / "claims.csv")
    named = {claim.name for claim in read_claims() if claim.experiment}
    assert set(table.loc[table["verdict"].isin(("not shown", "contradicted")), "name"]) <= named


def test_every_report_is_on_the_front_page() -> None:
    text = (FOLDER / NAME).read_text()
    for path in FOLDER.iterdir():
        assert f"({path.name}" in text or path.name.startswith(NAME) or path.name == "baseline", path


def test_no_page_names_a_folder_of_the_machine_that_made_it() -> None:
    for path in FOLDER.rglob("*.md"):
        assert without_places(path.read_text()) == path.read_text(), path


@pytest.fixture
def numbers(tmp_path: Path) -> Numbers:
    (tmp_path / "mine").mkdir()
    made = load(people({"ash": (25.0, 27.0, 29.0), "ddc": (24.0, 25.0, 29.0)}))
    (tmp_path / "mine" / "results.csv").write_text(csv_of(made))
    return Numbers(tmp_path)


def test_numbers_are_those_of_the_csv(numbers: Numbers) -> None:
    assert numbers.score("mine", "loose", "ash") == "27.00"
    assert numbers.score("mine", "loose", "wo_mot") == "n/a"
    assert numbers.difference("mine", "loose", "ash", "ddc") == "+1.00 dB [-1.48, +3.48]"  # t(2) is 4.30
    assert "| loose: ASH | 27.00 | n/a |" in numbers.scores("mine", "loose")


def test_scores_are_of_rows_that_ran_on_everybody(numbers: Numbers) -> None:
    (numbers.folder / "fewer").mkdir()
    made = load(people({"ash": (25.0, 27.0, 29.0), "smpl": (24.0, 25.0)}))
    (numbers.folder / "fewer" / "results.csv").write_text(csv_of(made))
    text = numbers.scores("fewer", "loose")
    assert "| loose: ASH | 27.00 |" in text and "24.50" not in text
    assert numbers.people("fewer", "loose") == 3 and numbers.people("fewer", "loose", "smpl") == 2


def test_what_a_defect_costs_is_in_pairs_over_people(numbers: Numbers) -> None:
    (numbers.folder / "defects").mkdir()
    worse = [
        replace(each, config=replace(each.config, axis="lens", severity=12.0))
        for each in people({"ash": (23.0, 25.0, 28.0)})
    ]
    made = load([*people({"ash": (25.0, 27.0, 29.0)}), *worse])
    (numbers.folder / "defects" / "results.csv").write_text(csv_of(made))
    assert numbers.loss("defects", "loose", "ash", "lens", 12) == "+1.67 dB [+0.23, +3.10]"  # t(2) is 4.30
    with pytest.raises(InputError, match="expected ash on loose with lens=6"):
        numbers.loss("defects", "loose", "ash", "lens", 6)


def test_what_scenes_need_is_beside_the_scene_without_their_phenomenon(numbers: Numbers) -> None:
    (numbers.folder / "factors").mkdir()
    ash = (27.0, 29.0, 31.0)
    found = {"wrinkles": (25.0, 27.1, 28.9), "wrinkles_twice": (24.0, 26.1, 27.9), "skinned": (26.8, 28.1, 31.2)}
    results = [
        each
        for scene, without in found.items()
        for each in people({"ash": ash, "wo_disp": without, "window_1": without}, scene=scene)
    ]
    (numbers.folder / "factors" / "results.csv").write_text(csv_of(load(results)))
    lines = [[cell.strip() for cell in line.split("|")] for line in numbers.needs("factors").splitlines()[2:]]
    assert [line[1:4] for line in lines] == [
        ["w/o disp.", "wrinkles", "3"],
        ["w/o disp.", "skinned", "3"],
    ]  # One frame of motion is not what wrinkles should need.
    assert lines[0][4].endswith("+2.00 dB [+1.75, +2.25]: needed")
    assert lines[1][4].startswith("+0.30 dB [") and lines[1][4].endswith(" people would decide")
    assert lines[0][5].startswith("+1.70 dB [") and lines[1][5] == ""
    own, twice = numbers.strengths("factors", "wrinkles", "wo_disp").split(" at 1, ")
    assert own.startswith("+1.70 dB [") and twice.startswith("+2.70 dB [") and twice.endswith("] at 2")
    with pytest.raises(InputError, match="expected rows ash and wo_mot on wrinkles"):
        numbers.strengths("factors", "wrinkles", "wo_mot")


def test_rows_of_two_reports_are_compared(numbers: Numbers) -> None:
    (numbers.folder / "other").mkdir()
    (numbers.folder / "other" / "results.csv").write_text(csv_of(load(people({"smpl": (23.0, 25.0, 27.0)}))))
    assert numbers.difference("mine+other", "loose", "smpl", "ash") == "-2.00 dB [-2.00, -2.00]"


@pytest.fixture
def claims(numbers: Numbers) -> Numbers:
    (numbers.folder / "claims").mkdir()
    (numbers.folder / "claims" / "claims.csv").write_text(
        "name,scene,contrast,paper,effect,low,high,people,unit,verdict,needed\n"
        "1 views,tight,ash - ddc,4.63,-0.7,-1.1,-0.3,5,dB,not shown,8\n"
        "1 views,loose,ash - ddc,,1.2,0.6,1.8,5,dB,confirmed,\n"
        "2 speed,,ash - ddc,,,,,0,ms,cannot be judged here,\n"
        "3 light,lit,wo_phi - ash,,-0.4,-0.5,-0.3,3,dB,confirmed,\n"
        "README: motion,tight,ash_plus - ash,,1.2,0.6,1.8,5,dB,confirmed,\n"
        "README: motion,loose,ash_plus - ash,,0.1,-0.6,0.8,5,dB,not shown,40\n"
        "README: mesh,tight,ddc_plus - ddc,,0.1,-0.6,0.8,5,dB,not shown,40\n"
        "README: mesh,loose,ddc_plus - ddc,,0.1,-0.6,0.8,5,dB,not shown,40\n"
    )
    return numbers


def test_a_claim_of_the_paper_is_a_row_with_a_column_for_each_outfit_and_one_for_other_scenes(claims: Numbers) -> None:
    assert claims.claims().splitlines() == [
        "| claim | contrast | tight | loose | other scenes |",
        "| --- | --- | --- | --- | --- |",
        "| 1 views | ash - ddc | not shown: -0.7 dB [-1.1, -0.3], paper +4.63 dB, 5 people, 8 needed "
        "| confirmed: +1.2 dB [+0.6, +1.8], 5 people |  |",
        "| 3 light | wo_phi - ash |  |  | lit: confirmed: -0.4 dB [-0.5, -0.3], 3 people |",
    ]


def test_own_claims_are_counted_and_those_that_do_not_hold_named(claims: Numbers) -> None:
    assert claims.own_claims() == "1 confirmed, 3 not shown (motion (loose); mesh (tight and loose))"


def test_the_order_of_rows_is_compared_with_the_paper_s(numbers: Numbers) -> None:
    """From the worst, the paper has TAVA, DDC, ASH: one person swaps the first two, one has a tie: 1/3, 1 and 0.816."""
    with pytest.raises(InputError, match="expected three rows of the paper on one person in loose"):
        numbers.order("mine", "loose", "novel_view", "psnr")
    (numbers.folder / "other").mkdir()
    (numbers.folder / "other" / "results.csv").write_text(csv_of(load(people({"tava": (24.5, 24.0, 27.0)}))))
    assert numbers.order("mine+other", "loose", "novel_view", "psnr") == "+0.72 [-0.14, +1.00]"


def test_rows_that_did_not_run_and_other_protocols_are_refused(numbers: Numbers) -> None:
    with pytest.raises(InputError, match="expected rows ash and wo_mot on loose"):
        numbers.difference("mine", "loose", "ash", "wo_mot")
    path = numbers.folder / "mine" / "results.csv"
    path.write_text(path.read_text().replace(",3,0,", ",2,0,"))
    with pytest.raises(InputError, match="expected results of protocol 3"):
        Numbers(numbers.folder).score("mine", "loose", "ash")


@pytest.mark.parametrize(
    ("code", "expected"), [("0123", "stale, abc"), (None, "current"), ("0123, 4567", "stale, abc")]
)
def test_a_report_of_other_code_is_stale(numbers: Numbers, code: str | None, expected: str) -> None:
    facts = f"| commit | abc |\n| code | {code or code_version('ash')} |\n"
    (numbers.folder / "mine" / "report.md").write_text(facts)
    assert numbers.state("mine") == expected
