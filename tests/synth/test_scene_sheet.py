"""docs/scene_sheet.py: which views it shows, and that it draws them and people."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from synth import presets
from synth.views import splits

SCRIPT = Path(__file__).parents[2] / "docs" / "scene_sheet.py"


@pytest.fixture(scope="module")
def sheet() -> dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


@pytest.mark.parametrize(("name", "size"), [("turning", "factor"), ("loose", "quick")])
def test_a_row_ends_with_a_new_and_a_far_pose(sheet: dict[str, Any], name: str, size: str) -> None:
    scene = presets.scene(name, size=size)
    views = sheet["shown"](scene)
    parts = splits(scene)
    names = [next(name for name, part in parts.items() if view in set(part.views)) for view in views]
    assert names == ["train", "train", "train", "novel_pose", "far_pose"]


def test_a_tile_has_the_person_in_its_middle_at_full_height(sheet: dict[str, Any]) -> None:
    image = np.zeros((640, 640, 4), np.uint8)
    image[100:500, 50:150] = (255, 0, 0, 255)
    tile = np.asarray(sheet["tile"](Image.fromarray(image)))
    person = (tile == (255, 0, 0)).all(-1)
    rows, columns = np.flatnonzero(person.any(1)), np.flatnonzero(person.any(0))
    height, width = tile.shape[:2]
    assert (width, height) == sheet["TILE"]
    assert rows[-1] - rows[0] + 1 == pytest.approx(height / 1.12, abs=3)
    assert rows[0] + rows[-1] == pytest.approx(height, abs=3)
    assert columns[0] + columns[-1] == pytest.approx(width, abs=3)
    assert (tile[~person][0] == sheet["GREY"]).all()


def test_a_row_is_drawn(sheet: dict[str, Any]) -> None:
    names = sheet["row"].__globals__
    small = SimpleNamespace(scene=lambda name, size: presets.scene(name, size="ci"))
    names |= {"TILE": (24, 32), "VIEWS": 3, "presets": small}
    line = np.asarray(sheet["row"]("mannequin"))
    assert line.shape == (32, 72, 3)
    for column in range(3):
        assert (line[:, 24 * column : 24 * column + 24] != names["GREY"]).any(-1).mean() > 0.05


def test_an_unknown_scene_is_refused_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, SCRIPT, tmp_path / "sheet.webp", "loose", "wrinkels"]
    outcome = subprocess.run(command, capture_output=True, text=True, check=False)
    assert outcome.returncode == 1 and not outcome.stdout
    assert outcome.stderr.startswith("unknown scene 'wrinkels', expected one of ")
    assert outcome.stderr.count("\n") == 1


def test_people_stand_beside_one_another(tmp_path: Path) -> None:
    out = tmp_path / "cast.png"
    subprocess.run([sys.executable, SCRIPT, out, "--people", "1"], check=True)
    sheet = np.asarray(Image.open(out))
    assert sheet.shape == (640, 240, 3)
    tight, loose = (rows.astype(int) for rows in np.split(sheet, 2))
    assert ((tight != sheet[0, -1]).any(-1).mean() > 0.03) and (abs(tight - loose).max(-1) > 30).mean() > 0.01
