"""A trained avatar in Python, and the script that shows how."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes

from ash.files import InputError, read_image
from benchmarks import cli
from benchmarks.cell.metrics import on_black
from benchmarks.cell.schema import read_cell
from benchmarks.play.avatars import load_avatar

SCRIPT = Path(__file__).parents[3] / "docs" / "draw_a_frame.py"


@pytest.fixture(scope="module")
def folder(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trained cell of a fake method."""
    made = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        fakes.use(made / "plugins", patch)
        assert cli.main(["train", "helpers.fakes:good", str(capture), "--preset", "ci", "--out", str(made)]) == 0
    return next(made.glob("cells/*"))


def test_three_lines_draw_what_the_suite_scored(folder: Path) -> None:
    avatar = load_avatar(folder, trust=True)
    for path in sorted((folder / "images").glob("*/*/*.png"))[::3]:
        camera = avatar.cameras[path.parent.name]
        drawn = avatar.draw(avatar.motion, frame=int(path.stem), camera=camera)
        stored = read_image(path, shape=(camera.height, camera.width, 4))
        np.testing.assert_array_equal(on_black(drawn), stored)


def test_another_motion_and_another_camera(folder: Path) -> None:
    avatar = load_avatar(folder, trust=True)
    camera = next(iter(avatar.cameras.values()))
    own = avatar.draw(avatar.motion, frame=0, camera=camera)
    raised = avatar.motion.dofs.copy()
    raised[:, 8] += 1.0
    moved = avatar.draw(replace(avatar.motion, dofs=raised), frame=0, camera=camera)
    smaller = avatar.draw(avatar.motion, frame=0, camera=replace(camera, K=camera.K * [[0.5], [0.5], [1]]))
    assert own[..., 3].any() and not np.array_equal(own, moved)
    assert (smaller[..., 3] > 0).sum() < 0.9 * (own[..., 3] > 0).sum()


def test_the_script_of_the_documentation(tube_cells: dict[str, Path], tmp_path: Path) -> None:
    folder = tube_cells["ash"]
    subprocess.run([sys.executable, str(SCRIPT), str(folder), str(tmp_path / "frame.png")], check=True)
    avatar = load_avatar(folder)
    camera = next(iter(avatar.cameras.values()))
    expected = avatar.draw(avatar.motion, frame=len(avatar.motion.dofs) - 1, camera=camera)
    drawn = read_image(tmp_path / "frame.png", shape=(camera.height, camera.width, 4))
    np.testing.assert_array_equal(drawn, expected)


def test_what_is_no_trained_cell_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"trained ones are .*{folder.name}"):
        load_avatar(folder.parents[1])
    with pytest.raises(InputError, match="expected the folder of a cell"):
        load_avatar(tmp_path)
    with pytest.raises(InputError, match="is not ours"):
        load_avatar(folder)
    assert read_cell(folder).config.method == "helpers.fakes:good"
