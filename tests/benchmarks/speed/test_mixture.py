"""How idle threads wait: what the door settles for every command, and the benchmark that shows what it is worth."""

import os
import re
import subprocess
import sys

import pytest

from benchmarks.speed.mixture import THREADS, WAITING, Mixture, print_mixtures, time_mixture

SETTINGS = ("OMP_NUM_THREADS", "GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
AFTER_THE_DOOR = "from benchmarks import cli; cli.main(['suites', 'ci']); import torch"


def settings_shown(text: str) -> dict[str, list[str]]:
    """What runtimes of OpenMP say of themselves as they are loaded; torch's is not everywhere GNU's."""
    found = {name: re.findall(rf"{name} ?= ?'(\w+)'", text) for name in SETTINGS}
    if not found["GOMP_SPINCOUNT"]:
        pytest.skip("torch's OpenMP runtime is not GNU's")
    return found


@pytest.mark.parametrize(
    ("given", "spins"), [({}, "1000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "passive"}, "0")]
)
def test_the_door_settles_how_threads_wait_unless_the_user_did(given: dict[str, str], spins: str) -> None:
    kept = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    done = subprocess.run(
        [sys.executable, "-c", AFTER_THE_DOOR],
        env=kept | given | {"OMP_DISPLAY_ENV": "verbose"},
        capture_output=True,
        text=True,
        check=True,
    )
    found = settings_shown(done.stderr)
    assert found["GOMP_SPINCOUNT"] == [spins]
    assert found["OMP_NUM_THREADS"] == ["1"]


def test_blas_has_one_thread_behind_the_door_as_in_cells() -> None:
    """Times of `eval` and `train` are taken in this process: a second thread that waits busily falsifies them."""
    code = """
import os
from benchmarks import cli
import numpy as np
np.ones((500, 500)) @ np.ones((500, 500))
print(len(os.listdir("/proc/self/task")))
"""
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", code], env=kept, capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


def test_each_way_of_waiting_has_a_process_that_is_told_so(monkeypatch: pytest.MonkeyPatch, capfd) -> None:
    monkeypatch.setenv("OMP_DISPLAY_ENV", "verbose")
    monkeypatch.setenv("GOMP_SPINCOUNT", "1000")
    mixtures = time_mixture(rounds=1)
    assert [(one.threads, one.waiting) for one in mixtures] == [(n, how) for n in THREADS for how in WAITING]
    assert all(0 < one.alternating_min_ms <= one.alternating_ms for one in mixtures)
    told, untold = sorted(map(int, settings_shown(capfd.readouterr().err)["GOMP_SPINCOUNT"]))
    assert told == 1000 < untold


def test_ratios_are_to_the_sum_and_to_one_thread_that_waits_alike(capsys) -> None:
    def mixture(threads: int, waiting: str, ms: float) -> Mixture:
        return Mixture(
            threads=threads,
            waiting=waiting,
            convolution_ms=2.0,
            splat_ms=3.0,
            alternating_ms=ms,
            alternating_min_ms=ms / 2,
        )

    print_mixtures([mixture(1, "briefly", 4.0), mixture(1, "spinning", 5.0), mixture(2, "spinning", 20.0)])
    assert capsys.readouterr().out.splitlines()[-1].endswith("4.00 of the sum, 4.00 of one thread's (least: 4.00)")
