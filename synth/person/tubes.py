"""Tubes: rings of points around a curve, with a rectangular UV chart. Mannequin, skirts and shoes are made of them."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

AJAR = 0.08  # of half its girth, that each edge of a slit is drawn back at the open end


@dataclass(frozen=True, kw_only=True, slots=True)
class Tube:
    """Rings around a curve. The rings run along v, from the first knot to the last; the seam lies at the back."""

    part: str
    knots: np.ndarray  # [k, 3] centre of the ring, metres
    radii: np.ndarray  # [k, 2] to the side, to the front
    front: tuple[float, float, float]
    chain: tuple[str, ...]  # joints along the curve, first knot first
    borders: tuple[float, ...]  # where along the curve (0..1) one joint hands over to the next
    rings: int
    segments: int
    chart: tuple[float, float, float, float]  # u, v, width, height in metres
    blend: float = 0.12  # half the width of a hand-over along the curve
    slit: float = 0.0  # share of the rings, from the first, between which the last column is left open


def lattice(tube: Tube, rings: int, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Points `[rings, segments, 3]` and how far along the curve each ring lies `[rings]`, 0..1."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(tube.knots, axis=0), axis=1))])
    along = np.linspace(0, 1, rings)
    centre = PchipInterpolator(length / length[-1], tube.knots)(along)
    radii = PchipInterpolator(length / length[-1], tube.radii)(along)
    axis = (tube.knots[-1] - tube.knots[0]) / length[-1]
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, tube.front)
    side /= np.linalg.norm(side)
    front = np.cross(side, axis)
    angle = np.tile(2 * np.pi * np.arange(segments) / segments, (rings, 1))
    if tube.slit:  # Its edges part more and more.
        angle += AJAR * np.clip(1 - along / tube.slit, 0, 1)[:, None] * (np.pi * (1 - 1 / segments) - angle)
    ring = -np.sin(angle)[..., None] * side * radii[:, None, :1]
    ring = ring - np.cos(angle)[..., None] * front * radii[:, None, 1:]
    return centre[:, None] + ring, along


def chain_weights(tube: Tube, along: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Skin weights `[rings, j]` of the joints along a tube."""
    weights = np.zeros((len(along), len(names)))
    share = np.ones(len(along))
    for joint, border in zip(tube.chain, tube.borders, strict=False):
        x = np.clip((along - border) / (2 * tube.blend) + 0.5, 0, 1)
        passed = x * x * (3 - 2 * x)
        weights[:, names.index(joint)] = share * (1 - passed)
        share = share * passed
    weights[:, names.index(tube.chain[-1])] += share
    return weights


def skirt_weights(points: np.ndarray, names: tuple[str, ...], *, top: float, length: float) -> np.ndarray:
    """As a scan-based template would: the waist follows the pelvis, the hem the nearer thigh, more so in front."""
    depth = np.clip((top - points[:, 1]) / length, 0, 1)
    left = 0.5 + 0.5 * np.tanh(points[:, 0] / 0.05)
    front = 0.5 + 0.5 * np.tanh(points[:, 2] / 0.05)
    share = (0.2 + 0.6 * front) * depth
    weights = np.zeros((len(points), len(names)))
    weights[:, names.index("pelvis")] = 1 - share
    weights[:, names.index("thigh_left")] = share * left
    weights[:, names.index("thigh_right")] = share * (1 - left)
    return weights


def grid_faces(rows: int, columns: int, *, stride: int, wrap: int) -> np.ndarray:
    """Triangles of a lattice; `stride` is the row length of the index space, `wrap` where columns start again."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    k = (j + 1) % wrap
    a, b, c, d = i * stride + j, i * stride + k, (i + 1) * stride + k, (i + 1) * stride + j
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)


def chart_uvs(rows: int, columns: int) -> np.ndarray:
    """UVs `[rows * (columns + 1), 2]` of a lattice unrolled to the unit square; the seam column is listed twice."""
    grid = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns + 1), indexing="ij")
    return np.stack([grid[1], grid[0]], axis=-1).reshape(-1, 2)
