"""Gaussians as files: PLY of 3D Gaussian splatting, and SPZ.

Our world is right-handed, x to the person's left, y up, z out of the chest; PLY has y down, as scenes from COLMAP do.
"""

import gzip
import math
import struct
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.harmonics import rotate_sh
from ash.rotations import quat_multiply, rotate

HALF_TURN_ABOUT_X = (0.0, 1.0, 0.0, 0.0)  # wxyz: y up becomes y down


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


MAGIC, VERSION = 0x5053474E, 3
FINEST_BITS = 20  # of a metre's fraction: a micrometre
COLOUR_SCALE = 0.15  # so that colours somewhat outside of 0..1 survive
SMALL_BITS = 9  # and a sign, per component of a rotation


def spz_bytes(gaussians: Gaussians) -> bytes:
    """SPZ, version 3 (Niantic): about 20 bytes per Gaussian before gzip, y up.

    Fixed point throughout: positions 24 bits, scales sixteen steps per factor e, rotations the three smallest
    components in ten bits each, colours and opacities eight bits; colours of degree 1 to 3 between -1 and 1.

    Raises:
        InputError: a Gaussian lies farther than four kilometres from the origin.
    """
    means, sh = gaussians.means.numpy(), gaussians.sh.numpy()
    bits = _fraction_bits(means)
    degree = math.isqrt(sh.shape[1]) - 1
    parts = [
        struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree, bits, 0, 0),
        _fixed_point(means, bits),
        _eight_bits(255 * gaussians.opacities.numpy()),
        _eight_bits(255 * (0.5 + COLOUR_SCALE * sh[:, 0])),
        _eight_bits(16 * (10 + np.log(np.maximum(gaussians.scales.numpy(), 1e-9)))),
        _smallest_three(unit_quats(gaussians).numpy()),
        _eight_bits(128 + 128 * sh[:, 1:]),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def _fraction_bits(means: np.ndarray) -> int:
    """The most bits behind the point with which all positions fit into 24."""
    reach = float(np.abs(means).max(initial=0.0))
    if not reach < 1 << 12:
        raise InputError(f"positions: expected at most 4096 m from the origin, got {reach:.0f}")
    return min(FINEST_BITS, 22 - math.frexp(reach)[1])


def _fixed_point(means: np.ndarray, bits: int) -> bytes:
    whole = np.rint(means.astype(np.float64) * (1 << bits)).astype("<i4")
    return whole.reshape(-1, 1).view(np.uint8)[:, :3].tobytes()


def _eight_bits(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()


def _smallest_three(quats: np.ndarray) -> bytes:
    """Which component (xyzw) is largest in the two highest bits, then sign and size of the others in their order."""
    xyzw = quats[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for component in range(4):
        value = xyzw[:, component]
        size = np.rint(np.abs(value) * math.sqrt(2) * ((1 << SMALL_BITS) - 1)).astype(np.uint32)
        field = (value < 0).astype(np.uint32) << SMALL_BITS | size
        packed = np.where(largest == component, packed, packed << (SMALL_BITS + 1) | field)
    return packed.astype("<u4").tobytes()
