"""Gaussians: the one thing that decoders make and the splatter draws."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Gaussians:
    """Activated 3D Gaussians (ASH Sec. 3.1; Kerbl et al. 2023), ready to be splatted."""

    means: Float[Tensor, "n 3"]  # metres, frame of the holder (canonical or posed)
    quats: Float[Tensor, "n 4"]  # wxyz; need not be unit, must not be zero
    scales: Float[Tensor, "n 3"]  # metres, standard deviation along each axis, > 0
    opacities: Float[Tensor, " n"]  # in [0, 1]
    sh: Float[Tensor, "n k 3"]  # real spherical harmonics, k = (degree + 1)^2; colour = max(0, 0.5 + sum_k sh_k Y_k(d))
