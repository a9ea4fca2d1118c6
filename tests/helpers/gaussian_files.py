"""Files of Gaussians read back without a line of ours that wrote them: by other programs' readers where they exist."""

import gzip
import io
import math
import struct

import numpy as np
import torch
from plyfile import PlyData
from pygltflib import GLTF2, BufferFormat

from ash.gaussians.gaussians import Gaussians
from benchmarks.export.gaussians import HALF_TURN_ABOUT_X, turned


def read_ply(content: bytes) -> Gaussians:
    """By plyfile; turned back from y down."""
    rows = PlyData.read(io.BytesIO(content))["vertex"]

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([rows[name] for name in names], axis=1).astype(np.float32))

    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(1, 2)
    down = Gaussians(
        means=columns("x", "y", "z"),
        quats=columns(*(f"rot_{i}" for i in range(4))),
        scales=columns(*(f"scale_{i}" for i in range(3))).exp(),
        opacities=columns("opacity")[:, 0].sigmoid(),
        sh=torch.cat([columns(*(f"f_dc_{i}" for i in range(3)))[:, None], rest], 1).contiguous(),
    )
    return turned(down, HALF_TURN_ABOUT_X)


def read_spz(content: bytes) -> Gaussians:
    """Number by number, as the format's description says."""
    raw = gzip.decompress(content)
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", raw)
    assert (magic, version, flags) == (0x5053474E, 3, 0) and raw[:4] == b"NGSP"
    at = 16

    def take(width: int) -> np.ndarray:
        nonlocal at
        part = np.frombuffer(raw, dtype=np.uint8, count=count * width, offset=at).reshape(count, width)
        at += count * width
        return part.astype(np.int64)

    triples = take(9).reshape(count, 3, 3)
    fixed = triples @ np.array([1, 256, 65536])
    means = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / 2.0**bits
    opacities, colours, scales = take(1)[:, 0] / 255, take(3) / 255, np.exp(take(3) / 16 - 10)
    packed = take(4) @ np.array([1, 1 << 8, 1 << 16, 1 << 24])
    quats = np.zeros((count, 4))
    for row, word in enumerate(packed.tolist()):
        largest = word >> 30
        for component in (3, 2, 1, 0):
            if component != largest:
                size = (word & 511) / 511 * math.sqrt(0.5)
                quats[row, component] = -size if word >> 9 & 1 else size
                word >>= 10
        quats[row, largest] = math.sqrt(max(0.0, 1 - (quats[row] ** 2).sum()))
    higher = (take(3 * ((degree + 1) ** 2 - 1)).reshape(count, -1, 3) - 128) / 128
    assert at == len(raw)
    sh = np.concatenate([((colours - 0.5) / 0.15)[:, None], higher], axis=1)
    tensors = [means, quats[:, [3, 0, 1, 2]], scales, opacities, sh]
    return Gaussians(**dict(zip(("means", "quats", "scales", "opacities", "sh"), map(_float32, tensors), strict=True)))


def read_gltf(content: bytes) -> Gaussians:
    """By pygltflib: binary, or JSON with its numbers in base64."""
    document = GLTF2.load_from_bytes(content) if content[:4] == b"glTF" else GLTF2.from_json(content.decode())
    document.convert_buffers(BufferFormat.BINARYBLOB)
    (primitive,) = document.meshes[0].primitives
    assert primitive.mode == 0 and document.extensionsUsed == ["KHR_gaussian_splatting"]
    kernel = primitive.extensions["KHR_gaussian_splatting"]
    assert kernel["kernel"] == "ellipse" and kernel["colorSpace"] == "srgb_rec709_display"
    names = {name: index for name, index in vars(primitive.attributes).items() if index is not None}

    def values(name: str) -> torch.Tensor:
        accessor = document.accessors[names[name]]
        view, width = document.bufferViews[accessor.bufferView], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = view.byteOffset + (accessor.byteOffset or 0)
        assert accessor.componentType == 5126
        flat = np.frombuffer(document.binary_blob(), "<f4", count=accessor.count * width, offset=start)
        return torch.from_numpy(flat.reshape(accessor.count, width).copy())

    def own(name: str) -> torch.Tensor:
        return values(f"KHR_gaussian_splatting:{name}")

    coefficients = [(l, m) for l in range(4) for m in range(2 * l + 1)]
    present = [(l, m) for l, m in coefficients if f"KHR_gaussian_splatting:SH_DEGREE_{l}_COEF_{m}" in names]
    return Gaussians(
        means=values("POSITION"),
        quats=own("ROTATION")[:, [3, 0, 1, 2]],
        scales=own("SCALE"),
        opacities=own("OPACITY")[:, 0],
        sh=torch.stack([own(f"SH_DEGREE_{l}_COEF_{m}") for l, m in present], 1),
    )


def _float32(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
