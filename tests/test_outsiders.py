"""Two programs that know nothing of our packages, from an export to what they make of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import fakes

from ash.capture.formats import load_capture
from benchmarks import cli
from benchmarks.cell.evaluation import evaluated_views
from benchmarks.cell.schema import read_result
from synth.export.formats import export

ROOT = Path(__file__).parents[1]
ALONE = """
import runpy, sys
paths, sys.argv = sys.argv[1].split(":"), sys.argv[2:]
sys.path[:] = [path for path in sys.path if path] + paths
for name in ("ash", "synth", "baselines", "benchmarks"):
    sys.modules[name] = None  # An import of one fails, wherever it is installed.
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def run_alone(script: Path, *arguments: Path) -> str:
    """What a script prints that runs without our packages, in an isolated interpreter outside the checkout."""
    packages = ":".join(path for path in sys.path if path.endswith("site-packages"))
    command = [sys.executable, "-I", "-S", "-c", ALONE, packages, str(script), *map(str, arguments)]
    done = subprocess.run(command, cwd=arguments[-1].parent, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_our_packages_are_out_of_reach(tmp_path: Path) -> None:
    (tmp_path / "import_ash.py").write_text("import numpy\nimport ash.files\n")
    with pytest.raises(AssertionError, match="'ash' is not a package"):
        run_alone(tmp_path / "import_ash.py", tmp_path)


def test_a_trainer_of_ones_own_reads_a_frame_and_is_scored(tmp_path: Path) -> None:
    capture = load_capture(fakes.write_capture(tmp_path / "capture"))
    export(capture, tmp_path / "train", form="nerfstudio", frame=0)
    views = [(view.split, view.camera, view.frame) for view in evaluated_views(capture)]
    export(capture, tmp_path / "test", form="test-views", views=views)
    script = ROOT / "docs" / "one_frame_splats.py"
    assert len(script.read_text().splitlines()) <= 150
    run_alone(script, tmp_path / "train" / "frame_000000", tmp_path / "test", tmp_path / "mine")
    command = ["score", str(tmp_path / "mine"), str(capture.folder), "--name", "splats", "--out", str(tmp_path / "run")]
    assert cli.main(command) == cli.DONE
    (cell,) = (tmp_path / "run" / "cells").iterdir()
    result = read_result(cell)
    assert result is not None and result.brought is not None and (result.brought.training_s or 0) > 0
    # Its silhouettes are those of the posed template, and colours are learned: one colour per picture reaches 11.6 dB.
    assert min(result.value(split, "full", "iou") or 0 for split in ("novel_view", "novel_pose")) > 0.8
    assert (result.value("train_view", "foreground", "psnr") or 0) > 13


def test_the_releases_reading_code_finds_the_masks(small_capture: Path, tmp_path: Path) -> None:
    folder = export(load_capture(small_capture), tmp_path / "export", form="ash")
    measured = json.loads(run_alone(ROOT / "tests" / "helpers" / "outsider_release.py", folder))
    assert measured["joints_mm"] < 1e-6 and measured["posed_mm"] < 1e-6
    # A calibration whose pixel centres were at whole numbers would lie half a pixel off.
    assert measured["iou"] > 0.9 and measured["offset_px"] < 0.25
