"""PLY as 3D Gaussian splatting writes it (Kerbl et al. 2023): 62 floats per Gaussian, y down."""

import numpy as np
import torch

from ash.gaussians.gaussians import Gaussians
from benchmarks.export.axes import HALF_TURN_ABOUT_X, turned, unit_quats

COEFFICIENTS = 16  # Readers expect degree 3; what is missing is zero.
FIELDS = (
    "x", "y", "z", "nx", "ny", "nz",
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * (COEFFICIENTS - 1))),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)  # fmt: skip
OPACITY_MARGIN = 1e-6  # A logit is finite inside (0, 1) only.
LEAST_SCALE = 1e-9  # metres; a logarithm is finite above zero only


def ply_bytes(gaussians: Gaussians) -> bytes:
    """Binary little-endian PLY: opacities as logits, scales as logarithms, rotations wxyz, colours by channel."""
    down = turned(gaussians, HALF_TURN_ABOUT_X)
    count = len(down.means)
    rest = torch.zeros(count, COEFFICIENTS - 1, 3)
    rest[:, : down.sh.shape[1] - 1] = down.sh[:, 1:]
    columns = [
        down.means,
        torch.zeros(count, 3),
        down.sh[:, 0],
        rest.transpose(1, 2).reshape(count, -1),
        down.opacities.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN).logit()[:, None],
        down.scales.clamp(min=LEAST_SCALE).log(),
        unit_quats(down),
    ]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    head += [*(f"property float {name}" for name in FIELDS), "end_header\n"]
    return "\n".join(head).encode() + torch.cat(columns, dim=1).numpy().astype(np.dtype("<f4")).tobytes()
