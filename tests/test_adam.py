"""Adam makes the steps of torch's, bit for bit, and spares the process its compiler."""

import subprocess
import sys

import torch

from ash.adam import Adam


def leaves() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = [(5, 3), (2, 3, 4, 4), (1,), (7,)]
    made = [torch.randn(shape, generator=generator) for shape in shapes]
    made[1] = made[1].contiguous(memory_format=torch.channels_last)
    return [leaf.requires_grad_() for leaf in made]


def test_steps_are_those_of_torch() -> None:
    ours, theirs = leaves(), leaves()
    groups = [[0, 1], [2, 3]]
    mine = Adam([{"params": [ours[i] for i in group], "lr": 0.1 / (1 + group[0])} for group in groups], eps=1e-15)
    reference = torch.optim.Adam(
        [{"params": [theirs[i] for i in group], "lr": 0.1 / (1 + group[0])} for group in groups], eps=1e-15, fused=True
    )
    for step in range(20):
        for optimiser, parameters in ((mine, ours), (reference, theirs)):
            optimiser.zero_grad()
            # The last leaf joins late, so that each has a count of its own steps.
            used = parameters if step > 5 else parameters[:-1]
            sum((leaf * leaf.cos()).sum() for leaf in used).backward()
            optimiser.step()
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert not torch.equal(ours[0], leaves()[0])


def test_the_compiler_stays_out_of_the_process() -> None:
    code = """
import sys, torch
from ash.adam import Adam
leaf = torch.ones(3, requires_grad=True)
optimiser = Adam([{"params": [leaf], "lr": 0.1}])
leaf.sum().backward()
optimiser.step()
optimiser.zero_grad()
assert leaf[0] < 1
sys.exit("torch._dynamo" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
