"""What lies beneath a garment, and how it stays there: cloth keeps its shape and length, what it hides yields."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from synth.person.body import PARTS, Body, vertex_normals
from synth.person.mesh import open_edges
from synth.skeleton import SIDES

GAP = 0.003  # metres between a garment and what it hides
MOST = 0.03  # metres that anything is pressed in
REACH = 0.06  # metres from a garment to what it can hide in a frame


@dataclass(frozen=True, kw_only=True, slots=True)
class Layer:
    """A garment and what it hides."""

    garment: np.ndarray  # [c] surface vertices
    faces: np.ndarray  # [f, 3] into `garment`
    open: np.ndarray  # [c] bool: at a hem, beside which there is nothing to hide under
    hidden: np.ndarray  # [h] surface vertices
    gap: np.ndarray  # [h] metres that they keep: GAP, or what there is at rest
    over: np.ndarray | None = None  # [h] which of the garment lies over them, where that is always the same


def beneath(body: Body) -> np.ndarray:
    """The surface vertices of legs, hips and trunk, that a skirt or dress can touch, `[s]` bool."""
    lower = ("pelvis", "spine", "chest", *(f"{bone}_{side}" for bone in ("thigh", "shin") for side in SIDES))
    share = body.skin_weights[:, [body.skeleton.names.index(name) for name in lower]].sum(axis=1)
    top = body.surface.vertices[body.surface.vertices_of("skirt"), 1].max()
    return (share > 0.5) & ~body.surface.vertices_of("skirt") & (body.surface.vertices[:, 1] < top + 0.05)


def layers_of(body: Body) -> list[Layer]:
    """The body's garments from the inside out: trousers over skin, the shirt over both, a skirt over everything."""
    surface = body.surface
    result = []
    for name, others in (("trousers", ("skin",)), ("shirt", ("skin", "trousers")), ("skirt", ())):
        chosen = surface.part == PARTS.index(name)
        if not chosen.any():
            continue
        garment, corners = np.unique(surface.faces[chosen], return_inverse=True)
        at_hem = np.zeros(len(garment), dtype=bool)
        at_hem[open_edges(corners.reshape(-1, 3))] = True
        hidden = np.flatnonzero(surface.vertices_of(*others) if others else beneath(body))
        layer = Layer(
            garment=garment,
            faces=corners.reshape(-1, 3),
            open=at_hem,
            hidden=hidden,
            gap=np.full(len(hidden), GAP),
        )
        if others:
            # A hand near a shirt is not hidden by it: what lies beneath at rest is. Legs are so under any skirt.
            height, _, near = outside(layer, surface.vertices)
            under = near & (height < -0.0005)
            over = cKDTree(surface.vertices[garment]).query(surface.vertices[hidden])[1]
            gap = np.clip(-height, 0, GAP)
            layer = replace(layer, hidden=hidden[under], gap=gap[under], over=over[under])
        result.append(layer)
    return result


def tuck_in(layers: list[Layer], posed: np.ndarray) -> np.ndarray:
    """Press what sticks out of the garments of one frame `[s, 3]` back beneath them, by `MOST` metres at most."""
    result = posed.copy()
    for layer in layers:
        height, normals, near = outside(layer, result)
        press = np.where(near, np.clip(height + layer.gap, 0, MOST), 0)
        result[layer.hidden] -= press[:, None] * normals
    return result


def outside(layer: Layer, vertices: np.ndarray, *, reach: float = REACH) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far the hidden vertices lie outside of the garment `[h]`, its normal there `[h, 3]`, and where it is near."""
    cloth, inner = vertices[layer.garment], vertices[layer.hidden]
    normals = vertex_normals(cloth, layer.faces)
    if layer.over is None:
        distance, place = cKDTree(cloth).query(inner)
    else:
        place = layer.over
        distance = np.linalg.norm(inner - cloth[place], axis=1)
    height = np.einsum("va,va->v", inner - cloth[place], normals[place])
    return height, normals[place], (distance < reach) & ~layer.open[place]
