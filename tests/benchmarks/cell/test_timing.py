"""What a process is said to have used is its own."""

import subprocess
import sys

import numpy as np

ASK = """
import os
import numpy as np
from benchmarks.cell.sandbox import peak_memory_mb
before = peak_memory_mb(os.getpid())
np.ones(1 << 25).sum()
print(before, peak_memory_mb(os.getpid()))
"""


def test_the_peak_holds_what_was_let_go_of_and_nothing_of_the_parents() -> None:
    own = np.ones(1 << 27)  # a gibibyte
    child = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True)
    before, after = map(float, child.stdout.split())
    assert len(own) and before < 900
    assert before + 200 < after < before + 400  # 256 MiB
