"""glTF 2.0: Gaussians by the extension KHR_gaussian_splatting, and the textured mesh; y up, metres.

A file is binary (.glb), or JSON that holds its numbers in base64 (.gltf).
"""

import base64
import io
import json
import struct

import numpy as np
from PIL import Image

from ash.gaussians.gaussians import Gaussians
from ash.harmonics import SH_C0
from ash.protocol import DressedMesh
from benchmarks.export.gaussians import unit_quats

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
CLAMP_TO_EDGE = 33071
UNLIT = "KHR_materials_unlit"  # The light is in the texture.


def gaussians_gltf(gaussians: Gaussians, *, binary: bool) -> bytes:
    """Points with the attributes of the ellipse kernel: rotation xyzw, scale in metres, opacity in 0..1, SH in sRGB.

    Viewers that do not know the extension see coloured points.
    """
    buffer, sh = GltfBuffer(), gaussians.sh.numpy()
    attributes = {
        "POSITION": buffer.add(gaussians.means.numpy(), "VEC3", bounds=True),
        "COLOR_0": buffer.add(_point_colours(gaussians), "VEC4"),
        f"{EXTENSION}:ROTATION": buffer.add(unit_quats(gaussians).numpy()[:, [1, 2, 3, 0]], "VEC4"),
        f"{EXTENSION}:SCALE": buffer.add(gaussians.scales.numpy(), "VEC3"),
        f"{EXTENSION}:OPACITY": buffer.add(gaussians.opacities.numpy(), "SCALAR"),
    }
    for index in range(sh.shape[1]):
        degree = int(np.sqrt(index))
        name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index - degree**2}"
        attributes[name] = buffer.add(np.ascontiguousarray(sh[:, index]), "VEC3")
    kernel = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: kernel}}
    return buffer.pack(_document(primitive) | {"extensionsUsed": [EXTENSION]}, binary=binary)


def _point_colours(gaussians: Gaussians) -> np.ndarray:
    colours = (0.5 + SH_C0 * gaussians.sh[:, 0].numpy()).clip(0, 1)
    return np.concatenate([colours, gaussians.opacities.numpy()[:, None]], axis=1).astype(np.float32)


def mesh_gltf(mesh: DressedMesh, *, binary: bool) -> bytes:
    """The mesh with its texture, shown as it is, without lamps. glTF's v runs down, as rows do."""
    pairs, corners = np.unique(
        np.stack([mesh.faces.ravel(), mesh.uv_faces.ravel()], axis=1), axis=0, return_inverse=True
    )
    buffer, png = GltfBuffer(), io.BytesIO()
    Image.fromarray(mesh.texture).save(png, format="PNG")
    attributes = {
        "POSITION": buffer.add(mesh.vertices[pairs[:, 0]].astype(np.float32), "VEC3", bounds=True),
        "NORMAL": buffer.add(mesh.normals[pairs[:, 0]].astype(np.float32), "VEC3"),
        "TEXCOORD_0": buffer.add((mesh.uvs[pairs[:, 1]] * [1, -1] + [0, 1]).astype(np.float32), "VEC2"),
    }
    indices = buffer.add(corners.reshape(-1).astype(np.uint32), "SCALAR")
    surface = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    document = _document({"attributes": attributes, "indices": indices, "material": 0}) | {
        "extensionsUsed": [UNLIT],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {UNLIT: {}}}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}],
        "images": [{"bufferView": buffer.raw(png.getvalue()), "mimeType": "image/png"}],
    }
    return buffer.pack(document, binary=binary)


def _document(primitive: dict) -> dict:
    return {
        "asset": {"version": "2.0", "generator": "ash-bench"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "avatar"}],
        "meshes": [{"primitives": [primitive]}],
    }


COMPONENT_TYPES = {"float32": 5126, "uint32": 5125}


class GltfBuffer:
    """The numbers of a glTF file and the accessors into them."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def raw(self, content: bytes) -> int:
        """Append bytes as a buffer view of their own, and return its index."""
        self.content += b"\0" * (-len(self.content) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)})
        self.content += content
        return len(self.views) - 1

    def add(self, array: np.ndarray, kind: str, *, bounds: bool = False) -> int:
        """Append an array as an accessor of glTF type `kind`, with its bounds where glTF asks for them; its index."""
        accessor = {
            "bufferView": self.raw(np.ascontiguousarray(array).tobytes()),
            "componentType": COMPONENT_TYPES[str(array.dtype)],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def pack(self, document: dict, *, binary: bool) -> bytes:
        """The whole file: the document, completed by what was added, and the numbers."""
        self.content += b"\0" * (-len(self.content) % 4)
        whole: dict = {"byteLength": len(self.content)}
        if not binary:
            whole["uri"] = f"data:application/octet-stream;base64,{base64.b64encode(self.content).decode()}"
        document = {**document, "buffers": [whole], "bufferViews": self.views, "accessors": self.accessors}
        text = json.dumps(document, separators=(",", ":")).encode()
        if not binary:
            return text
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.content)
        head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.content), b"BIN\0") + bytes(self.content)
