"""Binary glTF 2.0: Gaussians by the extension KHR_gaussian_splatting, and the dressed mesh; y up, metres."""

import io

import numpy as np
from PIL import Image

from ash.gaussians.gaussians import Gaussians
from ash.harmonics import SH_C0
from ash.protocol import DressedMesh
from benchmarks.export.axes import unit_quats
from synth.readers.export import GlbBuffer

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0
CLAMP_TO_EDGE = 33071
UNLIT = "KHR_materials_unlit"  # The light is in the texture.


def gaussians_glb(gaussians: Gaussians) -> bytes:
    """Points with the attributes of the ellipse kernel: rotation xyzw, scale in metres, opacity in 0..1, SH in sRGB.

    Viewers that do not know the extension see coloured points.
    """
    buffer, sh = GlbBuffer(), gaussians.sh.numpy()
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
    return buffer.pack(_document(primitive) | {"extensionsUsed": [EXTENSION]})


def _point_colours(gaussians: Gaussians) -> np.ndarray:
    colours = (0.5 + SH_C0 * gaussians.sh[:, 0].numpy()).clip(0, 1)
    return np.concatenate([colours, gaussians.opacities.numpy()[:, None]], axis=1).astype(np.float32)


def mesh_glb(mesh: DressedMesh) -> bytes:
    """The mesh with its texture, shown as it is, without lamps. glTF's v runs down, as rows do."""
    pairs, corners = np.unique(
        np.stack([mesh.faces.ravel(), mesh.uv_faces.ravel()], axis=1), axis=0, return_inverse=True
    )
    buffer, png = GlbBuffer(), io.BytesIO()
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
    return buffer.pack(document)


def _document(primitive: dict) -> dict:
    return {
        "asset": {"version": "2.0", "generator": "ash-bench"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "avatar"}],
        "meshes": [{"primitives": [primitive]}],
    }
