"""Captures and methods that are fakes, and trained avatars for the tests that show them."""

import shutil
from pathlib import Path

import pytest
from helpers import fakes
from helpers.captures import write_tube_capture

from benchmarks import cli
from benchmarks.cell.cells import read_cell


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three boxes that swing, for methods that are fakes."""
    return fakes.write_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture
def installed_fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The methods that are fakes, as an installed distribution."""
    fakes.use(tmp_path / "plugins", monkeypatch)


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


@pytest.fixture
def boxes(capture: Path, tmp_path: Path) -> str:
    """The file of a suite whose capture needs no renderer."""
    return str(fakes.write_suite(tmp_path, capture))


@pytest.fixture(scope="module")
def made_once(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the suite boxes."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        fakes.use(folder / "plugins", patch)
        suite = fakes.write_suite(folder, capture)
        assert cli.main(["run", str(suite), "--out", str(folder / "run")]) == cli.DONE
    return folder / "run"


@pytest.fixture
def finished(made_once: Path, tmp_path: Path) -> Path:
    """A copy of the finished run."""
    return Path(shutil.copytree(made_once, tmp_path / "run"))
