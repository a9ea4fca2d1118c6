"""Drawing a mesh so that vertices learn from pixels: what DDC is made of, and how Stg.1 learns from videos alone.

Which triangle a sample sees is decided by `ash.mesh.rasterizing` and does not change with the vertices; two things do.
Inside the subject, where in its triangle a sample lies: the texture slides under it. At its outline, how far the
outline reaches between two neighbouring samples: they are blended accordingly (Laine et al. 2020, "Modular Primitives
for High-Performance Differentiable Rendering", Sec. 3.6), which makes coverage a continuous function of the vertices.
Unlike there, outlines are followed through the samples, so that one is found whose triangle no sample hits.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import ash.native.shading
from ash.capture.dataset import Camera
from ash.harmonics import sh_basis
from ash.mesh.rasterizing import Rasterized, project_vertices, rasterize_mesh

SUPERSAMPLING = 2  # Samples per pixel side.
OWN_SURFACE_M = 0.15  # A sample inside an outline that is this far from it in depth shows another surface.

# Triangles [n] and weights of their corners [n, 3] to colours [n, c].
Shade = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, kw_only=True, slots=True)
class Topology:
    """Faces and who lies across each of their edges; edge e runs from corner e to the next."""

    faces: Int[Tensor, "f 3"]
    across: Int[Tensor, "f 3"]  # the face on the other side; -1: none


def topology_of(faces: Int[Tensor, "f 3"]) -> Topology:
    """Find the neighbours of every face; an edge of more than two faces counts as a border."""
    start, end = faces.numpy().ravel(), np.roll(faces.numpy(), -1, axis=1).ravel()
    edges = np.sort(np.stack([start, end], 1), axis=1)
    _, name, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    name = name.reshape(-1)
    owner = np.repeat(np.arange(len(faces)), 3)
    total = np.bincount(name, weights=owner, minlength=len(count)).astype(np.int64)
    across = np.where(count[name] == 2, total[name] - owner, -1)
    return Topology(faces=faces, across=torch.from_numpy(across.reshape(-1, 3)))


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshView:
    """What the samples of one camera see."""

    camera: Camera
    corners: Float[Tensor, "v 3"]  # homogeneous samples
    drawn: Rasterized
    covered: Int[Tensor, " n"]  # samples that see a triangle, row-major
    triangles: Int[Tensor, " n"]  # theirs


def draw_mesh(
    vertices: Float[Tensor, "v 3"],
    topology: Topology,
    camera: Camera,
    shade: Shade,
    background: Float[Tensor, " c"],
    *,
    outlines: bool = False,
) -> Float[Tensor, "h w d"]:
    """`draw_mesh_views` of one camera."""
    return draw_mesh_views(vertices, topology, [camera], shade, background, outlines=outlines)[0]


def draw_mesh_views(
    vertices: Float[Tensor, "v 3"],
    topology: Topology,
    cameras: list[Camera],
    shade: Shade,
    background: Float[Tensor, " c"],
    *,
    outlines: bool = False,
) -> Float[Tensor, "n h w d"]:
    """Colours over `background`, and coverage as the last channel (d = c + 1), for cameras of one size.

    Differentiable in whatever `shade` is, and in the vertices (world, metres). Not differentiable: which of two
    surfaces is in front. `outlines`: blend samples at outlines, which their gradient needs; without, coverage counts
    samples, as a display does.
    """
    return draw_seen(see_mesh(vertices, topology, cameras), topology, shade, background, outlines=outlines)


def see_mesh(vertices: Float[Tensor, "v 3"], topology: Topology, cameras: list[Camera]) -> list[MeshView]:
    """What each camera sees of a mesh, whatever its colours: the first half of `draw_mesh_views`."""
    return [_view_of(vertices, topology, camera) for camera in cameras]


def draw_seen(
    views: list[MeshView],
    topology: Topology,
    shade: Shade,
    background: Float[Tensor, " c"],
    *,
    outlines: bool = False,
) -> Float[Tensor, "n h w d"]:
    """The second half of `draw_mesh_views`: the same views may be drawn in several colours."""
    weights = torch.cat([_weights_in(view, topology) for view in views])
    # All at once: a texture's gradient is as large as the texture, however many samples it has.
    colours = shade(torch.cat([view.triangles for view in views]), weights)
    images = []
    for view, own in zip(views, colours.split([len(view.triangles) for view in views]), strict=True):
        image = _resolved(own, view.covered, background, view.camera)
        if outlines:
            samples = torch.cat([torch.cat([own, torch.ones_like(own[:, :1])], 1), _nothing(background)])
            image = image + _outlines(samples, view, topology)
        images.append(image)
    return torch.stack(images)


def _view_of(vertices: Float[Tensor, "v 3"], topology: Topology, camera: Camera) -> MeshView:
    width, height = camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING
    scale = torch.diag(vertices.new_tensor([SUPERSAMPLING, SUPERSAMPLING, 1.0]))
    viewmat, K = torch.from_numpy(camera.viewmat).to(vertices), scale @ torch.from_numpy(camera.K).to(vertices)
    corners = project_vertices(vertices, viewmat, K)
    drawn = rasterize_mesh(corners, topology.faces, width=width, height=height)
    triangle = drawn.triangle.reshape(-1)
    covered = (triangle >= 0).nonzero().squeeze(1)
    return MeshView(camera=camera, corners=corners, drawn=drawn, covered=covered, triangles=triangle[covered].long())


def _weights_in(view: MeshView, topology: Topology) -> Float[Tensor, "n 3"]:
    """Weights of the corners of the triangles seen: anew where they have a gradient, else the rasteriser's."""
    if view.corners.requires_grad:
        width = view.camera.width * SUPERSAMPLING
        return _weights_of(view.corners, topology.faces, view.triangles, view.covered, width)
    return view.drawn.barycentric.reshape(-1, 3)[view.covered].to(view.corners)


