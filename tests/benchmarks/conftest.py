"""Captures and methods that are fakes, and trained avatars for the tests that show them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import fakes
from helpers.captures import write_tube_capture
from helpers.sharing import Shared

from benchmarks import cli
from benchmarks.cell import metrics
from benchmarks.cell.metrics import score_view
from benchmarks.cell.schema import read_cell

SCORED: dict[bytes, dict[tuple[str, str], float]] = {}


@pytest.fixture(scope="session")
def capture(shared: Shared) -> Path:
    """Three boxes that swing, for methods that are fakes."""
    return shared("capture", fakes.write_capture)


@pytest.fixture
def installed_fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The methods that are fakes, as an installed distribution."""
    fakes.use(tmp_path / "plugins", monkeypatch)


@pytest.fixture(scope="session")
def tube_run(shared: Shared) -> Path:
    """What `train` leaves: a bending tube as ash_plus and as ddc_plus, trained for a moment."""

    def make(folder: Path) -> None:
        write_tube_capture(folder / "capture")
        short = ["--training.steps", "60", "--training.warmup_steps", "10"]
        for method, more in (("ash_plus", ["--model.sh_degree", "2", "--model.window", "2"]), ("ddc_plus", [])):
            command = ["train", method, str(folder / "capture"), "--preset", "ci", "--out", str(folder / "run")]
            assert cli.main([*command, *short, *more]) == cli.DONE

    return shared("tube", make) / "run"


@pytest.fixture(scope="session")
def tube_cells(tube_run: Path) -> dict[str, Path]:
    """The folder of the cell of ash and of ddc."""
    found = {}
    for config in tube_run.glob("cells/*/config.json"):
        found[read_cell(config.parent).config.method.partition("_")[0]] = config.parent
    return found


@pytest.fixture
def boxes(capture: Path, tmp_path: Path) -> str:
    """The file of a suite whose capture needs no renderer."""
    return str(fakes.write_suite(tmp_path, capture))


@pytest.fixture(scope="session")
def made_once(capture: Path, shared: Shared) -> Path:
    """A finished run of the suite boxes."""

    def make(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            fakes.use(folder / "plugins", patch)
            suite = fakes.write_suite(folder, capture)
            assert cli.main(["run", str(suite), "--out", str(folder / "run")]) == cli.DONE

    return shared("boxes", make) / "run"


@pytest.fixture
def finished(made_once: Path, tmp_path: Path) -> Path:
    """A copy of the finished run."""
    return Path(shutil.copytree(made_once, tmp_path / "run"))


@pytest.fixture
def scored_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair of pictures is scored once for all tests, and LPIPS is not measured, which takes long."""

    def score(predicted: np.ndarray, truth: np.ndarray) -> dict[tuple[str, str], float]:
        key = predicted.tobytes() + truth.tobytes()
        if key not in SCORED:
            SCORED[key] = score_view(predicted, truth)
        return SCORED[key]

    monkeypatch.setattr(metrics, "score_view", score)
    monkeypatch.setattr("benchmarks.cell.evaluation._perceptual", lambda device: None)
    monkeypatch.setattr("benchmarks.suites.verification.weights_file", lambda: None)
