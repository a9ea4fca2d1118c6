"""Checks of clothes against the truth of a capture: what pokes through, and how far cloth is stretched."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from synth.cloth.layers import layers_of, outside
from synth.cloth.xpbd import edges_of
from synth.person.body import Body


@dataclass(frozen=True, kw_only=True, slots=True)
class Penetrations:
    """What sticks out of the garments that should hide it, per frame."""

    share: np.ndarray  # [t] of the hidden vertices that lie near a garment, beyond the tolerance
    deepest: np.ndarray  # [t] metres


def penetrations(body: Body, posed: np.ndarray, *, tolerance: float = 0.005) -> Penetrations:
    """Measure how far skin and inner garments lie outside of shirt, trousers and skirt, for `[t, s, 3]`.

    Against the tangent plane of the nearest cloth; beside hems nothing is hidden, so nothing counts.
    """
    layers = layers_of(body)
    share, deepest = [], []
    for vertices in posed:
        sides = [outside(layer, vertices, reach=0.1) for layer in layers]
        heights = np.concatenate([np.zeros(0), *(height[near] for height, _, near in sides)])
        share.append(np.mean(heights > tolerance) if len(heights) else 0.0)
        deepest.append(max(float(heights.max(initial=0.0)), 0.0))
    return Penetrations(share=np.array(share), deepest=np.array(deepest))


def stretch(body: Body, posed: np.ndarray, *parts: str, quantile: float = 0.99) -> np.ndarray:
    """Length of the cloth's edges over their length at rest, at a quantile per frame `[t]`: 1.08 is 8 % of stretch."""
    surface = body.surface
    chosen = surface.vertices_of(*parts)
    faces = surface.faces[chosen[surface.faces].all(axis=1)]
    edges = edges_of(faces)
    rest = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    lengths = np.linalg.norm(posed[:, edges[:, 0]] - posed[:, edges[:, 1]], axis=-1)
    return np.quantile(lengths / rest, quantile, axis=1)


def self_intersections(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles `[f]` bool of a mesh are pierced by an edge that they share no vertex with."""
    middles = vertices[faces].mean(axis=1)
    size = np.linalg.norm(vertices[faces] - middles[:, None], axis=-1).max()
    edges = edges_of(faces)
    ends = vertices[edges]
    half = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max() / 2
    near = cKDTree(ends.mean(axis=1)).query_ball_point(middles, size + half)
    face = np.repeat(np.arange(len(faces)), [len(close) for close in near])
    edge = np.concatenate([np.array(close, dtype=np.int64) for close in near])
    strange = (faces[face][:, :, None] != edges[edge][:, None, :]).all(axis=(1, 2))
    face, edge = face[strange], edge[strange]
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    start, end = ends[edge, 0], ends[edge, 1]
    # Moeller and Trumbore (1997), for a segment.
    u, v, along = b - a, c - a, end - start
    p = np.cross(along, v)
    scale = np.einsum("na,na->n", u, p)
    safe = np.where(np.abs(scale) < 1e-15, np.inf, scale)
    q = np.cross(start - a, u)
    x = np.einsum("na,na->n", start - a, p) / safe
    y = np.einsum("na,na->n", along, q) / safe
    t = np.einsum("na,na->n", v, q) / safe
    result = np.zeros(len(faces), dtype=bool)
    result[face[np.isfinite(safe) & (x > 0) & (y > 0) & (x + y < 1) & (t > 0) & (t < 1)]] = True
    return result
