"""The native U-Net in torch's graph: one node for the whole network, on one image."""

import weakref
from ctypes import c_int, c_int64, c_void_p
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.native.library import address, check_memory, load


class UNetShape(NamedTuple):
    """The plain numbers of a network, in the order in which the native functions take them."""

    height: int
    width: int
    inputs: int
    outputs: int
    channels: int  # of the first level
    levels: int
    features: int  # beside the bottleneck
    bfloat16: bool = False  # in the factors of 3x3 convolutions; needs tiles, and channels in whole 16s


class Picks(NamedTuple):
    """Which parts of the output are wanted, line by line of its pixels."""

    places: Tensor  # [n] int32: in its line, counted in parts
    lines: Tensor  # [h + 1] int64: where each line's parts begin among those, and where the last one's end
    width: int  # floats of a part; a pixel has outputs / width of them


def unet(
    shape: UNetShape,
    texture: Tensor,
    features: Tensor | None,
    layers: list[tuple[Tensor, Tensor]],
    threads: int,
    picks: Picks | None = None,
) -> Tensor:
    """Map a texture `[inputs, h, w]` to `[outputs, h, w]`, in memory pixel by pixel, or to its `picks` `[n, width]`.

    `layers`: weights and bias of every layer in the order of `Layers` in native/unet.cpp. Differentiable in those and
    in the features; the texture is a constant. Everything is float32 on the CPU.
    """
    flat = [tensor for layer in layers for tensor in layer]
    return _UNet.apply(shape, threads, picks, texture, features, *flat)  # type: ignore[no-any-return]


class _Network:
    """Owns what the native network keeps for its backward pass."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        weakref.finalize(self, load().ash_unet_release, handle)


def _laid_out(tensor: Tensor) -> Tensor:
    """A convolution's weights [out, tap, in] in memory (a transposed one's [in, tap, out]), or a bias."""
    return tensor.contiguous(memory_format=torch.channels_last) if tensor.dim() == 4 else tensor.contiguous()


def _addresses(tensors: list[Tensor]) -> Any:
    return (c_void_p * len(tensors))(*(tensor.data_ptr() for tensor in tensors))


def _picked(picks: Picks | None) -> tuple[int | None, int | None, int]:
    return (None, None, 0) if picks is None else (address(picks.places), address(picks.lines), picks.width)


class _UNet(Function):
    @staticmethod
    def forward(
        ctx: Any,
        shape: UNetShape,
        threads: int,
        picks: Picks | None,
        texture: Tensor,
        features: Tensor | None,
        *weights: Tensor,
    ) -> Tensor:
        laid = [_laid_out(tensor) for tensor in weights]
        features = None if features is None else features.contiguous()
        whole = (shape.height, shape.width, shape.outputs)
        out = torch.empty(whole if picks is None else (len(picks.places), picks.width), device="cpu")
        handle = load().ash_unet(
            (c_int * len(shape))(*shape),
            texture.data_ptr(),
            (c_int64 * 3)(*texture.stride()),
            address(features),
            _addresses(laid),
            *_picked(picks),
            threads,
            address(out),
        )
        check_memory(handle is None)
        ctx.network, ctx.shape, ctx.threads, ctx.picks = _Network(handle), shape, threads, picks
        ctx.save_for_backward(*laid)
        return out if picks is not None else out.permute(2, 0, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        weights = list(ctx.saved_tensors)
        grads = [torch.empty_like(tensor) for tensor in weights]
        features = torch.empty(ctx.shape.features, device="cpu") if ctx.shape.features else None
        outer = (grad if ctx.picks is not None else grad.permute(1, 2, 0)).contiguous()
        check_memory(
            load().ash_unet_backward(
                ctx.network.handle,
                address(outer),
                _addresses(weights),
                _addresses(grads),
                *_picked(ctx.picks),
                address(features),
                ctx.threads,
            )
        )
        return None, None, None, None, features, *grads
