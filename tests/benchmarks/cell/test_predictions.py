"""Pictures that somebody brings: scored like those of a method, and refused where they are not whole."""

import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers.commands import refused_last
from PIL import Image

from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks import cli
from benchmarks.cell.evaluation import evaluated_views
from benchmarks.cell.predictions import LARGEST_INFO, open_predictions, read_info
from benchmarks.cell.schema import Cell, CellResult, prediction_path, read_cell, read_result
from benchmarks.suites.archive import write_archive
from benchmarks.suites.runs import read_run

pytestmark = pytest.mark.usefixtures("installed_fakes", "scored_once")


@pytest.fixture(scope="session")
def drawn(made_once: Path) -> Cell:
    """The cell of a method whose stored pictures are brought here."""
    return next(cell for cell in read_run(made_once).cells if cell.config.method == "fake_bad")


@pytest.fixture
def pictures(drawn: Cell, tmp_path: Path) -> Path:
    """Its stored pictures as an outsider's folder."""
    shutil.copytree(drawn.folder / "images", tmp_path / "mine" / "images")
    (tmp_path / "mine" / "info.json").write_text('{"alpha": "premultiplied"}')
    return tmp_path / "mine"


def score(pictures: Path, capture: Path, *more: str) -> CellResult:
    """The result of the command."""
    out = pictures.parent / "run"
    shutil.rmtree(out, ignore_errors=True)
    assert cli.main(["score", str(pictures), str(capture), "--name", "mine", "--out", str(out), *more]) == cli.DONE
    (folder,) = (out / "cells").iterdir()
    result = read_result(folder)
    assert result is not None and read_cell(folder).config == result.config
    return result


def test_brought_pictures_score_as_the_method_that_drew_them(pictures: Path, capture: Path, drawn: Cell) -> None:
    result, own = score(pictures, capture), read_result(drawn.folder)
    assert own is not None
    for view, before in zip(result.views, own.views, strict=True):
        assert replace(view, scores={}) == replace(before, scores={})
        assert view.scores == pytest.approx(before.scores, rel=1e-4)  # LPIPS depends on the count of threads.
    not_from_pictures = ("speed", "memory", "template_mm", "surface_mm")
    qualities = {
        row.split + row.region + row.metric: row.value
        for row in own.summary
        if row.split not in not_from_pictures and row.metric not in not_from_pictures
    }
    scored = {row.split + row.region + row.metric: row.value for row in result.summary if row.split != "speed"}
    assert scored == pytest.approx(qualities, rel=1e-4)
    assert [(row.metric, row.value) for row in result.summary if row.split == "speed"] == [("failed", 0.0)]
    assert result.timing is None and result.config.method == "mine"


def test_straight_alpha_is_composited_on_black(pictures: Path, capture: Path) -> None:
    """The truth itself, as the capture stores it, is a perfect prediction."""
    loaded = load_capture(capture)
    for view in evaluated_views(loaded):
        Image.fromarray(loaded.image(view.camera, view.frame)).save(prediction_path(pictures, view))
    (pictures / "info.json").unlink()
    assert {view.scores["foreground", "psnr"] for view in score(pictures, capture).views} == {100.0}


def test_without_alpha_only_the_whole_frame_is_scored(pictures: Path, capture: Path, drawn: Cell) -> None:
    for path in pictures.rglob("*.png"):
        Image.open(path).convert("RGB").save(path)
    result, own = score(pictures, capture), read_result(drawn.folder)
    assert own is not None and result.brought is not None and result.brought.alpha == "none"
    for name in ("psnr", "ssim", "flip"):
        assert result.value("novel_view", "full", name) == own.value("novel_view", "full", name)
    assert {row.region for row in result.summary} == {"full", ""}
    assert not [row for row in result.summary if row.metric in ("iou", "flicker")]
    run = pictures.parent / "run"
    assert cli.main(["eval", str(run), "--scores-only"]) == cli.DONE
    again = read_result(read_run(run).cells[0].folder)
    assert again is not None and again.views == result.views and set(again.summary) == set(result.summary)
    assert cli.main(["report", str(run)]) == cli.DONE
    assert "Without alpha" in (run / "report.md").read_text()


def test_the_report_says_what_is_not_known(pictures: Path, capture: Path, made_once: Path, capsys) -> None:
    info = {"alpha": "premultiplied", "training_s": 3600, "frame_ms": 12.5, "device": "A|B", "parameters": 7}
    (pictures / "elsewhere.json").write_text(json.dumps(info))
    score(pictures, capture, "--info", str(pictures / "elsewhere.json"))
    run, out = pictures.parent / "run", pictures.parent / "both"
    assert "brought pictures; what it saw is not known" in capsys.readouterr().out
    assert cli.main(["report", str(made_once), str(run), "--out", str(out)]) in (cli.DONE, 1)
    text = (out / "report.md").read_text()
    assert "mine (brought pictures; what it saw is not known)" in text
    assert "Reported by its authors, not measured here: training 3600 s, 12.5 ms per frame, 7 parameters" in text
    table = pd.read_csv(out / "results.csv")
    assert table.loc[table.method.eq("mine") & table.split.eq("speed"), "metric"].tolist() == ["failed"]
    assert 3600 not in table.value.tolist()
    assert cli.main(["compare", str(run), str(run)]) == cli.DONE
    assert cli.main(["report", str(run)]) == cli.DONE  # with no row that was timed
    write_archive(read_run(run), out / "cells.zip")
    with zipfile.ZipFile(out / "cells.zip") as archive:
        assert not any(str(pictures).encode() in archive.read(name) for name in archive.namelist())
    assert refused_last(capsys, "eval", str(run)).endswith("`eval --scores-only` scores them again")


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _flip(path: Path) -> None:
    """The last check sum of the pixels: Pillow reads on."""
    content = bytearray(path.read_bytes())
    content[-13] ^= 1
    path.write_bytes(content)


