"""What a report says of each subject."""

import io
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.cells import config
from PIL import Image

from ash.files import InputError
from benchmarks.analysis.results import RunTables
from benchmarks.cell.schema import Cell, CellResult, Summary, failed_result
from benchmarks.report import people
from benchmarks.report.content import Bullets, Table
from benchmarks.report.pictures import Album, first_cells
from benchmarks.report.scene import SceneData, scene_report
from benchmarks.suites.runs import Run, results_of

SPLITS = ("novel_view", "novel_pose")
PSNR = {  # on novel views by subject and seed; one dB less on novel poses
    "ash": ((24.0, 26.0), (27.0, 29.0)),
    "ddc": ((23.0, 23.5), (28.5, 29.0)),
}


def result(method: str, subject: int, seed: int, psnr: float) -> CellResult:
    rows = [Summary(split=split, region="foreground", metric="psnr", value=psnr - k) for k, split in enumerate(SPLITS)]
    return CellResult(config=replace(config(method, seed), subject=subject), status="done", summary=tuple(rows))


def cast(psnr: dict[str, tuple[tuple[float, ...], ...]]) -> RunTables:
    return RunTables(
        [
            result(method, subject, seed, value)
            for method, persons in psnr.items()
            for subject, seeds in enumerate(persons)
            for seed, value in enumerate(seeds)
        ]
    )


def blocks(tables: RunTables, kind: type) -> list:
    return [block for block in people.blocks(tables, "loose") if isinstance(block, kind)]


def test_every_subject_has_the_lead_of_ash() -> None:
    views, _ = blocks(cast(PSNR), Table)
    assert views.frame.index.tolist() == ["subject 0", "subject 1"]
    assert views.frame.to_numpy().tolist() == [["25.00", "+1.75"], ["28.00", "-0.75"]]
    (place,) = blocks(cast(PSNR), Bullets)
    assert place.items[0] == (
        "On novel views ASH minus DDC is -0.75 to +1.75 dB: ahead by more than 0.1 dB on 1 of 2 subjects, behind on 1."
    )


def test_rows_stand_side_by_side_where_the_same_capture_was_rendered_twice() -> None:
    known = [result(method, subject, 0, 25.0) for method in ("ash", "ddc") for subject in (0, 1)]
    results = [
        replace(each, config=replace(each.config, truth=f"of {each.config.subject}", capture=each.config.method))
        for each in known
    ]
    cells = tuple(Cell(config=each.config, folder=Path(), capture_folder=Path()) for each in results)
    run = Run(folder=Path(), suite="s", about="", command="", cells=cells)
    assert [list(shown) for shown in first_cells(run, results)] == [["ash", "ddc"], ["ash", "ddc"]]


def test_an_ablation_that_changes_nothing_is_no_win() -> None:
    def first(psnr: tuple[tuple[float, ...], ...]) -> str:
        return blocks(cast(PSNR | {"ddc": psnr}), Bullets)[0].items[0]

    none = "ahead by more than 0.1 dB on 0 of 2 subjects, behind on"
    assert first(PSNR["ash"]) == f"On novel views ASH minus DDC is +0.00 to +0.00 dB: {none} 0."
    assert first(((25.9, 24.0), (27.9, 28.0))) == f"On novel views ASH minus DDC is +0.05 to +0.05 dB: {none} 0."
    assert first(((26.0, 26.0), (29.0, 29.0))) == f"On novel views ASH minus DDC is -1.00 to -1.00 dB: {none} 2."


def test_a_single_subject_and_a_method_that_failed_or_saw_other_subjects_have_no_such_section() -> None:
    alone = cast({method: persons[:1] for method, persons in PSNR.items()})
    assert people.blocks(alone, "loose") == ()
    ash = [result("ash", subject, 0, 25.0) for subject in (0, 1)]
    fallen = [failed_result(replace(config("ddc", 0), subject=k), "crashed", "boom") for k in (0, 1)]
    assert people.blocks(RunTables([*ash, *fallen]), "loose") == ()
    others = [result("ddc", subject, 0, 24.0) for subject in (1, 2)]
    assert people.blocks(RunTables([*ash, *others]), "loose") == ()


