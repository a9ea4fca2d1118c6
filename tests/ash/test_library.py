import resource
import sys

import pytest
import torch

from ash.native.library import keep_freed_memory


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc's allocator")
def test_freed_memory_is_there_for_the_next_step_without_page_faults():
    if not keep_freed_memory():
        pytest.skip("the C library is not glibc")
    rounds, size = 20, 8 << 20  # 2,048 pages of 4 KiB each time
    for _ in range(3):
        torch.zeros(size, dtype=torch.uint8).fill_(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        torch.empty(size, dtype=torch.uint8).fill_(1)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < rounds * size // 4096 // 10