def _resolved(
    colours: Float[Tensor, "n c"], covered: Int[Tensor, " n"], background: Float[Tensor, " c"], camera: Camera
) -> Float[Tensor, "h w d"]:
    """`resolve_naive`, by native kernels where they take it."""
    if not _native(colours, background) or background.requires_grad or colours.shape[1] != 3:
        return resolve_naive(colours, covered, background, camera)
    size = {"width": camera.width, "height": camera.height}
    return ash.native.shading.resolve(colours, covered, background, **size, factor=SUPERSAMPLING)


def resolve_naive(
    colours: Float[Tensor, "n c"], covered: Int[Tensor, " n"], background: Float[Tensor, " c"], camera: Camera
) -> Float[Tensor, "h w d"]:
    """Means over each pixel's samples, of which the `covered` have colours; coverage comes last: the definition."""
    width, height = camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING
    samples = _nothing(background).expand(height * width, -1)
    samples = samples.index_put((covered,), torch.cat([colours, torch.ones_like(colours[:, :1])], 1))
    image = samples.reshape(height, width, -1)
    steps = range(SUPERSAMPLING)  # Sums of strided views are several times as fast as a mean over two axes.
    total = torch.stack([image[y::SUPERSAMPLING, x::SUPERSAMPLING] for y in steps for x in steps]).sum(0)
    return total / SUPERSAMPLING**2


def _nothing(background: Float[Tensor, " c"]) -> Float[Tensor, "1 d"]:
    return torch.cat([background, background.new_zeros(1)])[None]


def _native(*tensors: Tensor | None) -> bool:
    """Whether the native kernels take tensors of this kind."""
    given = [tensor for tensor in tensors if tensor is not None]
    return all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in given)


def blend(
    values: Float[Tensor, "v c"], corners: Int[Tensor, "n 3"], weights: Float[Tensor, "n 3"]
) -> Float[Tensor, "n c"]:
    """Per-corner values at points within their triangles."""
    a, b, c = (values.index_select(0, rows) for rows in corners.unbind(1))
    return a * weights[:, :1] + b * weights[:, 1:2] + c * weights[:, 2:]


