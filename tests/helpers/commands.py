"""Commands as a user gives them, and how they are refused."""

import pytest

from benchmarks import cli
from benchmarks.commands import arguments


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
