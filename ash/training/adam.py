"""Adam (Kingma and Ba 2015): `torch._fused_adam_` defines it, the native kernel does the same in float32 on the CPU.

The kernel saves 3.3 % of a training step of the default `ash` (1.2 of 36 ms, one thread). `torch.optim.Adam` does the
same arithmetic, but its class imports torch's compiler: 2.6 seconds of every process.
"""

from ctypes import c_int64, c_void_p
from typing import Any

import torch
from torch import Tensor

from ash.native.library import load

BETAS = (0.9, 0.999)
Moments = dict[str, Tensor]  # "step", "exp_avg", "exp_avg_sq"


class Adam:
    """The optimiser of every training. `groups`: dictionaries with `params`, a list of leaves, and `lr`."""

    def __init__(self, groups: list[dict[str, Any]], *, eps: float = 1e-8) -> None:
        self.groups = groups
        self.eps = eps
        self.moments: list[Moments | None] = [None] * len(self.parameters)
        self._addresses: dict[int, _Addresses] = {}  # by the first parameter of a group

    @property
    def parameters(self) -> list[Tensor]:
        """Of all groups, in order; `moments` has the same order."""
        return [parameter for group in self.groups for parameter in group["params"]]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> bool:
        """Move every parameter that has a gradient.

        False: a gradient was NaN or infinite. The parameters are then worth nothing, and the caller must go back.
        """
        first, finite = 0, True
        for group in self.groups:
            moving = {first + i: p for i, p in enumerate(group["params"]) if p.grad is not None}
            if moving:
                moments = [self._moments(index) for index in moving]
                finite &= self._move(first, list(moving.values()), moments, group["lr"])
            first += len(group["params"])
        return finite

    def _move(self, first: int, parameters: list[Tensor], moments: list[Moments], lr: float) -> bool:
        """All of one learning rate; whether their gradients were finite."""
        if all(p.dtype == torch.float32 and p.device.type == "cpu" for p in parameters):
            addresses = self._addresses.get(first)
            if addresses is None or not addresses.are_of(parameters, moments):
                addresses = self._addresses[first] = _Addresses(parameters, moments)
            return _move_native(addresses, lr, self.eps)
        finite = _all_finite([parameter.grad for parameter in parameters if parameter.grad is not None])
        _move_by_torch(parameters, moments, lr, self.eps)
        return finite

    def _moments(self, index: int) -> Moments:
        moments = self.moments[index]
        if moments is None:
            moments = self.moments[index] = self.moments_like(self.parameters[index])
        return moments

    @staticmethod
    def moments_like(parameter: Tensor) -> Moments:
        """Moments before the first step, in memory as the parameter lies: the kernel walks memory."""
        step = torch.zeros((), dtype=torch.float32, device=parameter.device)
        return {"step": step, "exp_avg": torch.zeros_like(parameter), "exp_avg_sq": torch.zeros_like(parameter)}


def _all_finite(gradients: list[Tensor]) -> bool:
    """Whether no number is NaN or infinite: one kernel for all, because a GPU's answer and each launch are waited for.

    Nothing but this operation of torch's looks at a whole list; the scale by which it multiplies is 1.
    """
    not_finite, scale = (gradients[0].new_full((), value, dtype=torch.float32) for value in (0.0, 1.0))
    torch._amp_foreach_non_finite_check_and_unscale_(gradients, not_finite, scale)
    return not bool(not_finite)


def _move_by_torch(parameters: list[Tensor], moments: list[Moments], lr: float, eps: float) -> None:
    steps = [m["step"] for m in moments]
    torch._foreach_add_(steps, 1)
    torch._fused_adam_(
        parameters,
        [parameter.grad for parameter in parameters],
        [m["exp_avg"] for m in moments],
        [m["exp_avg_sq"] for m in moments],
        [],
        steps,
        lr=lr,
        beta1=BETAS[0],
        beta2=BETAS[1],
        weight_decay=0.0,
        eps=eps,
        amsgrad=False,
        maximize=False,
    )


class _Addresses:
    """Where parameters and moments lie, as the kernel takes them: looked up once, not in every step."""

    def __init__(self, parameters: list[Tensor], moments: list[Moments]) -> None:
        self.parameters, self.moments = parameters, moments
        means, squares, steps = ([m[name] for m in moments] for name in ("exp_avg", "exp_avg_sq", "step"))
        self.places, self.means, self.squares, self.steps = map(_addresses, (parameters, means, squares, steps))
        self.counts = (c_int64 * len(parameters))(*(parameter.numel() for parameter in parameters))

    def are_of(self, parameters: list[Tensor], moments: list[Moments]) -> bool:
        """Whether they are those of the same tensors, where they were."""
        same = len(moments) == len(self.moments) and all(a is b for a, b in zip(moments, self.moments, strict=True))
        return same and all(p.data_ptr() == place for p, place in zip(parameters, self.places, strict=True))


def _addresses(tensors: list[Tensor]) -> Any:
    return (c_void_p * len(tensors))(*(tensor.data_ptr() for tensor in tensors))


def _move_native(addresses: _Addresses, lr: float, eps: float) -> bool:
    grads = [_laid_like(parameter) for parameter in addresses.parameters]  # Referenced until they were read.
    arrays = addresses.places, _addresses(grads), addresses.means, addresses.squares, addresses.steps
    return bool(load().ash_adam(len(grads), *arrays, addresses.counts, lr, *BETAS, eps, torch.get_num_threads()))


def _laid_like(parameter: Tensor) -> Tensor:
    """The gradient in the memory order of its parameter, by which the kernel walks."""
    assert parameter.grad is not None
    if parameter.grad.stride() == parameter.stride():
        return parameter.grad
    return torch.empty_like(parameter).copy_(parameter.grad)
