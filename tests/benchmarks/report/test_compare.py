"""Before and after: two runs side by side."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from helpers.browser import DESKTOP, PHONE, Visitor
from helpers.cells import cell, people
from helpers.waiting import wait_for

from ash.capture.formats import load_capture
from ash.capture.manifest import read_manifest
from ash.files import InputError
from benchmarks import cli
from benchmarks.cell.schema import Cell, CellResult, result_of, write_config, write_result
from benchmarks.commands import arguments
from benchmarks.report.compare import changes, failures_in_words, printed, verdict_of, write_comparison
from benchmarks.suites.archive import opened, write_archive
from benchmarks.suites.captures import SHOWS_THE_SAME, truth_of
from benchmarks.suites.runs import Run, commands_of, gathered, read_run, results_of, write_run

Rows = dict[tuple[str, str], list[tuple[Cell, CellResult]]]


def row(*psnr: float, method: str = "ash") -> Rows:
    results = [cell(method, value, seed=seed) for seed, value in enumerate(psnr)]
    return {("loose", method): [(Cell(config=r.config, folder=Path()), r) for r in results]}


def views(before: Rows, after: Rows) -> pd.Series:
    return changes(before, after).set_index("what").loc["PSNR, novel views"]


def test_verdicts_are_on_the_run_after() -> None:
    better = views(row(30.0, 30.1, 30.2), row(31.0, 31.1, 31.2))
    assert better.verdict == "better" and better.change == pytest.approx(1.0) and 0 < better.low < 1.0 < better.high
    assert views(row(31.0, 31.1, 31.2), row(30.0, 30.1, 30.2)).verdict == "worse"
    assert views(row(30.0, 30.1, 30.2), row(30.1, 30.0, 30.25)).verdict == "unclear"


def test_one_seed_and_a_missing_row_have_no_verdict() -> None:
    assert views(row(30.0), row(35.0)).verdict == ""
    alone = changes(row(30.0), row(30.0, method="ddc"))
    assert set(alone["verdict"]) == {""} and "n/a" in printed(alone)["after"].tolist()


def test_means_are_of_the_people_that_both_runs_have() -> None:
    def of(*psnr: float) -> Rows:
        results = people({"ash": psnr})
        return {("loose", "ash"): [(Cell(config=r.config, folder=Path()), r) for r in results]}

    found = views(of(25.0, 26.0, 31.0, 32.0), of(25.3, 26.4))
    assert (found.before, found.after) == (25.5, 25.85) and found.change == pytest.approx(0.35)


def test_cells_that_failed_are_told_first() -> None:
    before, after = row(30.0, 30.1), row(30.0, 0.0)
    place, result = after["loose", "ash"][1]
    after["loose", "ash"][1] = place, replace(result, status="crashed")
    assert failures_in_words(before, before) == ""
    assert failures_in_words(before, after) == "1 cells of ash on loose failed (before: 0). "


def test_less_error_is_better() -> None:
    before, after = row(1.0, 1.0), row(1.0, 1.0)
    for rows, error in ((before, 0.2), (after, 0.1)):
        (seeds,) = rows.values()
        for index, (place, result) in enumerate(seeds):
            summary = [replace(s, metric="flip", value=error + 0.001 * index) for s in result.summary[:1]]
            seeds[index] = place, replace(result, summary=tuple(summary))
    assert changes(before, after)["verdict"].tolist() == ["better"]
    assert verdict_of(changes(before, after)) == "Of 1 quantities 1 is better (ash on loose)."


def copied(cell: Cell, out: Path, **changes: object) -> Cell:
    """The cell with its result and pictures, under another config."""
    config, result = replace(cell.config, **changes), result_of(cell)
    assert result is not None
    made = replace(cell, config=config, folder=out / "cells" / config.key)
    shutil.copytree(cell.folder, made.folder)
    write_config(made)
    write_result(made.folder, replace(result, config=config))
    return made


@pytest.fixture(scope="module")
def runs(made_once: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs of two seeds: the second has a worse method under the same name."""
    folders = (tmp_path_factory.mktemp("runs") / "before", tmp_path_factory.mktemp("runs") / "after")
    for folder, made in zip(folders, read_run(made_once).cells, strict=True):
        row = {"method": "mine", "factory": made.config.method}
        cells = tuple(copied(made, folder, **row, seed=seed) for seed in range(2))
        write_run(Run(folder=folder, suite=folder.name, about="", command=f"run {folder.name}", cells=cells))
    return folders


