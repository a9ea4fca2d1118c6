"""What holds for every test."""

import signal
from collections.abc import Iterator

import pytest
from helpers.browser import chromium, visit  # noqa: F401  (fixtures for all)


@pytest.fixture(autouse=True, scope="session")
def can_be_interrupted() -> Iterator[None]:
    """A shell's background job begins with SIGINT ignored, and its children would."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


LONG = ("test_kill", "test_conformance", "test_cli", "test_isolation", "test_engine", "test_launcher", "test_ci_suite")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first, so that no worker is left alone with one at the end.

    The suite `ci` comes late among them: its run is made for the kills, and a worker would wait for the other.
    """
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))
