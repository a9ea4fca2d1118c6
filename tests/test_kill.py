"""Kill a run at random moments, start it again, and compare what it ends with to an undisturbed run."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import fakes
import psutil
import pytest

DRIVER = """
import shutil, sys
from pathlib import Path
from benchmarks import cli, runs
from benchmarks.experiments import SUITES, Suite
from synth.presets import SCENES

capture, out, data = sys.argv[1:]
SCENES["boxes"] = SCENES["mannequin"]
SUITES["boxes"] = Suite(name="boxes", about="", scenes=("boxes",), size="ci", methods=("fake_good", "fake_bad"),
                        preset="ci", seeds=1, cell_minutes=0.1)
runs.make_capture_in = lambda spec, folder, workers: folder.exists() or shutil.copytree(capture, folder)
sys.exit(cli.main(["run", "boxes", "--out", out, "--data", data, "--workers", "2"]))
"""


def start(capture: Path, out: Path, data: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", DRIVER, str(capture), str(out), str(data)]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdout=quiet, stderr=quiet, env={**os.environ, "OMP_NUM_THREADS": "1"})


def outcome(out: Path) -> dict[str, object]:
    """Every quality of every cell, without what differs from run to run: times and memory."""
    found = {}
    for path in sorted(out.glob("cells/*/result.json")):
        result = json.loads(path.read_text())
        rows = [row for row in result["summary"] if row["split"] not in ("speed", "memory")]
        found[path.parent.name] = (result["status"], result["views"], rows)
    return found


@pytest.mark.parametrize("kills", [3, pytest.param(30, marks=pytest.mark.slow)])
def test_kills_at_random_moments_change_nothing(kills: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.use(tmp_path / "plugins", monkeypatch)
    capture = fakes.write_capture(tmp_path / "capture")
    assert start(capture, tmp_path / "whole", tmp_path / "data").wait(120) == 0
    rng = random.Random(kills)
    for _ in range(kills):
        process = start(capture, tmp_path / "run", tmp_path / "data")
        time.sleep(rng.uniform(0.5, 3.0))
        if process.poll() is None and rng.random() < 0.5:  # Half of the time the whole tree, else the engine alone.
            for child in psutil.Process(process.pid).children(recursive=True):
                child.kill()
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(capture, tmp_path / "run", tmp_path / "data").wait(120) == 0
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")
    assert len(outcome(tmp_path / "run")) == 2
    partial = list((tmp_path / "run" / "cells").rglob(".*"))
    assert not partial, "half-written files of killed processes are swept away"
