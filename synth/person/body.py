"""Bodies: a clothed rest surface with skeleton, UVs, parts and skin weights, and the coarser template cut from it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array

from ash.capture.dataset import Skeleton, TemplateMesh

PARTS = ("skin", "hair", "eyes", "shirt", "trousers", "skirt", "shoes")
CLOTHES = ("shirt", "trousers", "skirt")


@dataclass(frozen=True, kw_only=True, slots=True)
class Surface:
    """A triangle mesh with UVs and a part label per face (index into `PARTS`)."""

    vertices: np.ndarray  # [s, 3] float64, metres, rest pose
    faces: np.ndarray  # [f, 3] int64
    uvs: np.ndarray  # [u, 2] float64
    uv_faces: np.ndarray  # [f, 3] int64
    part: np.ndarray  # [f] int64

    def vertices_of(self, *parts: str) -> np.ndarray:
        """Which vertices touch a face of the given parts, `[s]` bool."""
        chosen = np.zeros(len(self.vertices), dtype=bool)
        chosen[self.faces[np.isin(self.part, [PARTS.index(part) for part in parts])]] = True
        return chosen


@dataclass(frozen=True, kw_only=True, slots=True)
class Face:
    """Where the face lies, at rest, for the painter."""

    eyes: np.ndarray  # [2, 3] metres, left and right
    mouth: np.ndarray  # [3] metres
    modelled: bool  # eyeballs and lips are geometry, not only paint
    nape: float = 0.98  # slope of the hairline of a modelled head


@dataclass(frozen=True, kw_only=True, slots=True)
class Body:
    """The true rest surface, and which of its vertices and faces the template keeps."""

    skeleton: Skeleton
    surface: Surface
    skin_weights: np.ndarray  # [s, j] float64, rows sum to 1
    face: Face
    template_to_surface: np.ndarray  # [v] int64
    template_faces: np.ndarray  # [g, 3] int64 into the template's vertices
    template_uv_faces: np.ndarray  # [g, 3] int64 into the surface's uvs
    cage: np.ndarray  # [k] int64: the surface vertices of loose cloth that are simulated; the others lie between them
    cage_faces: np.ndarray  # [h, 3] int64 into the cage

    def scalp(self, points: np.ndarray) -> np.ndarray:
        """How far rest points `[n, 3]` lie inside the hair, metres: behind a slanted hairline and not on the ears."""
        x, y, z = (points - self.face.eyes.mean(axis=0)).T
        if not self.face.modelled:
            return (y - 0.116 - 1.1 * z) / 1.5
        above = (y - 0.062 - self.face.nape * z) / 1.4
        ears = np.hypot((y + 0.012) / 1.15, z + 0.088) - 0.038
        return np.where(np.abs(x) > 0.06, np.minimum(above, ears), above)

    def collar(self, points: np.ndarray) -> np.ndarray:
        """How far rest points `[n, 3]` lie outside of the collar, metres."""
        neck = self.skeleton.heads[self.skeleton.names.index("neck")]
        return np.linalg.norm((points - neck) * [1, 0.8, 1], axis=1) - 0.092

    def template(self, offset: np.ndarray | None = None) -> TemplateMesh:
        """The template mesh: its vertices, moved by `offset` `[v, 3]` metres."""
        used, uv_faces = np.unique(self.template_uv_faces, return_inverse=True)
        vertices = self.surface.vertices[self.template_to_surface]
        return TemplateMesh(
            vertices=vertices if offset is None else vertices + offset,
            faces=self.template_faces,
            uvs=self.surface.uvs[used],
            uv_faces=uv_faces.reshape(self.template_uv_faces.shape),
            skin_weights=self.skin_weights[self.template_to_surface],
        )


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals `[s, 3]` of a mesh."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for axis in range(3):
        for k in range(3):
            normals[:, axis] += np.bincount(faces[:, k], weights=face_normals[:, axis], minlength=len(vertices))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def neighbour_mean(values: np.ndarray, faces: np.ndarray, *, rounds: int) -> np.ndarray:
    """Smooth values `[s, ...]` over the mesh: the mean over each vertex and its neighbours, some rounds of it."""
    operator = _averaging(len(values), faces.tobytes())
    flat = values.reshape(len(values), -1).astype(np.float64)
    for _ in range(rounds):
        flat = operator @ flat
    return flat.reshape(values.shape)


@lru_cache(maxsize=8)
def _averaging(count: int, faces: bytes) -> csr_array:
    """The sparse operator that replaces a value by the mean over the vertex and its neighbours."""
    corners = np.frombuffer(faces, dtype=np.int64).reshape(-1, 3)
    rows, columns = corners[:, [0, 1, 2, 1, 2, 0]].ravel(), corners[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = csr_array(coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count)))
    links.data[:] = 1.0
    links = csr_array(links + eye_array(count))
    links.data /= np.repeat(np.diff(links.indptr), np.diff(links.indptr))
    return links
