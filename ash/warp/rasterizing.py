"""Which triangle a pixel sees, on any of Warp's devices: `rasterize_mesh_naive` in `ash.mesh.rasterizing` defines it.

Three passes over a buffer: the least depth at every pixel, the first triangle at that depth, and where in it the pixel
lies. Depths are compared in double precision, as whole numbers with the same bits: those of positive numbers have the
same order. Minima do not depend on who comes first.
"""

from typing import Any, no_type_check

import torch
import warp as wp
from torch import Tensor

from ash.warp.arrays import array, launch

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FARTHEST = torch.iinfo(torch.int64).max
NO_TRIANGLE = torch.iinfo(torch.int32).max
SLACK = wp.constant(wp.float64(1.0))  # Pixels around a triangle's box: what decides is the triangle.


@wp.func
@no_type_check
def edge(corners: wp.array(dtype=wp.vec3d), start: int, end: int):
    """The line between two corners, from the lower-numbered one, so that it is exactly opposite for both triangles."""
    if start < end:
        return wp.cross(corners[start], corners[end])
    return -wp.cross(corners[end], corners[start])


@wp.func
@no_type_check
def edges_of(corners: wp.array(dtype=wp.vec3d), face: wp.vec3i):
    """The edges opposite to each corner; all zero where the triangle is seen from its edge."""
    edges = wp.matrix_from_rows(
        edge(corners, face[1], face[2]), edge(corners, face[2], face[0]), edge(corners, face[0], face[1])
    )
    volume = wp.dot(edges[0], corners[face[0]])
    return wp.sign(volume) * edges if volume != wp.float64(0.0) else wp.mat33d()


@wp.func
@no_type_check
def distances_at(edges: wp.mat33d, x: int, y: int):
    """Of a pixel's centre to the edges, in their own units; inside all are at least 0."""
    column, row = wp.float64(x) + wp.float64(0.5), wp.float64(y) + wp.float64(0.5)
    distances = wp.vec3d()
    for i in range(3):
        distances[i] = edges[i, 0] * column + edges[i, 1] * row + edges[i, 2]
    return distances


@wp.func
@no_type_check
def depth_at(corners: wp.array(dtype=wp.vec3d), face: wp.vec3i, edges: wp.mat33d, x: int, y: int, near: wp.float64):
    """The depth at a pixel's centre as a whole number; `FARTHEST` where the triangle is not seen."""
    distances = distances_at(edges, x, y)
    zero = wp.float64(0.0)
    for i in range(3):
        keeps = edges[i, 0] > zero or (edges[i, 0] == zero and edges[i, 1] > zero)  # Of the pixels on this edge.
        if not (distances[i] > zero or (distances[i] == zero and keeps)):
            return wp.int64(FARTHEST)
    total = distances[0] + distances[1] + distances[2]
    depth = wp.abs(wp.dot(edges[0], corners[face[0]])) / total
    if not (total > zero and depth >= near):
        return wp.int64(FARTHEST)
    return wp.cast(depth, wp.int64)


@wp.func
@no_type_check
def box_of(corners: wp.array(dtype=wp.vec3d), face: wp.vec3i, width: int, height: int, near: wp.float64):
    """Pixels that a triangle may touch: first column and row, last + 1. Across the near plane: the whole image."""
    size = wp.vec2d(wp.float64(width), wp.float64(height))
    low, high = wp.vec2d(size), wp.vec2d()
    for i in range(3):
        corner = corners[face[i]]
        if corner[2] < near:
            return wp.vec4i(0, 0, width, height)
        for j in range(2):
            low[j] = wp.min(low[j], corner[j] / corner[2] - SLACK)
            high[j] = wp.max(high[j], corner[j] / corner[2] + SLACK)
    for j in range(2):
        low[j] = wp.clamp(low[j], wp.float64(0.0), size[j])
        high[j] = wp.clamp(high[j], wp.float64(0.0), size[j])
    return wp.vec4i(int(wp.floor(low[0])), int(wp.floor(low[1])), int(wp.ceil(high[0])), int(wp.ceil(high[1])))


@wp.kernel
@no_type_check
def find_nearest(
    corners: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    height: int,
    near: wp.float64,
    nearest: wp.array(dtype=wp.int64),
):
    """One triangle, at all pixels that it may touch: the least depth."""
    face = faces[wp.tid()]
    edges = edges_of(corners, face)
    box = box_of(corners, face, width, height, near)
    for y in range(box[1], box[3]):
        for x in range(box[0], box[2]):
            depth = depth_at(corners, face, edges, x, y, near)
            if depth < wp.int64(FARTHEST):
                wp.atomic_min(nearest, y * width + x, depth)


@wp.kernel
@no_type_check
def find_first(
    corners: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    height: int,
    near: wp.float64,
    nearest: wp.array(dtype=wp.int64),
    triangles: wp.array(dtype=int),
):
    """One triangle, at all pixels that it may touch: the first of those at the least depth."""
    number = wp.tid()
    face = faces[number]
    edges = edges_of(corners, face)
    box = box_of(corners, face, width, height, near)
    for y in range(box[1], box[3]):
        for x in range(box[0], box[2]):
            depth = depth_at(corners, face, edges, x, y, near)
            if depth < wp.int64(FARTHEST) and depth == nearest[y * width + x]:
                wp.atomic_min(triangles, y * width + x, number)


@wp.kernel
@no_type_check
def place_pixels(
    corners: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    width: int,
    nearest: wp.array(dtype=wp.int64),
    triangles: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
    depths: wp.array(dtype=float),
):
    """One pixel: where in its triangle it lies; -1, and zeros, where it sees none."""
    pixel = wp.tid()
    weights[pixel] = wp.vec3()
    depths[pixel] = 0.0
    if triangles[pixel] == NO_TRIANGLE:
        triangles[pixel] = -1
        return
    distances = distances_at(edges_of(corners, faces[triangles[pixel]]), pixel % width, pixel // width)
    distances = distances / (distances[0] + distances[1] + distances[2])
    weights[pixel] = wp.vec3(wp.float32(distances[0]), wp.float32(distances[1]), wp.float32(distances[2]))
    depths[pixel] = wp.float32(wp.cast(nearest[pixel], wp.float64))


def rasterize(corners: Tensor, faces: Tensor, *, width: int, height: int, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles `[h, w]` int32, weights of their corners `[h, w, 3]` and depths `[h, w]`.

    Float64 homogeneous pixels `[v, 3]` and int32 `[f, 3]`, contiguous, on one device of Warp's.
    """
    device = corners.device
    nearest = torch.full((height, width), FARTHEST, dtype=torch.int64, device=device)
    triangles = torch.full((height, width), NO_TRIANGLE, dtype=torch.int32, device=device)
    weights, depths = (torch.empty(height, width, *rest, device=device) for rest in ((3,), ()))
    mesh: list[Any] = [array(corners, wp.vec3d), array(faces, wp.vec3i)]
    buffers = [array(nearest, wp.int64), array(triangles, wp.int32)]
    launch(find_nearest, len(faces), [*mesh, width, height, near, buffers[0]], device)
    launch(find_first, len(faces), [*mesh, width, height, near, *buffers], device)
    outputs = [array(weights, wp.vec3), array(depths, wp.float32)]
    launch(place_pixels, height * width, [*mesh, width, *buffers, *outputs], device)
    return triangles, weights, depths
