"""SPZ, version 3 (Niantic): about 20 bytes per Gaussian before gzip, y up.

Fixed point throughout: positions 24 bits, scales sixteen steps per factor e, rotations the three smallest components
in ten bits each, colours and opacities eight bits.
"""

import gzip
import math
import struct

import numpy as np

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from benchmarks.export.axes import unit_quats

MAGIC, VERSION = 0x5053474E, 3
FINEST_BITS = 20  # of a metre's fraction: a micrometre
COLOUR_SCALE = 0.15  # so that colours somewhat outside of 0..1 survive
SMALL_BITS = 9  # and a sign, per component of a rotation


def spz_bytes(gaussians: Gaussians) -> bytes:
    """The compressed file. Colours of degree 1 to 3 are kept in eight bits between -1 and 1.

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
