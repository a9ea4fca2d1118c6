"""Which triangle a pixel sees, and where in it: for the texel lattice of a UV map and for a camera's view of a mesh.

Vertices are homogeneous pixels (x w, y w, w): of a camera what `project_vertices` returns, w being the depth in metres;
of a UV map (x, y, 1). Pixel centres lie at +0.5. Not differentiable.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ash.files import InputError
from ash.native.library import address, check_memory, load


@dataclass(frozen=True, kw_only=True, slots=True)
class Rasterized:
    """What every pixel sees."""

    triangle: Int[Tensor, "h w"]  # row of `faces`, int32; -1: none
    barycentric: Float[Tensor, "h w 3"]  # perspective-correct weights of its corners, sum 1, float32; 0: none
    depth: Float[Tensor, "h w"]  # w of the nearest point, float32; 0: none


def project_vertices(
    points: Float[Tensor, "v 3"], viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "v 3"]:
    """World points to homogeneous pixels (x w, y w, w): w is the depth along the optical axis in metres."""
    return (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T


def rasterize_mesh(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    *,
    width: int,
    height: int,
    near: float = 0.01,
    threads: int = 1,
) -> Rasterized:
    """The triangle nearest to the camera at every pixel's centre, whichever way it faces: by native kernels or Warp's.

    A pixel on an edge belongs to the triangle to whose left or top that edge is, so that a closed surface covers each
    pixel exactly once. Points with a depth below `near` are not seen, points beyond are, of one and the same triangle
    too: nothing needs clipping before. Of two triangles at the same depth the one listed first is seen. The same
    numbers come out for any number of threads.

    Args:
        vertices: homogeneous pixels, float32 or float64 (see the top of this file); on CUDA, Warp rasterises.
        faces: rows of `vertices`.
        width: pixels.
        height: pixels.
        near: least depth that is seen.
        threads: CPU threads of this call.

    Raises:
        InputError: a vertex is NaN or infinite, a face names a vertex that does not exist, or the size is not positive.
    """
    _check_mesh(vertices, faces, width=width, height=height, near=near)
    if threads < 1:
        raise InputError(f"threads: expected at least 1, got {threads}")
    corners, rows = vertices.detach().double().contiguous(), faces.to(torch.int32).contiguous()
    if vertices.is_cuda:
        return rasterize_by_warp(corners, rows, width=width, height=height, near=near)
    triangle = torch.empty(height, width, dtype=torch.int32, device="cpu")
    barycentric, depth = (torch.empty(height, width, *rest, device="cpu") for rest in ((3,), ()))
    check_memory(
        load().ash_rasterize(
            address(corners),
            address(rows),
            len(rows),
            width,
            height,
            near,
            threads,
            *map(address, (triangle, barycentric, depth)),
        )
    )
    return Rasterized(triangle=triangle, barycentric=barycentric, depth=depth)


def rasterize_by_warp(
    corners: Float[Tensor, "v 3"], rows: Int[Tensor, "f 3"], *, width: int, height: int, near: float
) -> Rasterized:
    """What `rasterize_mesh` does on CUDA, on any device of Warp's: tests run it on the CPU."""
    from ash.warp.rasterizing import rasterize  # Warp takes a second to import.

    triangle, barycentric, depth = rasterize(corners, rows, width=width, height=height, near=near)
    return Rasterized(triangle=triangle, barycentric=barycentric, depth=depth)


def rasterize_mesh_naive(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], *, width: int, height: int, near: float = 0.01
) -> Rasterized:
    """`rasterize_mesh` by its definition: every triangle against every pixel, in torch."""
    _check_mesh(vertices, faces, width=width, height=height, near=near)
    corners = vertices.detach().double()
    rows, columns = (torch.arange(count, device=corners.device).double() + 0.5 for count in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    nearest = torch.full_like(x, torch.inf)
    triangle = torch.full_like(x, -1, dtype=torch.int32)
    barycentric = torch.zeros_like(pixels)
    for number, face in enumerate(faces.tolist()):
        edges = torch.stack([_edge(corners, face[(i + 1) % 3], face[(i + 2) % 3]) for i in range(3)])
        volume = edges[0] @ corners[face[0]]
        if volume == 0:
            continue
        edges = edges * torch.sign(volume)
        inside = torch.ones_like(x, dtype=torch.bool)
        distances = pixels @ edges.T
        for edge, distance in zip(edges, distances.unbind(-1), strict=True):
            keeps_its_pixels = bool(edge[0] > 0 or (edge[0] == 0 and edge[1] > 0))
            inside &= (distance > 0) | ((distance == 0) & keeps_its_pixels)
        depth = volume.abs() / distances.sum(-1)
        nearer = inside & (depth >= near) & (depth < nearest)
        nearest[nearer] = depth[nearer]
        triangle[nearer] = number
        barycentric[nearer] = distances[nearer] / distances[nearer].sum(-1, keepdim=True)
    depth = torch.where(triangle >= 0, nearest, 0.0)
    return Rasterized(triangle=triangle, barycentric=barycentric.float(), depth=depth.float())


def _edge(corners: Tensor, start: int, end: int) -> Tensor:
    """The line between two corners, from the lower-numbered one whichever triangle asks: exactly opposite for both."""
    if start < end:
        return torch.linalg.cross(corners[start], corners[end])
    return -torch.linalg.cross(corners[end], corners[start])


def _check_mesh(vertices: Tensor, faces: Tensor, *, width: int, height: int, near: float) -> None:
    if not bool(torch.isfinite(vertices).all()):
        raise InputError("vertices: expected finite numbers, got NaN or infinity")
    if len(faces) and not (int(faces.min()) >= 0 and int(faces.max()) < len(vertices)):
        raise InputError(
            f"faces: expected rows of the {len(vertices)} vertices, got {int(faces.min())}..{int(faces.max())}"
        )
    if not (1 <= width <= 1 << 15 and 1 <= height <= 1 << 15 and near > 0):
        raise InputError(f"expected 1 to 32768 pixels a side and near > 0, got {width} x {height} and near = {near}")
