import subprocess
import sys

import pytest

#: Writes 8 MiB twenty times over, each time into memory that was freed just before; prints the page faults.
FAULTS = """
import resource, sys, torch
from ash.native.library import keep_freed_memory
if not keep_freed_memory():
    sys.exit("the C library is not glibc")
for _ in range(3):
    torch.zeros(8 << 20, dtype=torch.uint8).fill_(1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.empty(8 << 20, dtype=torch.uint8).fill_(1)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc's allocator")
def test_freed_memory_is_there_for_the_next_step_without_page_faults():
    # A process of its own: what earlier tests left in the heap decides where a block lies.
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True)
    if "not glibc" in done.stderr:
        pytest.skip("the C library is not glibc")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 20 * (8 << 20) // 4096 // 2  # Half of the pages: without it, each is a fault.
