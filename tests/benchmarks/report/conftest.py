"""A finished run to report."""

from pathlib import Path

import pytest

from benchmarks.suites.runs import Run, read_run


@pytest.fixture(scope="session")
def run(made_once: Path) -> Run:
    """The run of the suite boxes; nobody may change its files."""
    return read_run(made_once)
