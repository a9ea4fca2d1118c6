"""Garments as meshes of their own: cut from the body's faces, pushed outwards, closed at the hems by a rim.

Of the skin beneath a garment only a band behind each hem is kept: the rest could never be seen, only poke through.
"""

from dataclasses import replace

import numpy as np

from synth.person.body import PARTS, neighbour_mean, vertex_normals
from synth.person.mesh import Charted, open_edges, open_sides

THICKNESS = {"loose": {"shirt": 0.013, "trousers": 0.009}, "tight": {"shirt": 0.006, "trousers": 0.004}}
HEM = {"shirt": 0.007, "trousers": 0.004}  # metres of a garment's distance from the body at its hems
RIM = 0.006  # metres of a hem's rim in the atlas


def soft_normals(mesh: Charted) -> np.ndarray:
    """Smoothed unit normals `[s, 3]`."""
    normals = neighbour_mean(vertex_normals(mesh.vertices, mesh.faces), mesh.faces, rounds=4)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def cut_garment(bare: Charted, chosen: np.ndarray, *, name: str, fit: str) -> tuple[Charted, np.ndarray]:
    """A garment cut from the chosen faces `[f]` of the body, and the face of the body that each of its faces is from.

    It is smoothed (loose cloth also loses the body's finer shape) and pushed outwards, less towards its hems.
    """
    used, faces = np.unique(bare.faces[chosen], return_inverse=True)
    flat = Charted(
        vertices=bare.vertices[used],
        weights=bare.weights[used],
        faces=faces.reshape(-1, 3),
        uvs=bare.uvs,
        uv_faces=bare.uv_faces[chosen],
        part=np.full(int(chosen.sum()), PARTS.index(name)),
    )
    edges = open_edges(flat.faces)
    end = np.zeros(len(used), dtype=bool)
    end[edges] = True
    vertices = straightened(flat.vertices, edges)
    softness = (neighbour_mean((~end).astype(np.float64), flat.faces, rounds=3) ** 2 * ~end)[:, None]
    smooth = vertices
    for _ in range(10 if fit == "loose" else 3):
        smooth = smooth + softness * (neighbour_mean(smooth, flat.faces, rounds=1) - smooth)
    normals = soft_normals(replace(flat, vertices=smooth))
    # Smoothing shrinks; what it took along the normal is given back.
    lost = np.sum((vertices - smooth) * normals, axis=1) * ~end
    given = neighbour_mean(np.maximum(lost, 0), flat.faces, rounds=3) * ~end
    depth = np.where(end, HEM[name], THICKNESS[fit][name])
    depth = np.where(end, depth, neighbour_mean(depth, flat.faces, rounds=4))
    weights = flat.weights + softness * (neighbour_mean(flat.weights, flat.faces, rounds=3) - flat.weights)
    hung = replace(
        flat,
        vertices=smooth + (depth + given)[:, None] * normals,
        weights=weights / weights.sum(axis=1, keepdims=True),
    )
    closed, owner = rimmed(hung, vertices + 0.001 * normals)
    return closed, np.flatnonzero(chosen)[owner]


def straightened(vertices: np.ndarray, edges: np.ndarray, *, rounds: int = 12) -> np.ndarray:
    """Even out the steps of open edges `[e, 2]`, which follow the faces; Taubin's smoothing shrinks no hem."""
    result = vertices.copy()
    on = np.unique(edges)
    count = np.bincount(edges.ravel(), minlength=len(vertices))[on, None]
    for k in range(2 * rounds):
        total = np.zeros_like(result)
        np.add.at(total, edges[:, 0], result[edges[:, 1]])
        np.add.at(total, edges[:, 1], result[edges[:, 0]])
        result[on] += (0.5 if k % 2 == 0 else -0.53) * (total[on] / count - result[on])
    return result


def rimmed(mesh: Charted, inner: np.ndarray) -> tuple[Charted, np.ndarray]:
    """Close open edges by strips of faces towards the points `inner` `[s, 3]`; also the face that each face is from.

    In the atlas a strip continues its chart outwards.
    """
    sides = open_sides(mesh.faces)
    face, corner = sides // 3, sides % 3
    a, b = mesh.faces[face, corner], mesh.faces[face, (corner + 1) % 3]
    ua, ub, uc = (mesh.uv_faces[face, (corner + k) % 3] for k in range(3))
    along = mesh.uvs[ub] - mesh.uvs[ua]
    scale = np.linalg.norm(along, axis=1) / np.maximum(np.linalg.norm(inner[b] - inner[a], axis=1), 1e-9)
    away = np.stack([along[:, 1], -along[:, 0]], axis=1)
    away *= -np.sign(np.sum(away * (mesh.uvs[uc] - mesh.uvs[ua]), axis=1, keepdims=True))
    away *= (RIM * scale / np.linalg.norm(away, axis=1))[:, None]
    shift, uses = np.zeros_like(mesh.uvs), np.zeros(len(mesh.uvs))
    for end in (ua, ub):
        np.add.at(shift, end, away)
        np.add.at(uses, end, 1.0)
    on, on_uv = np.unique(np.concatenate([a, b])), np.flatnonzero(uses)
    below, below_uv = np.full(len(mesh.vertices), -1), np.full(len(mesh.uvs), -1)
    below[on] = len(mesh.vertices) + np.arange(len(on))
    below_uv[on_uv] = len(mesh.uvs) + np.arange(len(on_uv))
    strips = [np.stack([b, a, below[a]], axis=1), np.stack([b, below[a], below[b]], axis=1)]
    uv_strips = [np.stack([ub, ua, below_uv[ua]], axis=1), np.stack([ub, below_uv[ua], below_uv[ub]], axis=1)]
    closed = Charted(
        vertices=np.concatenate([mesh.vertices, inner[on]]),
        weights=np.concatenate([mesh.weights, mesh.weights[on]]),
        faces=np.concatenate([mesh.faces, *strips]),
        uvs=np.concatenate([mesh.uvs, mesh.uvs[on_uv] + shift[on_uv] / uses[on_uv, None]]),
        uv_faces=np.concatenate([mesh.uv_faces, *uv_strips]),
        part=np.concatenate([mesh.part, mesh.part[face], mesh.part[face]]),
    )
    return closed, np.concatenate([np.arange(len(mesh.faces)), face, face])