def _shrink(path: Path) -> None:
    Image.open(path).resize((5, 4)).save(path)


def _link(path: Path) -> None:
    path.rename(path.parents[4] / "outside.png")
    path.symlink_to(path.parents[4] / "outside.png")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (Path.unlink, "missing"),
        (_cut, "damaged"),
        (_flip, "damaged"),
        (_shrink, "expected a PNG image of shape"),
        (_link, "expected a regular file"),
        (lambda path: shutil.copy(path, path.with_name("1.png")), "not expected"),
        (lambda path: Image.open(path).convert("RGB").save(path), "expected all or none"),
        (lambda path: Image.open(path).convert("L").save(path), "expected a PNG image of shape"),
    ],
)
def test_a_folder_that_is_not_whole_is_not_scored(
    pictures: Path, capture: Path, capsys, damage: Callable[[Path], None], message: str
) -> None:
    path = sorted(pictures.rglob("*.png"))[3]
    damage(path)
    out = pictures.parent / "run"
    assert cli.main(["score", str(pictures), str(capture), "--name", "mine", "--out", str(out)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0] and str(pictures) in lines[0] and not out.exists()


def test_each_problem_has_a_line(pictures: Path, capture: Path, capsys) -> None:
    paths = sorted(pictures.rglob("*.png"))
    paths[0].unlink()
    _cut(paths[1])
    paths[2].with_name("more.png").touch()
    assert cli.main(["score", str(pictures), str(capture), "--name", "mine"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(line.startswith("ash-bench: ") for line in lines)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"frame_ms": -1}', "expected 0 to"),
        ('{"alpha": "both"}', "alpha"),
        ('{"speed": 1}', "unknown key 'speed'"),
        ('{"device": "a\\u001b[2J"}', "printable"),
        ('{"frame_ms": NaN}', "not valid JSON"),
        (" " * (LARGEST_INFO + 1), "expected at most"),
    ],
)
def test_wrong_information_is_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "info.json").write_text(content)
    with pytest.raises(InputError, match=message.replace("'", ".")):
        read_info(tmp_path / "info.json")


def test_information_beside_the_pictures_is_no_link(pictures: Path, capture: Path) -> None:
    (pictures / "info.json").rename(pictures.parent / "info.json")
    (pictures / "info.json").symlink_to(pictures.parent / "info.json")
    with pytest.raises(InputError, match=r"info.json: expected a regular file"):
        open_predictions(pictures, load_capture(capture))
    shutil.rmtree(pictures / "images")
    (pictures / "info.json").unlink()
    with pytest.raises(InputError, match="expected a folder that holds the folder images"):
        open_predictions(pictures, load_capture(capture))


@pytest.mark.parametrize("name", ["ash", "ash_truth", "../mine", ""])
def test_pictures_take_no_methods_name(pictures: Path, capture: Path, capsys, name: str) -> None:
    assert "expected" in refused_last(capsys, "score", str(pictures), str(capture), "--name", name)


def test_other_pixels_or_information_make_another_cell(pictures: Path, capture: Path) -> None:
    loaded = load_capture(capture)
    first = open_predictions(pictures, loaded)
    path = next(pictures.rglob("*.png"))
    pixels = np.array(Image.open(path))
    pixels[0, 0, 0] ^= 1
    Image.fromarray(pixels).save(path)
    second = open_predictions(pictures, loaded)
    (pictures / "info.json").write_text('{"alpha": "premultiplied", "commit": "abc"}')
    third = open_predictions(pictures, loaded)
    assert len({each.digest for each in (first, second, third)}) == 3
    assert third.brought == replace(first.brought, commit="abc")


def test_a_suite_takes_brought_pictures_once(
    pictures: Path, capture: Path, finished: Path, tmp_path: Path, capsys
) -> None:
    """Beside the first seed of a method, which is there already."""
    named = shutil.move(pictures, tmp_path / "all" / capture.resolve().name)
    suite = tmp_path / "mine.toml"
    row = f'{{ of = "predictions:{tmp_path / "all"}", name = "mine", title = "Ours" }}'
    text = f'scenes = [{{ capture = "{capture}" }}]\nmethods = ["fake_good", {row}]\npreset = "ci"\nseeds = 2\n'
    suite.write_text(text)
    assert cli.main(["run", str(suite), "--out", str(finished)]) == cli.DONE
    rows = sorted((cell.config.method, cell.config.seed) for cell in read_run(finished).cells)
    assert rows == [("fake_good", 0), ("fake_good", 1), ("mine", 0)]
    assert "Ours (brought pictures; what it saw is not known)" in (finished / "report.md").read_text()
    next(Path(named).rglob("*.png")).unlink()
    assert "missing" in refused_last(capsys, "run", str(suite), "--out", str(tmp_path / "other"))
    suite.write_text(text.replace(str(tmp_path / "all"), str(tmp_path / "none")))
    assert "expected the folder of its pictures" in refused_last(capsys, "run", str(suite))
    suite.write_text(text.replace('title = "Ours"', "width = 3"))
    assert f"{suite}:2: pictures are taken as they are" in refused_last(capsys, "run", str(suite))
