"""What a process is said to have used is its own."""

import subprocess
import sys

import numpy as np

from benchmarks.cell.evaluation import training_costs
from benchmarks.cell.schema import TrainingTime

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


def test_a_training_that_was_interrupted_costs_what_all_attempts_took() -> None:
    """The last attempt took 2 s of 30 by the clock; by the log, which goes on, the whole training took 900."""
    costs = training_costs(TrainingTime(wall_s=30.0, cpu_s=2.0), logged_s=900.0)
    assert costs == dict.fromkeys([("speed", name) for name in ("train_s", "train_wall_s", "train_cpu_s")], 900.0)
    whole = training_costs(TrainingTime(wall_s=30.0, cpu_s=20.0), logged_s=19.0)
    assert [*whole.values()] == [30.0, 30.0, 20.0]
