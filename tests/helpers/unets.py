"""Small U-Nets with their inputs, and what they make of them."""

from collections.abc import Callable

import torch
from torch import Tensor

from ash.decoders import UNet

Shape = tuple[int, ...]  # inputs, outputs, width, levels, height and width of the texture, features


def network_and_inputs(shape: Shape) -> tuple[UNet, Tensor, Tensor | None]:
    """A network whose head and biases say something, a texture, and features where it takes some."""
    inputs, outputs, width, levels, rows, columns, features = shape
    torch.manual_seed(0)
    net = UNet(inputs, outputs, width=width, levels=levels, norm="none", bottleneck_features=features)
    for parameter in (net.head.weight, *(p for p in net.parameters() if p.dim() == 1)):
        torch.nn.init.normal_(parameter)
    return net, torch.randn(1, inputs, rows, columns), torch.randn(features) if features else None


def value_and_gradients(
    net: UNet, texture: Tensor, features: Tensor | None, call: Callable[..., Tensor]
) -> list[Tensor]:
    """Of a random linear function of what `call` makes of the inputs."""
    leaves = list(net.parameters())
    if features is not None:
        features = features.clone().requires_grad_()
        leaves.append(features)
    value = call(texture, features)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1)).to(value)
    return [value.detach(), *torch.autograd.grad((value * weights).sum(), leaves)]
