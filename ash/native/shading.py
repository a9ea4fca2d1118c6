"""Native nodes of torch's graph for a textured mesh: shaded samples, their means, and a texture with its residual."""

from ctypes import c_double
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.native.library import address, load


class TexturedMesh(NamedTuple):
    """Constants of the graph: what a mesh is drawn with. Float32 and int64, contiguous, on the CPU."""

    uvs: Tensor  # [u, 2]
    uv_faces: Tensor  # [f, 3]
    normals: Tensor  # [v, 3]
    faces: Tensor  # [f, 3]


def shade(texture: Tensor, light: Tensor | None, triangles: Tensor, weights: Tensor, surface: TexturedMesh) -> Tensor:
    """Colours `[n, 3]` at points of triangles `[n]` with corners' weights `[n, 3]`.

    Differentiable in the texture `[3, t, s]`, the light `[9, 3]` and the weights.
    """
    return _Shade.apply(texture, light, weights, triangles, surface)  # type: ignore[no-any-return]


class _Shade(Function):
    @staticmethod
    def forward(
        ctx: Any, texture: Tensor, light: Tensor | None, weights: Tensor, triangles: Tensor, surface: TexturedMesh
    ) -> Tensor:
        texture, weights = texture.contiguous(), weights.contiguous()
        colours = torch.empty_like(weights)
        ctx.surface = surface
        ctx.save_for_backward(texture, light, triangles, weights)
        load().ash_shade(
            *_inputs((texture, light, triangles, weights), surface), torch.get_num_threads(), address(colours)
        )
        return colours

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        texture, light, _, weights = ctx.saved_tensors
        grad = grad.contiguous()  # An address holds no reference to what it points at.
        grad_texture, sums = torch.empty_like(texture), (c_double * 27)()
        grad_weights = torch.empty_like(weights) if ctx.needs_input_grad[2] else None
        load().ash_shade_backward(
            *_inputs(ctx.saved_tensors, ctx.surface),
            address(grad),
            address(grad_texture),
            sums,
            address(grad_weights),
        )
        grad_light = None if light is None else light.new_tensor(list(sums)).reshape(9, 3)
        return grad_texture, grad_light, grad_weights, None, None


def _inputs(saved: tuple[Tensor | None, ...], surface: TexturedMesh) -> list[int | None]:
    texture, light, triangles, weights = saved
    assert texture is not None and weights is not None
    sizes = texture.shape[1:]
    return [
        address(texture),
        *sizes,
        address(light),
        address(triangles),
        address(weights),
        len(weights),
        *map(address, surface),
    ]


def corner_weights(corners: Tensor, faces: Tensor, triangles: Tensor, samples: Tensor, width: int) -> Tensor:
    """Perspective-correct weights `[n, 3]` of the corners of `triangles` `[n]` at `samples` `[n]`, `width` to a row.

    Differentiable in `corners` `[v, 3]`, homogeneous pixels.
    """
    return _CornerWeights.apply(corners, faces, triangles, samples, width)  # type: ignore[no-any-return]


class _CornerWeights(Function):
    @staticmethod
    def forward(ctx: Any, corners: Tensor, *rest: Any) -> Tensor:
        faces, triangles, samples, width = rest
        ctx.width = width
        tensors = corners.contiguous(), faces.contiguous(), triangles, samples
        ctx.save_for_backward(*tensors)
        weights = torch.empty(len(samples), 3, device="cpu")
        load().ash_corner_weights(*map(address, tensors), len(samples), width, address(weights))
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        corners, _, _, samples = ctx.saved_tensors
        grad, grad_corners = grad.contiguous(), torch.empty_like(corners)
        numbers = len(samples), ctx.width, len(corners)
        load().ash_corner_weights_backward(
            *map(address, ctx.saved_tensors), *numbers, address(grad), address(grad_corners)
        )
        return grad_corners, None, None, None, None


def resolve(colours: Tensor, covered: Tensor, background: Tensor, *, width: int, height: int, factor: int) -> Tensor:
    """Means `[h, w, 4]` over `factor` x `factor` samples, of which the `covered` have colours; coverage comes last."""
    return _Resolve.apply(colours, covered, background, width, height, factor)  # type: ignore[no-any-return]


class _Resolve(Function):
    @staticmethod
    def forward(
        ctx: Any, colours: Tensor, covered: Tensor, background: Tensor, width: int, height: int, factor: int
    ) -> Tensor:
        image = torch.empty(height, width, 4, device="cpu")
        colours, background = colours.contiguous(), background.contiguous()
        inputs = address(colours), address(covered), len(covered)
        load().ash_resolve(*inputs, width, height, factor, address(background), address(image))
        ctx.numbers = width, factor
        ctx.save_for_backward(covered)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (covered,) = ctx.saved_tensors
        colours = torch.empty(len(covered), 3, device="cpu")
        grad = grad.contiguous()
        inputs = address(grad), address(covered), len(covered)
        load().ash_resolve_backward(*inputs, *ctx.numbers, address(colours))
        return colours, None, None, None, None, None


def add_shuffled(texture: Tensor, decoded: Tensor, factor: int) -> Tensor:
    """`texture` `[c, h f, w f]` plus `decoded` `[c f f, h, w]`, its pixels shuffled up."""
    return _AddShuffled.apply(texture, decoded, factor)  # type: ignore[no-any-return]


class _AddShuffled(Function):
    @staticmethod
    def forward(ctx: Any, texture: Tensor, decoded: Tensor, factor: int) -> Tensor:
        ctx.numbers = texture.shape[0], *decoded.shape[1:], factor
        texture, pixels = texture.contiguous(), decoded.permute(1, 2, 0).contiguous()
        out = torch.empty_like(texture)
        load().ash_shuffle(address(texture), address(pixels), *ctx.numbers, 0, address(out))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        channels, height, width, factor = ctx.numbers
        grad = grad.contiguous()
        pixels = torch.empty(height, width, channels * factor**2, device="cpu")
        load().ash_shuffle(address(grad), None, *ctx.numbers, 1, address(pixels))
        return grad, pixels.permute(2, 0, 1), None
