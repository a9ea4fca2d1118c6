"""Real spherical harmonics up to degree 3, in the order and signs of 3D Gaussian splatting (Kerbl et al. 2023)."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from ash.rotations import unitquat_to_rotmat

SH_C0 = 0.28209479177387814


def sh_basis(directions: Float[Tensor, "*n 3"], degree: int) -> Float[Tensor, "*n k"]:
    """Y_lm of unit directions for l = 0..degree, m = -l..l inside: `k = (degree + 1)^2` values."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, -1)


def rotate_sh(quats: Float[Tensor, "n 4"], sh: Float[Tensor, "n k 3"]) -> Float[Tensor, "n k 3"]:
    """Turn functions on the sphere: the result at direction d is the input at R(quats)^-1 d.

    Degree by degree, each row's coefficients are fitted to its values at a few fixed directions; harmonics of one
    degree are closed under rotation, so that the fit is exact.
    """
    turned, matrices = [sh[:, :1]], unitquat_to_rotmat(quats)
    for degree in range(1, _degree_of(sh.shape[1]) + 1):
        directions, fit = sampling(degree)
        directions, fit = directions.to(sh), fit.to(sh)
        count = 2 * degree + 1
        basis = sh_basis(directions @ matrices, degree)[..., -count:]  # d R = R^-1 d
        turned.append(fit @ (basis @ sh[:, degree**2 : (degree + 1) ** 2]))
    return torch.cat(turned, 1)


def _degree_of(count: int) -> int:
    return {1: 0, 4: 1, 9: 2, 16: 3}[count]


@cache
def sampling(degree: int) -> tuple[Tensor, Tensor]:
    """Directions on a Fibonacci sphere, and the matrix from values there to the coefficients of one degree."""
    count = 2 * (2 * degree + 1)
    index = torch.arange(count, dtype=torch.float64, device="cpu") + 0.5
    z = 1 - 2 * index / count
    angle = index * torch.pi * (1 + 5**0.5)
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], -1)
    return directions, torch.linalg.pinv(sh_basis(directions, degree)[:, -(2 * degree + 1) :])
