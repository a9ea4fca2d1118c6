"""The native splatter in torch's graph: Gaussians -> `_Project` -> splats -> `_Blend` -> images."""

import weakref
from ctypes import c_float
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.files import InputError
from ash.native.library import address, check_memory, load


class Viewport(NamedTuple):
    """The plain numbers of a call, in the order in which the native functions take them."""

    width: int
    height: int
    compensate: int
    dilation: float
    near: float
    threads: int


def draw(view: Viewport, background: list[float], arrays: list[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour `[c, h, w, 3]`, alpha `[c, h, w]`, depth `[c, h, w]` and means2d `[c, n, 2]`.

    `arrays` are means, quats, scales, opacities, sh, viewmats and Ks, contiguous float32 on the CPU.
    """
    means2d, packed, depths = _Project.apply(view, *arrays)
    rgb, alpha, depth = _Blend.apply(view, background, means2d, packed, depths)
    return rgb, alpha, depth, means2d


FAULTS = {  # `Fault` in native/kernels.h
    1: "means: expected finite numbers, got NaN or infinity",
    2: "quats: expected finite numbers, got NaN or infinity",
    3: "quats: expected quaternions that are not zero, got a zero quaternion",
    4: "scales: expected finite standard deviations >= 0, got something else",
    5: "opacities: expected numbers in [0, 1], got something else",
    6: "sh: expected finite numbers, got NaN or infinity",
}


class _Project(Function):
    """Gaussians to splats: means2d, the blend's parameters (`Packed` in native/kernels.h), and depths for the order."""

    @staticmethod
    def forward(ctx: Any, view: Viewport, *arrays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        means, sh, viewmats = arrays[0], arrays[4], arrays[5]
        count, cameras, coefficients = len(means), len(viewmats), sh.shape[1]
        means2d = torch.empty(cameras, count, 2, device="cpu")
        packed = torch.empty(cameras, count, 8, device="cpu")
        depths = torch.empty(cameras, count, dtype=torch.float64, device="cpu")
        ctx.sizes = (count, cameras, coefficients, *view)
        fault = load().ash_project(*map(address, arrays), *ctx.sizes, *map(address, (means2d, packed, depths)))
        if fault:
            raise InputError(f"{FAULTS[fault % 16]} at Gaussian {fault // 16}")
        ctx.save_for_backward(*arrays, packed)
        ctx.mark_non_differentiable(depths)
        return means2d, packed, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_means2d: Tensor, grad_packed: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        *arrays, packed = ctx.saved_tensors
        grads = [torch.empty_like(array) for array in arrays[:5]]
        cameras = len(arrays[5])
        inputs = (packed, grad_means2d.contiguous(), grad_packed.contiguous())
        flat = torch.empty(cameras, 12, dtype=torch.float64, device="cpu") if ctx.needs_input_grad[6] else None
        check_memory(
            load().ash_project_backward(
                *map(address, arrays), *ctx.sizes, *map(address, inputs), *map(address, grads), address(flat)
            )
        )
        if flat is None:
            return None, *grads, None, None
        views = torch.zeros_like(arrays[5])
        views[:, :3, :3] = flat[:, :9].reshape(-1, 3, 3)
        views[:, :3, 3] = flat[:, 9:]
        return None, *grads, views, None


class _Drawing:
    """Owns what the native blend keeps for its backward pass."""

    def __init__(self, handle: int) -> None:
        self.handle = handle
        weakref.finalize(self, load().ash_release, handle)


class _Blend(Function):
    """Splats to images, Eq. 3."""

    @staticmethod
    def forward(
        ctx: Any, view: Viewport, background: list[float], means2d: Tensor, packed: Tensor, depths: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        cameras, count = depths.shape
        images = [torch.empty(cameras, view.height, view.width, *rest, device="cpu") for rest in ((3,), (), ())]
        handle = load().ash_blend(
            *map(address, (means2d, packed, depths)),
            count,
            cameras,
            view.width,
            view.height,
            (c_float * 3)(*background),
            view.threads,
            *map(address, images),
        )
        check_memory(handle is None)
        ctx.drawing, ctx.threads = _Drawing(handle), view.threads
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*images, packed)
        return images[0], images[1], images[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_images: Tensor | None) -> tuple[Tensor | None, ...]:
        *images, packed = ctx.saved_tensors
        given = [None if grad is None else grad.contiguous() for grad in grad_images]
        grad_means2d, grad_packed = packed.new_empty(*packed.shape[:2], 2), torch.empty_like(packed)
        check_memory(
            load().ash_blend_backward(
                ctx.drawing.handle,
                *map(address, images),
                *map(address, given),
                ctx.threads,
                address(grad_means2d),
                address(grad_packed),
            )
        )
        return None, None, grad_means2d, grad_packed, None
