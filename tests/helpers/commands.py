"""Commands as a user gives them, and how they are refused."""

import os
import subprocess
import sys

import pytest

from benchmarks import cli
from benchmarks.commands import arguments


def ash_bench(*command: str, preexec_fn=None) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own."""
    whole = [sys.executable, "-m", "benchmarks.cli", *command]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        whole, env=environment, capture_output=True, text=True, timeout=120, preexec_fn=preexec_fn, check=False
    )


def refused(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The one line with which a command is refused."""
    assert cli.main(list(command)) == arguments.WRONG_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("ash-bench: ")
    return lines[0]


def refused_last(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    """The last line of a command that is refused after others spoke."""
    assert cli.main(list(command)) == arguments.WRONG_INPUT
    return capsys.readouterr().err.strip().splitlines()[-1]
