"""The native kernels of Stg. 2 and Eq. 5: a texel's place on its triangle, and raw parameters to Gaussians.

On one thread, `pose` saves 13 of 48 ms of a training step with 30,569 texels and no SH, `turn_sh` 45 of 193 ms of one
with 7,405 texels and SH of degree 3, and `place_texels` 4.4 of 16 ms of a played frame.
"""

from ctypes import c_double
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.harmonics import sampling
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


def turn_sh(quats: Tensor, sh: Tensor, *, threads: int) -> Tensor:
    """`ash.harmonics.rotate_sh` of contiguous float32 tensors on the CPU; differentiable in `sh` alone."""
    return _TurnSh.apply(quats, sh, threads)  # type: ignore[no-any-return]


class _TurnSh(Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, sh: Tensor, threads: int) -> Tensor:
        ctx.save_for_backward(quats)
        ctx.threads = threads
        return _turned(quats, sh, inverse=0, threads=threads)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        # The harmonics are orthonormal: a rotation of their coefficients is orthogonal, its transpose the turn back.
        (quats,) = ctx.saved_tensors
        return None, _turned(quats, grad.contiguous(), inverse=1, threads=ctx.threads), None


def _turned(quats: Tensor, sh: Tensor, *, inverse: int, threads: int) -> Tensor:
    directions, fits = _tables()
    turned = torch.empty_like(sh)
    inputs = map(address, (quats, sh, directions, fits))
    load().ash_turn_sh(*inputs, len(sh), sh.shape[1], inverse, threads, address(turned))
    return turned


@cache
def _tables() -> tuple[Tensor, Tensor]:
    """Directions, and matrices from values there to coefficients, of degrees 1 to 3, one after the other."""
    tables = [sampling(degree) for degree in (1, 2, 3)]
    directions, fits = (torch.cat([part.float().flatten() for part in parts]) for parts in zip(*tables, strict=True))
    return directions, fits


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
