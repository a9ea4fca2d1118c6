"""Our world in the axes of others. Ours is right-handed, x to the person's left, y up, z out of the chest."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ash.gaussians.gaussians import Gaussians
from ash.harmonics import rotate_sh
from ash.rotations import quat_multiply, rotate

HALF_TURN_ABOUT_X = (0.0, 1.0, 0.0, 0.0)  # wxyz: y up becomes y down, as in scenes that COLMAP reconstructs


def turned(gaussians: Gaussians, quat: tuple[float, float, float, float]) -> Gaussians:
    """The Gaussians in a world that is turned by a unit quaternion (wxyz), the colours of directions with it."""
    every: Float[Tensor, "n 4"] = torch.tensor(quat).expand(len(gaussians.means), 4)
    return replace(
        gaussians,
        means=rotate(every, gaussians.means),
        quats=quat_multiply(every, gaussians.quats),
        sh=rotate_sh(every, gaussians.sh),
    )


def unit_quats(gaussians: Gaussians) -> Float[Tensor, "n 4"]:
    """Rotations as unit quaternions (wxyz): the splatter takes any length, files do not."""
    return torch.nn.functional.normalize(gaussians.quats, dim=-1)
