"""A finished run to report."""

from pathlib import Path

import pytest

from benchmarks.report.vega import Figure
from benchmarks.suites.runs import Run, read_run


@pytest.fixture(scope="session")
def run(made_once: Path) -> Run:
    """The run of the suite boxes; nobody may change its files."""
    return read_run(made_once)


@pytest.fixture
def no_chart_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Charts are not drawn as files, which takes a third of a report's time."""
    monkeypatch.setattr(Figure, "svg", lambda figure: "")
