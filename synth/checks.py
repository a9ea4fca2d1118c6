"""Checks of clothes against the truth of a capture: what pokes through, and how far cloth is stretched."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from synth.body import Body, vertex_normals


@dataclass(frozen=True, kw_only=True, slots=True)
class Penetrations:
    """Legs that stick out of the skirt, per frame."""

    share: np.ndarray  # [t] of the leg vertices at the skirt's height, beyond the tolerance
    deepest: np.ndarray  # [t] metres


def penetrations(body: Body, posed: np.ndarray, *, tolerance: float = 0.005) -> Penetrations:
    """Measure how far legs lie outside of the skirt, against the tangent plane of the nearest cloth, for `[t, s, 3]`.

    Legs nearest to the skirt's open ends are left out: below the hem there is nothing to poke through.
    """
    surface = body.surface
    cloth = np.flatnonzero(surface.vertices_of("skirt"))
    legs = np.flatnonzero(surface.vertices_of("trousers") & ~surface.vertices_of("shoes", "shirt"))
    faces = surface.faces[np.isin(surface.faces, cloth).all(axis=1)]
    edges, uses = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    at_end = np.zeros(len(surface.vertices), dtype=bool)
    at_end[edges[uses == 1]] = True
    share, deepest = [], []
    for vertices in posed:
        normals = vertex_normals(vertices, faces)
        distance, place = cKDTree(vertices[cloth]).query(vertices[legs])
        nearest = cloth[place]
        beside = ~at_end[nearest] & (distance < 0.1)
        outside = np.sum((vertices[legs] - vertices[nearest]) * normals[nearest], axis=1)
        share.append(np.mean(outside[beside] > tolerance) if beside.any() else 0.0)
        deepest.append(max(float(outside[beside].max()), 0.0) if beside.any() else 0.0)
    return Penetrations(share=np.array(share), deepest=np.array(deepest))


def stretch(body: Body, posed: np.ndarray, *parts: str, quantile: float = 0.99) -> np.ndarray:
    """Length of the cloth's edges over their length at rest, at a quantile per frame `[t]`: 1.08 is 8 % of stretch."""
    surface = body.surface
    chosen = surface.vertices_of(*parts)
    faces = surface.faces[chosen[surface.faces].all(axis=1)]
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    rest = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    lengths = np.linalg.norm(posed[:, edges[:, 0]] - posed[:, edges[:, 1]], axis=-1)
    return np.quantile(lengths / rest, quantile, axis=1)
