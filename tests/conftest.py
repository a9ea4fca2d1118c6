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
