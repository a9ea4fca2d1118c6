"""What tests of kernels share."""

from collections.abc import Iterator

import pytest
from helpers.tube import capture  # noqa: F401  (a fixture)

from ash.native.library import instruction_set, use_instruction_set


@pytest.fixture(params=("avx512", "avx2", "plain"))
def instructions(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this machine runs, by turns."""
    before = instruction_set()
    if not use_instruction_set(request.param):
        pytest.skip(f"this machine does not run {request.param}")
    yield request.param
    use_instruction_set(before)
