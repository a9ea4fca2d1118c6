"""Adam (Kingma and Ba 2015) over torch's fused kernel.

`torch.optim.Adam` does the same arithmetic, but its class imports torch's compiler: 2.6 seconds of every process, a
quarter of a small training.
"""

from typing import Any

import torch
from torch import Tensor

BETAS = (0.9, 0.999)
Moments = dict[str, Tensor]  # "step", "exp_avg", "exp_avg_sq"


class Adam:
    """The optimiser of every training. `groups`: dictionaries with `params`, a list of leaves, and `lr`."""

    def __init__(self, groups: list[dict[str, Any]], *, eps: float = 1e-8) -> None:
        self.groups = groups
        self.eps = eps
        self.moments: list[Moments | None] = [None] * len(self.parameters)

    @property
    def parameters(self) -> list[Tensor]:
        """Of all groups, in order; `moments` has the same order."""
        return [parameter for group in self.groups for parameter in group["params"]]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter that has a gradient."""
        first = 0
        for group in self.groups:
            moving = {first + i: p for i, p in enumerate(group["params"]) if p.grad is not None}
            if moving:
                self._move(list(moving.values()), [self._moments(index) for index in moving], group["lr"])
            first += len(group["params"])

    def _move(self, parameters: list[Tensor], moments: list[Moments], lr: float) -> None:
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
            eps=self.eps,
            amsgrad=False,
            maximize=False,
        )

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
