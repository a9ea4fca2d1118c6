"""`.splat` as antimatter15's viewer and its successors read it: 32 bytes per Gaussian, no view dependence, y down."""

import numpy as np

from ash.gaussians.gaussians import Gaussians
from ash.harmonics import SH_C0
from benchmarks.export.axes import HALF_TURN_ABOUT_X, turned, unit_quats

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def splat_bytes(gaussians: Gaussians) -> bytes:
    """Colour is that of degree 0, cut to 0..1; opacities and rotations (wxyz) have eight bits. Most visible first."""
    down = turned(gaussians, HALF_TURN_ABOUT_X)
    records = np.zeros(len(down.means), dtype=RECORD)
    records["means"], records["scales"] = down.means.numpy(), down.scales.numpy()
    records["rgba"][:, :3] = _eight_bits(255 * (0.5 + SH_C0 * down.sh[:, 0].numpy()))
    records["rgba"][:, 3] = _eight_bits(255 * down.opacities.numpy())
    records["quats"] = _eight_bits(128 + 128 * unit_quats(down).numpy())
    size = down.opacities * down.scales.prod(dim=1)
    return records[np.argsort(-size.numpy(), kind="stable")].tobytes()


def _eight_bits(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)