def test_of_many_rows_the_rivals_and_the_users_own_are_shown() -> None:
    rows = ("ash", "ddc", "wo_disp", "smpl", "wo_mot", "mlp", "res_128", "res_512", "theirs")
    table = blocks(cast({row: ((25.0,), (26.0,)) for row in rows}), Table)[0]
    assert list(table.frame.columns) == ["ASH [dB]", "minus theirs", "minus DDC", "minus w/o mot."]


def two_people(run: Run, other: Path) -> tuple[Run, list[CellResult]]:
    """The good and the bad method as ASH and the mesh, on the run's capture and on a copy of it as another person."""
    shutil.copytree(run.cells[0].capture_folder, other)
    names = {"fake_good": "ash", "fake_bad": "ddc"}
    cells, results = [], []
    for subject, capture in enumerate((run.cells[0].capture_folder, other)):
        for cell, result in zip(run.cells, results_of(run), strict=True):
            if (method := names.get(cell.config.method)) is not None:
                place = replace(cell.config, method=method, subject=subject)
                cells.append(Cell(config=place, folder=cell.folder, capture_folder=capture))
                results.append(replace(result, config=place))
    return replace(run, cells=tuple(cells)), results


def test_a_report_over_people_shows_everybody(run: Run, tmp_path: Path) -> None:
    cast, results = two_people(run, tmp_path / "other")
    tables = RunTables(results, {cell.config.key: cell.capture_folder.name for cell in cast.cells})
    data = SceneData(
        run=cast, tables=tables, results=tuple(results), scene="boxes", album=Album(), max_bytes=10**6, worst_frames=1
    )
    sections, sheets = scene_report(data)
    (strips,) = (b for s in sections if s.title == "All subjects on boxes" for b in s.blocks if b.kind == "strips")
    assert [name for name, _ in strips.groups] == ["subject 0", "subject 1"]
    assert all([caption for caption, *_ in strip.tiles] == ["Truth", "ASH", "DDC"] for strip in strips.groups[0][1])
    assert [strip.title.split(",")[:2] for strip in strips.groups[1][1]] == [
        ["subject 1", " novel views"],
        ["subject 1", " novel poses"],
    ]
    sheet = Image.open(io.BytesIO(sheets[strips.file]))
    alone = next(b for s in sections for b in s.blocks if b.kind == "flipbook")
    assert strips.file in sheets and alone.file in sheets and sheet.width < sheet.height
    first = tuple(replace(cell, folder=tmp_path) if cell.config.subject == 0 else cell for cell in cast.cells)
    sections, _ = scene_report(replace(data, run=replace(cast, cells=first)))
    (strips,) = (b for s in sections if s.title == "All subjects on boxes" for b in s.blocks if b.kind == "strips")
    assert [name for name, _ in strips.groups] == ["subject 1"], "of the first only numbers were published"
    side_by_side = next(s for s in sections if s.title.startswith("Side by side"))
    assert "Pictures are of subject 1 of 2 people" in side_by_side.blocks[-1].text
    fallen = [failed_result(each.config, "crashed", "boom") if each.config.subject == 0 else each for each in results]
    sections, _ = scene_report(replace(data, run=replace(cast, cells=first), results=tuple(fallen)))
    side_by_side = next(s for s in sections if s.title.startswith("Side by side"))
    assert "Pictures are of" not in side_by_side.blocks[-1].text, "no report was published of what crashed"
    apart = {cell.config.key: replace(cell.config, truth=cell.config.method) for cell in cast.cells}
    shown_apart = replace(cast, cells=tuple(replace(cell, config=apart[cell.config.key]) for cell in cast.cells))
    of_both = [replace(each, config=apart[each.config.key]) for each in results]
    assert people.pictured(shown_apart, of_both, tables, "boxes", Album()) == (None, {})
    shutil.rmtree(tmp_path / "other")
    with pytest.raises(InputError):
        people.pictured(cast, results, tables, "boxes", Album())
