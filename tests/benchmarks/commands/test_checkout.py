import os
import subprocess
from types import SimpleNamespace

import pytest
from helpers.commands import refused

from benchmarks import cli
from benchmarks.cell import sandbox
from benchmarks.commands import arguments


@pytest.mark.parametrize("failing", ["", "pytest", "mypy", "ruff"])
def test_whichever_check_fails_fails_the_whole(failing: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    asked = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        asked.append(command)
        return SimpleNamespace(returncode=int(failing in command), stdout="as an example\n")

    monkeypatch.setattr(subprocess, "run", run)
    assert cli.main(["test", "--", "-k", "splatting"]) == (arguments.FAILED if failing else arguments.DONE)
    (tests,) = (command for command in asked if "pytest" in command)
    assert tests[-2:] == ["-k", "splatting"] and "loadfile" in tests
    assert not any("without_namespaces" in word for command in asked for word in command), "only where all tests run"
    told = capsys.readouterr().out
    assert all(f"--- {name}\n" in told for name in ("ruff check", "ruff format", "import-linter", "mypy"))
    expected = {"": "all checks passed", "ruff": "failed: ruff check, ruff format"}.get(failing, f"failed: {failing}")
    assert told.splitlines()[-1] == f"--- {expected}"


@pytest.mark.parametrize("refused_by_the_kernel", [True, False])
def test_isolation_is_tested_without_namespaces_as_well(
    refused_by_the_kernel: bool, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    asked = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        asked.append(command)
        return SimpleNamespace(returncode=int(command[-1].endswith("test_isolation.py")), stdout="")

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(sandbox, "problem", lambda: "refused" if refused_by_the_kernel else None)
    assert cli.main(["test"]) == (arguments.DONE if refused_by_the_kernel else arguments.FAILED)
    assert any("without_namespaces.sh" in command[1] for command in asked) != refused_by_the_kernel
    last = capsys.readouterr().out.splitlines()[-2:]
    expected = ["--- isolation tests without namespaces: not run, all tests ran so", "--- all checks passed"]
    assert last == expected if refused_by_the_kernel else last[1] == "--- failed: isolation tests without namespaces"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("kernels --avatar a-cell", "--profile, --capture and --avatar go with frame, got kernels"),
        ("frame --avatar a-cell --profile", "expected neither --capture nor --profile"),
        ("frame --avatar a-cell --capture a-capture", "expected neither --capture nor --profile"),
        ("frame --trust", "--trust goes with --avatar"),
        ("frame --avatar nowhere", "nowhere/run.json: cannot be read"),
    ],
)
def test_flags_of_speed_that_do_not_go_together_are_refused(command: str, message: str, capsys) -> None:
    assert message in refused(capsys, "speed", *command.split())