@pytest.fixture(scope="module")
def compared(runs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the terminal shows of the two runs, and the folder of their page."""
    folder = tmp_path_factory.mktemp("compared")
    return write_comparison(*map(read_run, runs), folder), folder


def test_compare_tells_rows_and_shows_the_worst_frames(
    runs: tuple[Path, Path], compared: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    output, folder = compared
    assert output.startswith("Of ") and "worse (mine on boxes)" in output.splitlines()[0]
    page = (folder / "compare.html").read_text()
    album = re.search(r'id="album">(.*?)</script>', page)
    assert "among the worst before" in page and album is not None and len(json.loads(album[1])) >= 3 * 3
    assert re.search(r'<td class="second"[^>]*>worse</td>', page)
    assert 'boxes,mine,"PSNR, novel views",dB,' in (folder / "compare.csv").read_text()
    assert cli.main(["compare", str(runs[0]), str(runs[0]), "--out", str(tmp_path)]) == 0
    same = capsys.readouterr().out
    assert same.startswith("No quantity is better or worse.") and "equivalent" in same


def test_a_report_over_runs_and_cells(runs: tuple[Path, Path], tmp_path: Path, no_chart_files: None) -> None:
    cells = [*(runs[0] / "cells").iterdir()]
    assert cli.main(["report", *map(str, cells), "--out", str(tmp_path / "both")]) == 0
    assert "boxes" in (tmp_path / "both" / "report.md").read_text()
    run = gathered([*map(read_run, (runs[0], cells[0]))], tmp_path, command="report")
    assert len(run.cells) == 2 and len({each.config.key for each in run.cells}) == 2
    assert run.command == "run before; report"
    more = gathered([run, read_run(runs[0])], tmp_path, command="report more")
    assert commands_of(more.command) == ["run before", "report", "report more"], "each once"


def test_report_and_compare_take_archives(runs: tuple[Path, Path], tmp_path: Path, no_chart_files: None) -> None:
    published = [tmp_path / name / "cells.zip" for name in ("before", "after")]
    for folder, archive in zip(runs, published, strict=True):
        write_archive(read_run(folder), archive)
    with opened(published) as both:
        assert [run.folder for run in both] == published
        assert [run.cells[0].config.key for run in both] == [read_run(each).cells[0].config.key for each in runs]
    out = tmp_path / "report"
    assert cli.main(["report", str(published[0]), "--out", str(out), "--publish", str(tmp_path / "again")]) == 0
    assert f"Cells of {published[0]}." in (out / "report.html").read_text()
    with opened([published[0], tmp_path / "again" / "cells.zip"]) as (before, again):
        assert results_of(again) == results_of(before)
    assert cli.main(["compare", *map(str, published)]) == 0
    page = (published[1].parent / "compare" / "compare.html").read_text()
    assert f"Before: {published[0]} (" in page and "ash-bench-pack-" not in page
    published[0].write_bytes(b"no archive")
    assert cli.main(["compare", *map(str, published)]) == arguments.WRONG_INPUT


def test_two_avatars_of_one_name_are_no_two_seeds(runs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected one cell boxes · mine · seed 0, another with other settings"):
        gathered([*map(read_run, runs)], tmp_path, command="")


def test_captures_of_one_name_are_told_apart(runs: tuple[Path, Path], tmp_path: Path) -> None:
    (mine, _) = read_run(runs[0]).cells
    other = Path(shutil.copytree(mine.capture_folder, tmp_path / "other"))
    manifest = other / "manifest.json"
    manifest.write_text(manifest.read_text().replace("{", '{"identity": "another",', 1))
    shown = load_capture(other)
    same = replace(mine, capture_folder=other)
    third = copied(same, tmp_path, capture=shown.identity, truth=truth_of(shown.manifest))
    run = gathered([*map(read_run, (runs[0], third.folder))], tmp_path, command="")
    assert {each.config.scene for each in run.cells} == {"capture", "other"}


def test_subjects_of_a_scene_stay_one_scene(runs: tuple[Path, Path], tmp_path: Path) -> None:
    run = read_run(runs[0])
    for subjects, names in (((0, 1), {"boxes"}), ((1, 1), {"capture"})):
        output = zip(run.cells, subjects, strict=False)
        cells = tuple(replace(c, config=replace(c.config, subject=k, truth=str(n))) for n, (c, k) in enumerate(output))
        whole = gathered([replace(run, cells=cells)], tmp_path, command="")
        assert {each.config.scene for each in whole.cells} == names


def test_runs_without_a_common_row_are_refused(runs: tuple[Path, Path], tmp_path: Path) -> None:
    run = read_run(runs[0])
    renamed = replace(run, cells=tuple(replace(c, config=replace(c.config, scene="other")) for c in run.cells))
    with pytest.raises(InputError, match="no scene and method in common"):
        write_comparison(run, renamed, tmp_path)


def test_nothing_is_wrong_with_the_comparison_in_a_browser(compared: tuple[str, Path], visit: Visitor) -> None:
    for size, scheme in ((DESKTOP, "dark"), (PHONE, "light")):
        seen = visit(compared[1] / "compare.html", size=size, scheme=scheme)
        assert (seen.errors, seen.requests, seen.too_wide(), seen.poor_contrast()) == ([], [], [], [])
        for _ in range(10):  # Pictures are decoded when they are scrolled to.
            seen.page.evaluate("scrollBy(0, 500)")
            seen.page.wait_for_timeout(20)
        wait_for(partial(seen.page.evaluate, "[...document.images].every((image) => image.naturalWidth > 0)"))
        assert seen.page.evaluate("document.images.length") >= 9


def test_subjects_are_compared_in_pairs() -> None:
    """Eight people differ by far more than the change does; in pairs it is sure, as two samples it never would be."""

    def people(shift: float) -> Rows:
        (cells,) = row(*(20.0 + 2 * n + shift + 0.01 * (n % 3) for n in range(8))).values()
        places = [replace(place.config, subject=n, seed=0) for n, (place, _) in enumerate(cells)]
        output = [(replace(c, config=p), replace(r, config=p)) for p, (c, r) in zip(places, cells, strict=True)]
        return {("loose", "ash"): output}

    change = views(people(0.0), people(0.3))
    assert change.verdict == "better" and change.change == pytest.approx(0.3)
    two, others = people(0.0), people(0.3)
    assert views({k: v[:1] for k, v in two.items()}, {k: v[1:2] for k, v in others.items()}).verdict == ""


def test_captures_that_differ_in_their_bare_body_alone_show_the_same(runs: tuple[Path, Path]) -> None:
    manifest = read_manifest(read_run(runs[0]).cells[0].capture_folder)
    (later, earlier), *_ = SHOWS_THE_SAME.items()
    truths = [truth_of(replace(manifest, source=source)) for source in (later, earlier, "0123456789abcdef")]
    assert truths[0] == truths[1] != truths[2]
