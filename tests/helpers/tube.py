"""The capture of the tube, made once for all workers."""

import pytest
from helpers.captures import write_tube_capture
from helpers.sharing import Shared

from ash.capture.dataset import Capture
from ash.capture.formats import load_capture


@pytest.fixture(scope="module")
def capture(shared: Shared) -> Capture:
    """The tube, whose files nobody may change: tests that do write a capture of their own."""
    return load_capture(shared("tube_capture", write_tube_capture))
