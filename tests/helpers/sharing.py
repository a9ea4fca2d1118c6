"""What tests of several workers need, made once for all of them."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ash.files import file_lock

Shared = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """A folder by its name, filled once for all workers of a test run; nobody may change what is in it."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def filled(name: str, make: Callable[[Path], object]) -> Path:
        folder = base / name
        with file_lock(folder):
            if not folder.with_suffix(".whole").exists():
                make(folder)
                folder.with_suffix(".whole").touch()
        return folder

    return filled


@pytest.fixture(scope="session")
def small_capture(shared: Shared) -> Path:
    """The folder of the small scene's capture."""
    from helpers.scenes import small_scene  # Not above: a process that only hands out the tests needs no renderer.

    from synth.capture import make_capture

    return shared("small", lambda folder: make_capture(small_scene(), folder))


@pytest.fixture(scope="session")
def ci_data(shared: Shared) -> Path:
    """A folder of captures that holds the one of the suite `ci`; templates that are learned go there as well."""
    from benchmarks.suites.captures import make_capture_in
    from benchmarks.suites.suites import CaptureSpec

    spec = CaptureSpec(scene="mannequin", size="ci")
    return shared("ci_data", lambda folder: make_capture_in(spec, folder / spec.name, workers=2))
