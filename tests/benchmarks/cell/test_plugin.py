"""A stranger's method: the example package is installed as a user would, and judged like ours."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.cell.sandbox import METHOD_PATH
from benchmarks.cell.schema import read_result

PACKAGE = Path(__file__).parents[2] / "helpers" / "plugin"


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The example package, installed offline into a folder."""
    pytest.importorskip("setuptools", reason="building the example package needs setuptools")
    folder = tmp_path_factory.mktemp("plugin")
    source, target = folder / "source", folder / "site"
    source.mkdir()
    for path in PACKAGE.glob("p*.*"):
        (source / path.name).write_bytes(path.read_bytes())
    options = ["--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def on_the_path(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(METHOD_PATH, os.pathsep.join([str(site), *filter(None, [os.environ.get(METHOD_PATH)])]))
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.chdir(tmp_path)


def test_the_example_is_short_enough_to_be_an_example() -> None:
    lines = (PACKAGE / "painted_mesh.py").read_text().splitlines()
    method = lines[lines.index("class PaintedMesh:") :]
    assert len([line for line in method if line.strip()]) <= 50


@pytest.mark.usefixtures("on_the_path")
def test_the_example_keeps_all_rules(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check-method", "painted", "--capture", str(capture)]) == cli.DONE
    assert "all rules kept" in capsys.readouterr().out


@pytest.mark.usefixtures("on_the_path")
def test_the_example_is_trained_and_scored_like_ours(capture: Path, tmp_path: Path) -> None:
    assert cli.main(["train", "painted", str(capture), "--preset", "ci", "--out", "runs"]) == cli.DONE
    (cell,) = (tmp_path / "runs" / "cells").iterdir()
    result = read_result(cell)
    assert result is not None and result.status == "done"
    for split in ("novel_view", "novel_pose"):
        assert result.value(split, "full", "iou") > 0.9
        assert result.value(split, "foreground", "psnr") > 9
    assert result.value("memory", "", "params") == 3 * 72