def _weights_of(
    corners: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    triangles: Int[Tensor, " n"],
    covered: Int[Tensor, " n"],
    width: int,
) -> Float[Tensor, "n 3"]:
    """`corner_weights` of the triangles seen at the covered samples."""
    if _native(corners):
        return ash.native.shading.corner_weights(corners, faces, triangles, covered, width)
    a, b, c = (corners.index_select(0, rows) for rows in faces[triangles].unbind(1))
    return corner_weights(a, b, c, covered % width, covered // width)


def corner_weights(
    a: Float[Tensor, "n 3"],
    b: Float[Tensor, "n 3"],
    c: Float[Tensor, "n 3"],
    column: Int[Tensor, " n"],
    row: Int[Tensor, " n"],
) -> Float[Tensor, "n 3"]:
    """Perspective-correct weights of a triangle's corners (homogeneous pixels) at a sample's centre, sum 1."""
    x, y = (column + 0.5).to(a), (row + 0.5).to(a)
    volumes = []
    for p, q in ((b, c), (c, a), (a, b)):
        (p0, p1, p2), (q0, q1, q2) = p.unbind(1), q.unbind(1)
        volumes.append((p1 * q2 - p2 * q1) * x + (p2 * q0 - p0 * q2) * y + (p0 * q1 - p1 * q0))
    total = volumes[0] + volumes[1] + volumes[2]
    return torch.stack([volume / total for volume in volumes], 1)


def _outlines(samples: Float[Tensor, "s d"], view: MeshView, topology: Topology) -> Float[Tensor, "y x d"]:
    """What an image gains where an outline runs between two samples: one of them takes some of the other's colour.

    `samples`: the covered ones, then one for the whole background.
    """
    corners, covered = view.corners, view.covered
    triangle, depth = view.drawn.triangle.reshape(-1), view.drawn.depth.reshape(-1)
    height, width = view.drawn.triangle.shape
    row_of = torch.full_like(triangle, len(covered), dtype=torch.long)
    row_of[covered] = torch.arange(len(covered), device=covered.device)
    screen = corners[:, :2] / corners[:, 2:]
    face, edge = outline_edges(screen.detach(), topology).nonzero(as_tuple=True)
    ends = torch.stack([topology.faces[face, edge], topology.faces[face, (edge + 1) % 3]], 1)
    third = topology.faces[face, (edge + 2) % 3]
    columns, pixels = width // SUPERSAMPLING, height * width // SUPERSAMPLING**2
    gained = samples.new_zeros(pixels, samples.shape[1])
    for axis in (0, 1):  # Neighbours in a row, then in a column.
        crossings = _crossings(screen, corners[:, 2].detach(), ends, third, axis, (width, height))
        nearest = _visible(crossings, triangle, depth)
        inner, outer, share = (
            crossings.inner[nearest],
            crossings.outer[nearest],
            crossings.reach[nearest][:, None] - 0.5,
        )
        # The surface reaches beyond the middle: the sample outside takes some of its colour; or it falls short of it.
        takes = torch.where(share[:, 0] > 0, outer, inner)
        pixel = takes // width // SUPERSAMPLING * columns + takes % width // SUPERSAMPLING
        taken = share * (samples[row_of[inner]] - samples[row_of[outer]])
        gained = gained.index_add(0, pixel, taken / SUPERSAMPLING**2)
    return gained.reshape(-1, columns, samples.shape[1])


@dataclass(frozen=True, kw_only=True, slots=True)
class _Crossings:
    """Where outline edges run between two neighbouring samples."""

    inner: Int[Tensor, " n"]  # the sample on the surface's side
    outer: Int[Tensor, " n"]
    reach: Float[Tensor, " n"]  # how far the surface reaches, from the inner sample (0) to the outer (1)
    depth: Float[Tensor, " n"]  # of the edge there, metres


def _crossings(
    screen: Float[Tensor, "v 2"],
    depth: Float[Tensor, " v"],
    ends: Int[Tensor, "e 2"],
    third: Int[Tensor, " e"],
    axis: int,
    shape: tuple[int, int],
) -> _Crossings:
    """Follow every edge through the lines of samples that it crosses. `third`: the face's other corner, inside."""
    across, still = axis, 1 - axis
    low, high = screen.detach()[ends, still].aminmax(dim=1)
    first = (low - 0.5).ceil().long().clamp(min=0)
    last = ((high - 0.5).ceil().long() - 1).clamp(max=shape[still] - 1)
    count = (last - first + 1).clamp(min=0)
    edge = torch.repeat_interleave(torch.arange(len(ends), device=ends.device), count)
    line = first[edge] + torch.arange(len(edge), device=edge.device) - (count.cumsum(0) - count)[edge]
    p, q, r = screen[ends[edge, 0]], screen[ends[edge, 1]], screen.detach()[third[edge]]
    fraction = (line + 0.5 - p[:, still]) / (q[:, still] - p[:, still])
    at = p[:, across] + fraction * (q[:, across] - p[:, across])
    left = (at.detach() - 0.5).floor().long()
    # The third corner lies beyond the edge, seen along the line: the surface is on that side.
    bend = (r[:, still] - p[:, still]) / (q[:, still] - p[:, still])
    towards = r[:, across] > (p[:, across] + bend * (q[:, across] - p[:, across])).detach()
    inside, outside = torch.where(towards, left + 1, left), torch.where(towards, left, left + 1)
    reach = (at - (inside + 0.5)).abs()
    nearness = 1 / depth[ends[edge]]
    edge_depth = 1 / (nearness[:, 0] + fraction.detach() * (nearness[:, 1] - nearness[:, 0]))
    fits = (left >= 0) & (left + 1 < shape[across])
    step, stride = (1, shape[0]) if axis == 0 else (shape[0], 1)
    inner, outer = (line * stride + place * step for place in (inside, outside))
    return _Crossings(inner=inner[fits], outer=outer[fits], reach=reach[fits], depth=edge_depth[fits])


def _visible(crossings: _Crossings, triangle: Int[Tensor, " s"], depth: Float[Tensor, " s"]) -> Int[Tensor, " n"]:
    """Crossings that are seen, the nearest one where several lie between the same two samples."""
    far = torch.where(triangle >= 0, depth, torch.inf).to(crossings.depth)
    own = (far[crossings.inner] - crossings.depth).abs() < OWN_SURFACE_M
    visible = own & (far[crossings.outer] > crossings.depth) & (triangle[crossings.inner] != triangle[crossings.outer])
    rows = visible.nonzero().squeeze(1)
    rows = rows[crossings.depth[rows].argsort(stable=True)]
    pair = crossings.inner[rows] * len(triangle) + crossings.outer[rows]
    order = pair.argsort(stable=True)
    first = torch.ones(len(pair), dtype=torch.bool, device=pair.device)
    first[1:] = pair[order][1:] != pair[order][:-1]
    return rows[order[first]]


def outline_edges(screen: Float[Tensor, "v 2"], topology: Topology) -> Bool[Tensor, "f 3"]:
    """Edges beyond which the surface ends or turns away from the camera; of the two faces at an edge, one has it."""
    a, b, c = screen[topology.faces].unbind(1)
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] > 0
    other = topology.across > torch.arange(len(turn), device=turn.device)[:, None]
    return (topology.across < 0) | (other & (turn[topology.across] != turn[:, None]))


