"""Kill a run in each of its parts, start it again, and compare what it ends with to an undisturbed run.

Every test run kills four times. `KILLS=30 ./ash-bench test -- -m slow -k kills` does so 30 times, by other kinds of
kills in each round; without a number a hundred times.
"""

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import psutil
import pytest
from helpers.waiting import wait_for

import synth.capture
from ash.files import InputError
from benchmarks import cli
from benchmarks.suites.scenes import draw_scene, scene_of

MANY = int(os.environ.get("KILLS", "100"))
KINDS = ("child", "group", "parent", "pause")  # one process, all, the first alone, all for a moment
COSTS = ("speed", "memory")  # what differs from run to run
OUR_TRACEBACK = re.compile(r'^  File ".*/(ash|synth|baselines|benchmarks)/.*", line', re.MULTILINE)
SMALL = """
scenes = [{ of = "mannequin", rig.cameras = 4, rig.width = 64, rig.height = 64, samples = 4, texture = 256 }]
size = "ci"
methods = [{ of = "ash_plus", training.steps = 100, training.warmup_steps = 50 }]
preset = "ci"
seeds = 2
"""
PARTS = (  # what is there of a run that renders, trains, draws, and has its first result
    "data/*/frames/*/*.png",
    "run/cells/**/log.jsonl",
    "run/cells/*/images/*/*/*.png",
    "run/cells/*/result.json",
)


@pytest.mark.parametrize(
    "rounds",
    [  # With time for a machine that others use as well.
        pytest.param(1, marks=pytest.mark.timeout(900)),
        pytest.param(max(2, MANY // len(PARTS)), marks=[pytest.mark.slow, pytest.mark.timeout(120 * MANY)]),
    ],
)
def test_kills_in_every_part_of_a_run_change_nothing(
    rounds: int, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """No cell is lost or doubled; tables, pictures and weights are the same bytes."""
    suite, rng = tmp_path / "small.toml", random.Random(4)
    suite.write_text(SMALL)
    assert cli.main(["run", str(suite), *places(tmp_path / "whole")]) == cli.DONE
    expected = outcome(tmp_path / "whole")
    request.addfinalizer(lambda: end_all_in(tmp_path))
    for number in range(rounds):
        kinds = KINDS if number == 0 else rng.sample(KINDS, len(KINDS))
        run = StruckRun(suite, tmp_path / str(number))
        for kind, part in zip(kinds, PARTS, strict=True):
            wait_for(lambda run=run, part=part: run.goes_on() and list(run.folder.glob(part)), 300, about=run.log)
            time.sleep(rng.uniform(0, 0.5))
            strike(run.process, kind, rng)
        for _ in range(3):  # A cell that lost two processes is a failure, which the same command tries again.
            if run.process.wait() == 0:
                break
            run.goes_on()
        assert run.process.wait() == 0, run.log()
        assert outcome(run.folder) == expected
        assert not OUR_TRACEBACK.search(run.log()), run.log()  # Python's tracker of semaphores has some of its own.
    wait_for(lambda: not at_work_in(tmp_path), about=lambda: at_work_in(tmp_path))


class StruckRun:
    """The command that a user gives again and again, and its folder."""

    def __init__(self, suite: Path, folder: Path) -> None:
        self.folder = folder
        self.command = [sys.executable, "-m", "benchmarks.cli", "run", str(suite), *places(folder), "--retry-failed"]
        folder.mkdir()
        self.start()

    def start(self) -> None:
        with (self.folder / "log").open("ab") as log:
            settings = {**os.environ, "OMP_NUM_THREADS": "1"}
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log, env=settings)

    def goes_on(self) -> bool:
        """Whether it is at work or has come to its end; where it was killed it is started again."""
        if self.process.poll():
            self.start()
        return True

    def log(self) -> str:
        return (self.folder / "log").read_text()


def places(folder: Path) -> list[str]:
    """Where a run is, and how many of its cells run side by side."""
    return ["--out", str(folder / "run"), "--data", str(folder / "data"), "--workers", "2"]


def strike(process: subprocess.Popen[bytes], kind: str, rng: random.Random) -> None:
    """Kill the whole tree, one process of it, or the parent alone, or stop all for a moment."""
    whole = psutil.Process(process.pid)
    family = whole.children(recursive=True)
    at_work = [member for member in family if "resource_tracker" not in command_of(member)]
    chosen = {"child": at_work and [rng.choice(at_work)], "parent": [whole]}.get(kind, [whole, *family])
    for number in (signal.SIGSTOP, signal.SIGCONT) if kind == "pause" else (signal.SIGKILL,):
        for member in chosen:
            _signal(member, number)
        time.sleep(0.3)


def _signal(member: psutil.Process, number: signal.Signals) -> None:
    with contextlib.suppress(psutil.Error):
        member.send_signal(number)


def command_of(process: psutil.Process) -> str:
    with contextlib.suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""


def at_work_in(folder: Path) -> list[psutil.Process]:
    """Processes whose command names the folder."""
    return [process for process in psutil.process_iter() if str(folder) in command_of(process)]


def end_all_in(folder: Path) -> None:
    """A test that failed leaves nothing at work."""
    for process in at_work_in(folder):
        _signal(process, signal.SIGKILL)


def outcome(folder: Path) -> dict[str, object]:
    """Every quality, picture and weight of the cells, and the table without what differs from run to run."""
    found: dict[str, object] = {}
    for cell in sorted(folder.glob("run/cells/*")):
        assert not list(cell.rglob(".*")), "half-written files of killed processes are swept away"
        result = json.loads((cell / "result.json").read_text())
        qualities = [row for row in result["summary"] if row["split"] not in COSTS]
        found[cell.name] = result["status"], result["views"], qualities
        for file in (*sorted(cell.glob("images/**/*.png")), cell / "model.safetensors"):
            found[f"{cell.name}/{file.relative_to(cell)}"] = file.read_bytes()
    table = [line.split(",") for line in (folder / "run" / "results.csv").read_text().splitlines()]
    found["table"] = [row for row in table if row[3] not in COSTS]
    return found


@pytest.mark.parametrize("kills", [1, 2])
def test_a_killed_renderer_is_tried_again_once(
    kills: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    attempts = []

    def killed(*_: object, **__: object) -> None:
        attempts.append(1)
        if len(attempts) <= kills:
            raise BrokenProcessPool("A process in the process pool was terminated abruptly")

    monkeypatch.setattr(synth.capture, "make_capture", killed)
    scene = scene_of("mannequin", size="ci")
    with (
        contextlib.nullcontext() if kills == 1 else pytest.raises(InputError, match="killed from outside in each of 2")
    ):
        draw_scene("mannequin", scene, tmp_path, title="mannequin", workers=2)
    assert len(attempts) == 2
    assert "killed from outside, tried again" in capsys.readouterr().err
