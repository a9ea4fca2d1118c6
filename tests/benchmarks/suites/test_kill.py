"""Kill `run ci` at random moments, start it again, and compare what it ends with to an undisturbed run.

`KILLS=30 ./ash-bench test -- -m slow -k kills` strikes 30 times; without a number a hundred times.
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
from benchmarks.cell.metrics import LPIPS_WEIGHTS
from benchmarks.suites.scenes import draw_scene, scene_of

MANY = int(os.environ.get("KILLS", "100"))
KINDS = ("group", "child", "parent", "pause")
COSTS = ("speed", "memory")  # what differs from run to run
OUR_TRACEBACK = re.compile(r'^  File ".*/(ash|synth|baselines|benchmarks)/.*", line', re.MULTILINE)


@pytest.mark.parametrize(
    ("kills", "longest", "methods"),
    [  # With time for a machine that others use as well.
        pytest.param(4, 1 / 6, ("ash_plus", "ddc_plus"), marks=pytest.mark.timeout(900)),
        pytest.param(
            *(MANY, 1 / 4, ("ash", "ash_plus", "ddc_plus", "ash_truth", "ddc_truth")),
            marks=[pytest.mark.slow, pytest.mark.timeout(60 * MANY)],
        ),
    ],
)
def test_kills_at_random_moments_change_nothing(
    kills: int, longest: float, methods: tuple[str, ...], ci_run: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """No cell is lost or doubled; tables, pictures and weights are the same bytes. Each kind strikes as often.

    `longest`: from strike to strike, as a share of an undisturbed run.
    """
    rng, expected = random.Random(kills), outcome(ci_run, methods)
    kinds = [KINDS[k % len(KINDS)] for k in range(kills)]
    rng.shuffle(kinds)
    longest *= float((ci_run / "seconds").read_text())
    folder, rounds = tmp_path / "0", 1
    process = start(folder, methods)
    request.addfinalizer(lambda: end_all_in(tmp_path))
    while kinds:
        time.sleep(rng.uniform(0, longest))
        if process.poll() == 0:  # It came to its end between two strikes: another begins with nothing.
            assert outcome(folder, methods) == expected
            folder, rounds = tmp_path / str(rounds), rounds + 1
        if process.poll() is not None:
            process = start(folder, methods)
        elif strike(process, kinds[-1], rng):
            kinds.pop()
    for _ in range(3):  # A cell that lost two processes is a failure, which the same command tries again.
        if process.wait() == 0:
            break
        process = start(folder, methods)
    assert process.wait() == 0, (folder / "log").read_text()[-2000:]
    assert outcome(folder, methods) == expected
    for log in tmp_path.glob(
        "*/log"
    ):  # Python's own tracker of semaphores has tracebacks of its own when it is struck.
        assert not OUR_TRACEBACK.search(log.read_text()), log.read_text()
    wait_for(lambda: not at_work_in(tmp_path), about=lambda: at_work_in(tmp_path))
    print(f"{kills} kills, {rounds} whole runs")


def start(folder: Path, methods: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """The command that a user gives again and again."""
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "benchmarks.cli", "run", "ci", "--methods", ",".join(methods), "--retry-failed"]
    command += ["--out", str(folder / "run"), "--data", str(folder / "data"), "--workers", "2"]
    settings = {name: value for name, value in os.environ.items() if name != LPIPS_WEIGHTS}
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env={**settings, "OMP_NUM_THREADS": "1"})


def strike(process: subprocess.Popen[bytes], kind: str, rng: random.Random) -> bool:
    """Kill the whole tree, one process of it, or the parent alone, or stop all for a moment; whether it could."""
    whole = psutil.Process(process.pid)
    family = whole.children(recursive=True)
    chosen = {"group": [whole, *family], "child": rng.sample(family, min(1, len(family))), "parent": [whole]}
    struck = [_signal(member, signal.SIGKILL) for member in chosen.get(kind, ())]
    if kind == "pause":
        struck = [_signal(member, signal.SIGSTOP) for member in (whole, *family)]
        time.sleep(0.3)
        for member in (whole, *family):
            _signal(member, signal.SIGCONT)
    return any(struck)


def _signal(member: psutil.Process, number: signal.Signals) -> bool:
    with contextlib.suppress(psutil.Error):
        member.send_signal(number)
        return True
    return False


def at_work_in(folder: Path) -> list[psutil.Process]:
    """Processes whose command names the folder."""
    return [p for p in psutil.process_iter(["cmdline"]) if str(folder) in " ".join(p.info["cmdline"] or ())]


def end_all_in(folder: Path) -> None:
    """A test that failed leaves nothing at work."""
    for process in at_work_in(folder):
        _signal(process, signal.SIGKILL)


def outcome(folder: Path, methods: tuple[str, ...]) -> dict[str, object]:
    """Every quality, picture and weight of the cells of some methods, and their part of the table."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("run/cells/*/config.json")):
        if json.loads(path.read_text())["config"]["method"] not in methods:
            continue
        cell = path.parent
        assert not list(cell.rglob(".*")), "half-written files of killed processes are swept away"
        result = json.loads((cell / "result.json").read_text())
        found[cell.name] = [
            result["status"],
            result["views"],
            [r for r in result["summary"] if r["split"] not in COSTS],
        ]
        for file in (*sorted(cell.glob("images/**/*.png")), cell / "model.safetensors"):
            found[f"{cell.name}/{file.relative_to(cell)}"] = file.read_bytes()
    table = [line.split(",") for line in (folder / "run" / "results.csv").read_text().splitlines()]
    found["table"] = [row for row in table if row[1] in methods and row[3] not in COSTS]
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
