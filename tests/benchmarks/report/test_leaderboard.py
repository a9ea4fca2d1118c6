"""The leaderboard: rows of runs and packs, pictures beside the truth, in a browser."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import PHONE, Visitor
from helpers.commands import refused
from helpers.hostile import Text
from helpers.packs import change, change_json
from helpers.waiting import wait_for
from PIL import Image

from ash.capture.formats import load_capture
from ash.files import read_json, write_json
from benchmarks import cli
from benchmarks.cell import metrics
from benchmarks.cell.schema import read_cell, read_result, write_config, write_result
from benchmarks.suites.archive import write_archive
from benchmarks.suites.runs import read_run

pytestmark = pytest.mark.usefixtures("scored_once")
SCRIPT = "</script><script>alert(1)</script>"


@pytest.fixture
def packed(made_once: Path, tmp_path: Path) -> Path:
    """One cell of the run, as somebody with another machine sends it."""
    cell = next(cell for cell in read_run(made_once).cells if cell.config.method == "fake_bad")
    path = tmp_path / "sent.zip"
    assert cli.main(["pack", str(cell.folder), "--out", str(path)]) == cli.DONE
    facts = {"processor": f"Abacus {SCRIPT}", "cores": "1"}
    change(path, change_json("result.json", lambda result: result["provenance"]["machine"].update(facts)))
    change(path, change_json("run.json", lambda run: run.update(titles={"fake_good": "worst", "fake_bad": "best"})))
    return path


@pytest.fixture
def board(made_once: Path, packed: Path, tmp_path: Path) -> Path:
    """The page of the run and of the pack, which is verified with the capture of the run."""
    assert cli.main(["leaderboard", str(made_once), str(packed), "--out", str(tmp_path / "board")]) == cli.DONE
    return tmp_path / "board" / "index.html"


def data_of(page: Path) -> dict:
    text = page.read_text()
    return json.loads(text.partition('id="data">')[2].partition("</script>")[0])


def test_rows_pictures_and_numbers_are_those_of_the_cells(board: Path, made_once: Path, capture: Path) -> None:
    data = data_of(board)
    assert [(row["method"], row["origin"]) for row in data["rows"]] == [
        ("fake_good", "run: scores of its folder"),
        ("fake_bad", "run: scores of its folder"),
        ("fake_bad", "sent.zip: pack, scored again: equal"),
    ]
    assert "Abacus" in data["rows"][2]["machine"] and Text(board.read_text()).tags.count("script") == 2
    cell = read_run(made_once).cells[0]
    result = read_result(cell.folder)
    rows = list(csv.DictReader((board.parent / "images.csv").read_text().splitlines()))
    assert result is not None and len(rows) == 78
    for view, row in zip(result.views, rows, strict=False):
        assert (row["camera"], int(row["frame"]), row["prediction"]) == (view.camera, view.frame, view.prediction)
        assert float(row["foreground_psnr"]) == view.scores["foreground", "psnr"]
    view, shown = result.views[-1], data["cells"][0]
    stored = Image.open(cell.folder / "images" / view.split / view.camera / f"{view.frame:06d}.png")
    written = board.parent / shown["pictures"] / view.split / view.camera / f"{view.frame:06d}.png"
    assert np.array_equal(np.array(Image.open(written)), np.array(stored)[..., :3])
    truth = np.array(Image.open(board.parent / shown["truth"] / view.camera / f"{view.frame:06d}.png"))
    assert np.array_equal(truth, metrics.on_black(load_capture(capture).image(view.camera, view.frame))[..., :3])


def test_it_sorts_filters_and_shows_any_picture(board: Path, visit: Visitor) -> None:
    seen = visit(board)
    page, local = seen.page, board.parent.as_uri()
    names = "#board tbody tr"
    assert [row.split()[0] for row in page.locator(names).all_inner_texts()] == ["fake_good", "fake_bad", "fake_bad"]
    page.click("#board thead button >> text=PSNR")
    assert page.locator(names).first.inner_text().startswith("fake_bad")
    assert "Abacus" in page.inner_text("#hint") and "do not compare" in page.inner_text("#hint")
    sent = page.locator(names, has_text="sent.zip")
    unknown = sent.inner_text().split().count("n/a")  # LPIPS, which was not measured, among them
    page.select_option("#machine", index=1)
    assert sent.inner_text().split().count("n/a") < unknown
    page.select_option("#region", "full")
    assert page.locator("#board thead", has_text="(whole frame)").count() == 0
    sent.locator("a").click()
    wait_for(lambda: page.locator("#strip figure").count() == 2)  # The page follows its address a moment later.
    page.select_option("#method", "")
    page.select_option("#images", "novel_pose")
    page.click("[data-step='1']")
    assert page.inner_text("#number") == "5" and page.url.endswith("/novel_pose/cam3/5/all")
    assert page.locator("#values tbody tr").count() == 3
    loaded = "images => images.every(i => i.complete && i.naturalWidth === 64)"
    wait_for(lambda: page.locator("#strip img").evaluate_all(loaded))
    assert page.locator("#strip img").count() == 1 + 3 * 3 and page.locator("#strip a").count() == 4
    other = visit(page.url, size=PHONE, scheme="dark")
    assert other.page.inner_text("#number") == "5" and other.page.input_value("#images") == "novel_pose"
    for each in (seen, other):
        assert (each.errors, each.too_wide(), each.poor_contrast()) == ([], [], [])
        assert all(request.startswith(local) for request in each.requests)


def test_scenes_of_one_name_are_told_apart_and_seeds_are_averaged(finished: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(finished, tmp_path / "other"))
    keys = []
    for folder in sorted((other / "cells").iterdir()):
        cell, result = read_cell(folder), read_result(folder)
        assert result is not None
        for changed in ({"truth": "f" * 64}, {"truth": "f" * 64, "seed": 1}):
            config = replace(cell.config, **changed)
            keys.append(config.key)
            write_config(replace(cell, config=config, folder=other / "cells" / config.key))
            write_result(other / "cells" / config.key, replace(result, config=config))
        shutil.rmtree(folder)
    write_json(other / "run.json", read_json(other / "run.json") | {"cells": keys})
    assert cli.main(["leaderboard", str(finished), str(other), "--out", str(tmp_path / "b")]) == cli.DONE
    rows = data_of(tmp_path / "b" / "index.html")["rows"]
    assert len({row["scene"] for row in rows}) == 2 and all(row["scene"].startswith("boxes (") for row in rows)
    assert [row["over"] for row in rows] == ["1", "1", "2 seeds", "2 seeds"]
    mean, half = rows[2]["scores"]["novel_view"]["foreground/psnr"]
    assert half == 0 and mean > 0


def _improve(result: dict) -> None:
    next(row for row in result["summary"] if row["metric"] == "psnr")["value"] += 3


def test_a_dishonest_pack_is_refused(packed: Path, capture: Path, tmp_path: Path, capsys) -> None:
    change(packed, change_json("result.json", _improve))
    capsys.readouterr()
    line = refused(capsys, "leaderboard", str(packed), "--out", str(tmp_path / "b"), "--capture", str(capture))
    assert str(packed) in line and "scores differ" in line and not (tmp_path / "b").exists()


@pytest.mark.parametrize("numbers_alone", [False, True])
def test_what_is_not_at_hand_is_said(
    packed: Path, made_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, numbers_alone: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    if numbers_alone:
        packed = tmp_path / "cells.zip"
        write_archive(read_run(made_once), packed)
    assert cli.main(["leaderboard", str(packed), "--out", "b"]) == cli.DONE
    assert "truth of capture: not at hand" in capsys.readouterr().out
    data = data_of(tmp_path / "b" / "index.html")
    told = "no pack, NOT CHECKED" if numbers_alone else "NOT CHECKED: no capture at hand"
    assert told in data["rows"][0]["origin"] and not data["cells"][0]["truth"]
    assert bool(data["cells"][0]["pictures"]) is not numbers_alone


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda run: shutil.rmtree(run / "cells"), "no cell is finished"),
        (lambda run: shutil.rmtree(run), "cannot be read"),
        (lambda run: (run / "run.json").write_text("{}"), "expected the description of a run"),
    ],
)
def test_wrong_sources_are_refused(
    finished: Path, tmp_path: Path, capsys, spoil: Callable[[Path], object], message: str
) -> None:
    spoil(finished)
    assert message in refused(capsys, "leaderboard", str(finished), "--out", str(tmp_path / "b"))
