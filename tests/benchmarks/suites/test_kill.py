"""Kill a run at random moments, start it again, and compare what it ends with to an undisturbed run.

`KILLS=30 ./ash-bench test -- -m slow -k kills` strikes 30 times; without a number a hundred times.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from helpers import fakes


def start(suite: Path, out: Path, *more: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "benchmarks.cli", "run", str(suite), "--out", str(out), "--workers", "2", *more]
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


def strike(process: subprocess.Popen[bytes], rng: random.Random) -> None:
    """Kill the whole tree, one process of it, or the engine alone; or stop everything for a moment."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.Error:
        return
    how = rng.choice(("tree", "one", "engine", "pause"))
    chosen = {"tree": family, "one": rng.sample(family, min(1, len(family))), "engine": [], "pause": family}[how]
    for member in chosen:
        try:
            member.suspend() if how == "pause" else member.kill()
        except psutil.Error:
            continue
    if how == "pause":
        time.sleep(0.3)
        for member in chosen:
            try:
                member.resume()
            except psutil.Error:
                continue
    if how in ("tree", "engine"):
        process.send_signal(signal.SIGKILL)


MANY = int(os.environ.get("KILLS", "100"))


@pytest.mark.parametrize(
    "kills", [3, pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(120 + 20 * MANY)])]
)
def test_kills_at_random_moments_change_nothing(kills: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No cell is lost or doubled, and pictures and weights are the same bytes; three strikes a start."""
    fakes.use(tmp_path / "plugins", monkeypatch)
    suite = fakes.write_suite(tmp_path, fakes.write_capture(tmp_path / "capture"))
    assert start(suite, tmp_path / "whole").wait(120) == 0
    rng = random.Random(kills)
    done = 0
    while done < kills:
        process = start(suite, tmp_path / "run")
        for _ in range(3):
            time.sleep(rng.uniform(0.5, 2.0))
            if process.poll() is None:
                strike(process, rng)
            done += 1
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(suite, tmp_path / "run", "--retry-failed").wait(120) == 0
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")
    assert len(outcome(tmp_path / "run")) == 2
    assert files(tmp_path / "run") == files(tmp_path / "whole")
    partial = list((tmp_path / "run" / "cells").rglob(".*"))
    assert not partial, "half-written files of killed processes are swept away"


def files(out: Path) -> dict[str, bytes]:
    """Pictures and weights of every cell."""
    found = [*out.glob("cells/*/images/**/*.png"), *out.glob("cells/*/model.safetensors")]
    return {str(path.relative_to(out)): path.read_bytes() for path in found}
