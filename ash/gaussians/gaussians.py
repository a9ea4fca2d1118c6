"""Gaussians: the one thing that decoders make and the splatter draws."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ash.config import ModelConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class Gaussians:
    """Activated 3D Gaussians (ASH Sec. 3.1; Kerbl et al. 2023), ready to be splatted."""

    means: Float[Tensor, "n 3"]  # metres, frame of the holder (canonical or posed)
    quats: Float[Tensor, "n 4"]  # wxyz; need not be unit, must not be zero
    scales: Float[Tensor, "n 3"]  # metres, standard deviation along each axis, > 0
    opacities: Float[Tensor, " n"]  # in [0, 1]
    sh: Float[Tensor, "n k 3"]  # real spherical harmonics, k = (degree + 1)^2; colour = max(0, 0.5 + sum_k sh_k Y_k(d))


GEOMETRY_CHANNELS = 11  # offset 3, log-scale 3, quaternion 4, opacity logit 1


def raw_channels(config: ModelConfig) -> int:
    """Raw parameters per Gaussian: `GEOMETRY_CHANNELS`, then rgb for each spherical harmonic."""
    return GEOMETRY_CHANNELS + 3 * (config.sh_degree + 1) ** 2


def split_raw(raw: Float[Tensor, "n o"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Raw parameters: offset `[n, 3]` (in `offset_unit_m`), log-scale `[n, 3]`, quaternion `[n, 4]`, logit `[n]`, SH
    `[n, k, 3]`."""
    offset, log_scales, quats, logits = raw[:, :GEOMETRY_CHANNELS].split([3, 3, 4, 1], dim=1)
    return offset, log_scales, quats, logits.squeeze(1), raw[:, GEOMETRY_CHANNELS:].unflatten(1, (-1, 3))
