"""What holds for every test."""

import os
import signal
from collections.abc import Iterator

import pytest
from helpers.browser import chromium, visit  # noqa: F401  (fixtures for all)
from helpers.sharing import ci_data, shared, small_capture  # noqa: F401

from benchmarks.cell import metrics


@pytest.fixture(autouse=True, scope="session")
def can_be_interrupted() -> Iterator[None]:
    """A shell's background job begins with SIGINT ignored, and its children would."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def pytest_sessionstart() -> None:
    os.environ.setdefault(metrics.LPIPS_WEIGHTS, "none")  # They take a second in each of hundreds of cells.


LONG = (
    "test_ci_suite",
    "test_tutorials", "test_isolation", "test_kill", "test_cli", "test_in_a_browser", "test_launcher", "test_captures",
    "test_gate", "test_field", "test_readers", "test_cli_faults", "test_page", "test_defects", "test_files",
    "test_conformance", "test_factors", "test_player", "test_switch_parts", "test_capture", "test_plugin",
    "test_engine", "test_predictions", "test_cli_help", "test_outsiders",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))
