"""The native kernels of Stg. 2 and Eq. 5: a texel's place on its triangle, and raw parameters to Gaussians.

`pose` saves 27 % of a training step of the default `ash` (13 of 48 ms, 30,569 texels, one thread),
`place_texels` 4.4 ms of a played frame (16 ms).
"""

from ctypes import c_double
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.native.library import address, check_memory, load

VERTEX = 16  # floats of a vertex: real part 4, dual part 4, canonical 3, normal 3, nothing 2


class PoseOptions(NamedTuple):
    """The plain numbers of a call, in the order in which the native functions take them."""

    offset_unit: float  # metres per unit of a raw offset; 0: no offset
    canonical_frame: int  # rotations turn with the surface
    threads: int


def place_texels(
    vertices: Tensor, corners: Tensor, barycentric: Tensor, *, threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Unit quaternions `[n, 4]`, translations, canonical positions and unit normals `[n, 3]` of texels.

    `vertices` `[v, VERTEX]` and `barycentric` `[n, 3]` are float32, `corners` `[n, 3]` int32, all contiguous.
    """
    count = len(corners)
    quats, *points = (torch.empty(count, width, device="cpu") for width in (4, 3, 3, 3))
    placed = quats, points[0], points[1], points[2]
    load().ash_place_texels(*map(address, (vertices, corners, barycentric)), count, threads, *map(address, placed))
    return placed


def pose(
    raw: Tensor, light: Tensor | None, surface: tuple[Tensor, ...], options: PoseOptions
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Means, quats, scales, opacities and SH (lit, but not turned) from raw parameters `[n, 11 + 3 k]`.

    `surface`: canonical positions, unit normals, quaternions and translations of the texels, constants of the graph.
    Everything is contiguous float32 on the CPU.
    """
    return _Pose.apply(options, raw, light, *surface)  # type: ignore[no-any-return]


class _Pose(Function):
    @staticmethod
    def forward(ctx: Any, options: PoseOptions, raw: Tensor, light: Tensor | None, *surface: Tensor) -> Any:
        count, coefficients = len(raw), (raw.shape[1] - 11) // 3
        shapes = (3,), (4,), (3,), (), (coefficients, 3)
        posed = tuple(torch.empty(count, *shape, device="cpu") for shape in shapes)
        canonical, normals, turns, translations = surface
        inputs = (raw, canonical, normals, turns, translations, light)
        load().ash_pose(*map(address, inputs), count, coefficients, *options, *map(address, posed))
        ctx.options = options
        ctx.save_for_backward(raw, normals, turns, light)
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        raw, _, _, light = ctx.saved_tensors
        count, coefficients = len(raw), (raw.shape[1] - 11) // 3
        given = [grad.contiguous() for grad in grads]
        grad_raw, sums = torch.empty_like(raw), (c_double * 27)()
        check_memory(
            load().ash_pose_backward(
                *map(address, ctx.saved_tensors),
                count,
                coefficients,
                *ctx.options,
                *map(address, given),
                address(grad_raw),
                sums,
            )
        )
        grad_light = None if light is None else light.new_tensor(list(sums)).reshape(9, 3)
        return None, grad_raw, grad_light, None, None, None, None
