"""Adam makes the steps of torch's, sees gradients that are not finite, and spares the process its compiler."""

import subprocess
import sys

import pytest
import torch

from ash.training.adam import Adam


def leaves(dtype: torch.dtype) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = [(5, 3), (2, 3, 4, 4), (1,), (70000,), (7,)]
    made = [torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes]
    made[1] = made[1].contiguous(memory_format=torch.channels_last)
    return [leaf.requires_grad_() for leaf in made]


def groups(parameters: list[torch.Tensor]) -> list[dict]:
    return [{"params": parameters[:2], "lr": 0.1}, {"params": parameters[2:], "lr": 0.1 / 3}]


def largest_difference(dtype: torch.dtype, steps: int) -> float:
    """Between our parameters and those of torch's Adam after so many steps."""
    ours, theirs = leaves(dtype), leaves(dtype)
    reference = torch.optim.Adam(groups(theirs), eps=1e-15, fused=True)
    for_ours = Adam(groups(ours), eps=1e-15)
    for step in range(steps):
        for optimiser, parameters in ((for_ours, ours), (reference, theirs)):
            optimiser.zero_grad()
            # The last leaf joins late, so that each has a count of its own steps.
            used = parameters if step > 5 else parameters[:-1]
            sum((leaf * leaf.cos()).sum() for leaf in used).backward()
            optimiser.step()
    assert not torch.equal(ours[0], leaves(dtype)[0])
    return max(float((a - b).detach().abs().max()) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.usefixtures("instructions")
def test_steps_are_those_of_torch() -> None:
    assert largest_difference(torch.float32, steps=20) < 5e-6  # a step moves up to 0.1


def test_a_parameter_that_was_moved_in_memory_is_followed() -> None:
    leaf = torch.zeros(100, requires_grad=True)
    optimiser = Adam([{"params": [leaf], "lr": 0.5}])
    for expected in (-0.5, -1.0):
        leaf.grad = torch.ones(100)
        optimiser.step()
        torch.testing.assert_close(leaf.detach(), torch.full((100,), expected))
        leaf.data = leaf.data.clone()


def test_in_other_precisions_the_definition_itself_runs() -> None:
    assert largest_difference(torch.float64, steps=8) == 0


def test_gradients_in_another_memory_order_are_taken_as_they_are_meant() -> None:
    leaf = torch.zeros(2, 3, 4, 4).contiguous(memory_format=torch.channels_last).requires_grad_()
    leaf.grad = torch.arange(96.0).reshape(2, 3, 4, 4) - 40
    assert Adam([{"params": [leaf], "lr": 0.5}]).step()
    torch.testing.assert_close(leaf.detach(), -0.5 * leaf.grad.sign())  # a first step is the rate times the sign


@pytest.mark.parametrize("where", [0, 17, -1])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_gradient_that_is_not_finite_is_seen(value: float, where: int) -> None:
    for dtype in (torch.float32, torch.float64):
        parameters = leaves(dtype)
        for leaf in parameters:
            leaf.grad = torch.ones_like(leaf)
        optimiser = Adam(groups(parameters), eps=1e-15)
        assert optimiser.step()
        parameters[3].grad[where] = value
        assert not optimiser.step()


def test_the_compiler_stays_out_of_the_process() -> None:
    code = """
import sys, torch
from ash.training.adam import Adam
leaf = torch.ones(3, requires_grad=True)
optimiser = Adam([{"params": [leaf], "lr": 0.1}])
leaf.sum().backward()
optimiser.step()
optimiser.zero_grad()
assert leaf[0] < 1
sys.exit("torch._dynamo" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