def textured(
    texture: Float[Tensor, "3 t s"],
    uvs: Float[Tensor, "u 2"],
    uv_faces: Int[Tensor, "f 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    light: Float[Tensor, "9 3"] | None,
) -> Shade:
    """`textured_naive`, by native kernels where only texture, light and weights need gradients."""
    if not _native(texture, light, uvs, normals) or uvs.requires_grad or normals.requires_grad or len(texture) != 3:
        return textured_naive(texture, uvs, uv_faces, normals, faces, light)
    surface = ash.native.shading.TexturedMesh(*(t.contiguous() for t in (uvs, uv_faces, normals, faces)))

    def shade(triangles: Tensor, weights: Tensor) -> Tensor:
        return ash.native.shading.shade(texture, light, triangles, weights, surface)

    return shade


def textured_naive(
    texture: Float[Tensor, "3 t s"],
    uvs: Float[Tensor, "u 2"],
    uv_faces: Int[Tensor, "f 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    light: Float[Tensor, "9 3"] | None,
) -> Shade:
    """Colours of a texture under `light`: coefficients of the exponent that multiplies them."""

    def shade(triangles: Tensor, weights: Tensor) -> Tensor:
        colours = sample_texture(texture, blend(uvs, uv_faces[triangles], weights))
        if light is None:
            return colours
        across = blend(normals, faces[triangles], weights)
        return colours * (sh_basis(torch.nn.functional.normalize(across, dim=-1), 2) @ light).exp()

    return shade


def sample_texture(texture: Float[Tensor, "c t s"], uvs: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear samples at UVs in [0, 1], v up; differentiable in the texture and the UVs."""
    grid = torch.stack([2 * uvs[:, 0] - 1, 1 - 2 * uvs[:, 1]], -1)[None, None]
    sampled = torch.nn.functional.grid_sample(texture[None], grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T
