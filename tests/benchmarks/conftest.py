"""Trained avatars for the tests that show them."""

from pathlib import Path

import pytest
from helpers.captures import write_tube_capture

from benchmarks import cli
from benchmarks.cell.cells import read_cell


@pytest.fixture(scope="session")
def tube_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `train` leaves: a bending tube as ash and as ddc, trained for a moment, colours seen from all sides."""
    folder = tmp_path_factory.mktemp("tube")
    write_tube_capture(folder / "capture")
    short = ["--training.steps", "60", "--training.warmup_steps", "10"]
    for method, more in (("ash", ["--model.sh_degree", "2"]), ("ddc", [])):
        command = ["train", method, str(folder / "capture"), "--preset", "ci", "--out", str(folder / "run")]
        assert cli.main([*command, *short, *more]) == cli.DONE
    return folder / "run"


@pytest.fixture(scope="session")
def tube_cells(tube_run: Path) -> dict[str, Path]:
    """The folder of each method's cell."""
    found = {}
    for config in tube_run.glob("cells/*/config.json"):
        found[read_cell(config.parent).config.method.partition("+")[0]] = config.parent
    return found
