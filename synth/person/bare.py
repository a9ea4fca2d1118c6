"""The body without clothes: what a body model fitted to the person would give a method instead of its scan."""

import hashlib
import inspect
import sys

import numpy as np

from ash.capture.dataset import TemplateMesh
from ash.capture.formats import read_template, write_template
from ash.files import InputError
from synth.person import dressing, mesh
from synth.person.anny_body import bake_key, baked_body, cache_folder
from synth.person.body import CLOTHES, vertex_normals
from synth.person.cast import subject
from synth.person.mannequin import mannequin
from synth.person.mesh import decimate, pack
from synth.scene import Scene
from synth.skeleton import JOINTS

MANNEQUIN_CLOTH = 0.008  # metres that the mannequin's clothes lie above its skin


def bare_template(scene: Scene) -> TemplateMesh:
    """The naked rest mesh of the scene's body, with an atlas and skin weights of its own."""
    return _bare_mannequin() if scene.body == "mannequin" else _bare_anny(scene.subject)


def _bare_mannequin() -> TemplateMesh:
    body = mannequin(skirt=False)
    surface = body.surface
    inwards = surface.vertices_of(*CLOTHES)[:, None] * vertex_normals(surface.vertices, surface.faces)
    return body.template(-MANNEQUIN_CLOTH * inwards[body.template_to_surface])


def _bare_anny(number: int) -> TemplateMesh:
    source = "".join(inspect.getsource(module) for module in (sys.modules[__name__], dressing, mesh))
    key = hashlib.sha256(f"{bake_key(subject(number).shape)} {source}".encode()).hexdigest()[:12]
    path = cache_folder() / f"bare-{key}.npz"
    if path.is_file():
        try:
            return read_template(path, joints=len(JOINTS))
        except InputError:
            path.unlink()
    write_template(path, _undressed(number))
    return read_template(path, joints=len(JOINTS))


def _undressed(number: int) -> TemplateMesh:
    body, chart, density = dressing.body_parts(baked_body(number))
    body = pack(body, chart, density, gutter=0.004)
    faces, uv_faces = decimate(body, target=dressing.TEMPLATE_VERTICES, keep=np.ones(len(body.vertices)))
    used, corners = np.unique(faces, return_inverse=True)
    uvs_used, uv_corners = np.unique(uv_faces, return_inverse=True)
    return TemplateMesh(
        vertices=body.vertices[used],
        faces=corners.reshape(-1, 3),
        uvs=body.uvs[uvs_used],
        uv_faces=uv_corners.reshape(-1, 3),
        skin_weights=body.weights[used],
    )
