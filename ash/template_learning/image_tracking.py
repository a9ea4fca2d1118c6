"""The template from nothing but the training videos: the paper's claim, and supervision "images".

Every frame's vertices are moved until the template shows what the training cameras saw (weak supervision of Habermann
et al. 2021, by Gauss and Newton in place of gradient descent). Two things pull. Inside the subject, points of the
surface look for their colour, which is the mean of what all views show of them, under light of 27 numbers: in an image,
along its slope. At its outline, the template's outline is drawn to that of the mask. What moves are the nodes of the
embedded graph, held together and at home by weights that stand for how a template usually errs. Every pass looks at
every view once, sharper from pass to pass. What comes out are tracked frames, as from any other supervision.

Colours cannot tell where on the surface its paint lies: along it, the mean over the frames stays at rest.

All of it happens on the template's device, in float64 wherever equations are put together.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ash.capture.dataset import Capture, Pose
from ash.devices import CPU, moved
from ash.harmonics import sh_basis
from ash.mesh.drawing import Topology, outline_edges, topology_of
from ash.mesh.rasterizing import project_vertices, rasterize_mesh
from ash.rotations import RigidTransforms, unitquat_to_rotmat
from ash.template.graph import EmbeddedGraph
from ash.template.template import Template, vertex_normals
from ash.template_learning.nearest import NearestPoint
from ash.template_learning.observing import ObservedView, observe, sample
from ash.template_learning.tracking import Tracked
from ash.textures import TexelLattice, build_lattice
from ash.training.images import READERS, ReadAhead, View, load_training_images

PASSES = 4  # Over all training images.
TEXELS = 192  # Points of the surface: the texels of such a lattice.
BLURS = (1.5, 0.5)  # Pixels, in the first and in the last pass.
FACING = 0.2  # Cosine from which a point is seen squarely enough,
VISIBLE_WITHIN_M = 0.02  # and how far behind the drawn surface it may lie.
COLOUR_ERROR = 0.03  # Standard deviation of a colour, sRGB in 0..1: noise, shadows, blur.
OUTLIER = 1.5  # Standard deviations from which a colour is rather believed to be another surface's.
OUTLINE_WEIGHT = 20.0  # Of a squared pixel between the outlines.
OUTLINE_OUTLIER = 1.5  # Pixels.
REACHES = (10.0, 3.0)  # Pixels: how far an outline looks for the other, in the first and in the last pass.
ALIGNED = 0.7  # Least cosine between the normals of two outlines that belong together.
ALONG_EDGE = (0.0, 1 / 3, 2 / 3)
LIGHT_STRIDE = 8  # 27 numbers need no more of the points.
LIGHT_STEP = 0.5  # Colours answer to the same error: both in full would overshoot.
HOLD = 3e4  # Against nodes that leave their place, and
STIFFNESS = 3e6  # against those that leave their neighbours, per squared metre.
SEEN_OFTEN = 0.3  # Weight from which a point's mean colour is worth something.


def track_images(capture: Capture, template: Template, graph: EmbeddedGraph, *, passes: int = PASSES) -> Tracked:
    """Fit the template to the training images, frame by frame, `passes` times over."""
    images = load_training_images(capture, template.device)
    frames = images.frames
    subject = _Subject(template, graph, len(frames))
    posed = [template.pose(Pose(capture.motion, frame)).transforms for frame in frames]

    def needed(step: int) -> tuple[View, ...]:
        frame = frames[step % len(frames)]
        return tuple((name, frame) for name in images.seeing(frame)) if step < passes * len(frames) else ()

    with closing(ReadAhead(images.views, readers=0 if images.device == CPU else READERS)) as ahead:
        for turn in range(passes):
            progress = turn / max(1, passes - 1)
            blur, reach = (first * (last / first) ** progress for first, last in (BLURS, REACHES))
            paint = _Paint(subject.paint)
            for index in range(len(frames)):
                step = turn * len(frames) + index
                cutouts = ahead.of_step(step, needed)
                views = [observe(cutouts[view], images.cameras[view[0]], blur=blur) for view in needed(step)]
                subject.move(index, posed[index], views, paint, reach=reach)
            subject.paint = paint.mean()
    return Tracked(frames=frames, canonical=torch.stack([subject.canonical(i) for i in range(len(frames))]).float())


@dataclass(frozen=True, kw_only=True, slots=True)
class Painted:
    """What colours the surface has."""

    colours: Float[Tensor, "n 3"]  # of the points; NaN: hardly ever seen
    light: Float[Tensor, "9 3"]  # coefficients of the exponent that multiplies them


class _Paint:
    """Gathers the colours and the light of the next pass from what this one sees."""

    def __init__(self, painted: Painted) -> None:
        self.painted = painted
        self.total, self.weight = torch.zeros_like(painted.colours), torch.zeros_like(painted.colours)
        self.normal, self.right = painted.light.new_zeros(3, 9, 9), painted.light.new_zeros(3, 9)

    def see(self, points: Int[Tensor, " k"], weight: Tensor, shade: Tensor, colour: Tensor) -> None:
        """`shade`: what light makes of white there; `colour`: what the image has, `[k, 3]` both. No point twice."""
        self.total[points] += weight[:, None] * shade * colour
        self.weight[points] += weight[:, None] * shade**2

    def correct_light(self, basis: Tensor, weight: Tensor, drawn: Tensor, error: Tensor) -> None:
        """Normal equations of the light's coefficients, from colours `drawn` and how far they are off, `[k, 3]`."""
        slopes = drawn.T[:, :, None] * basis
        weighted = (slopes * weight[:, None]).mT
        self.normal += weighted @ slopes
        self.right += (weighted @ error.T[:, :, None])[..., 0]

    def mean(self) -> Painted:
        """The colours and the light that follow."""
        enough = (self.weight > SEEN_OFTEN).all(1, keepdim=True)
        colours = torch.where(enough, self.total / torch.where(enough, self.weight, 1), torch.nan)
        damping = 1e-3 / 9 * self.normal.diagonal(dim1=1, dim2=2).sum(1)
        # A channel that nobody saw has no equations: its light stays.
        damping = torch.where(damping > 0, damping, 1)
        eye = torch.eye(9, dtype=damping.dtype, device=damping.device)
        step = torch.linalg.solve(self.normal + damping[:, None, None] * eye, self.right)
        return Painted(colours=colours, light=self.painted.light + LIGHT_STEP * step.T)


class _Pull:
    """Normal equations of where points want to go: world, metres.

    A point within a triangle is three vertices: its equation is shared out between them, which bounds the sum from
    above, so that a step never overshoots.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.sums = torch.zeros(count, 3, 4, dtype=torch.float64, device=device)  # left and right side

    def see(self, points: Int[Tensor, " k"], normal: Float[Tensor, "k 3 3"], right: Float[Tensor, "k 3"]) -> None:
        """Equations of the points themselves, no point twice."""
        self.sums[points] += torch.cat([normal, right[..., None]], 2)

    def add(self, vertices: Int[Tensor, "k c"], weights: Float[Tensor, "k c"], sums: Float[Tensor, "k 3 4"]) -> None:
        """Equations of points with such corners, in such shares."""
        shared = weights[:, :, None] * sums.reshape(-1, 1, 12)
        self.sums.view(-1, 12).index_add_(0, vertices.reshape(-1), shared.reshape(-1, 12))

    def in_canonical(self, rotations: Float[Tensor, "v 3 3"]) -> Float[Tensor, "v 3 4"]:
        """The equations for shifts before posing."""
        turned = rotations.mT @ self.sums
        return torch.cat([turned[..., :3] @ rotations, turned[..., 3:]], 2)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shown:
    """The template as a frame has it, float64 but for what is drawn."""

    vertices: Float[Tensor, "v 3"]  # metres, world, float32
    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    basis: Float[Tensor, "n 9"]  # of light
    shade: Float[Tensor, "n 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Drawn:
    """What a camera sees of the template."""

    triangle: Int[Tensor, "h w"]  # -1: none
    depth: Float[Tensor, "h w"]  # metres
    screen: Float[Tensor, "v 2"]  # the vertices in pixels, float64


class _Subject:
    """Everything that is learned: translations of the nodes per frame, colours, light."""

    def __init__(self, template: Template, graph: EmbeddedGraph, frames: int) -> None:
        mesh, device = template.mesh, template.device
        self.lattice: TexelLattice = moved(build_lattice(mesh, TEXELS), device)
        self.topology: Topology = moved(topology_of(torch.from_numpy(mesh.faces)), device)
        self.rest = torch.from_numpy(mesh.vertices).to(device)
        self.normals = vertex_normals(self.rest, self.topology.faces)
        self.solver = _NodeSolver(graph)
        self.nodes = self.rest.new_zeros(frames, len(graph.nodes), 3)
        colours = self.rest.new_full((len(self.lattice.texels), 3), torch.nan)
        self.paint = Painted(colours=colours, light=self.rest.new_zeros(9, 3))

    def canonical(self, index: int) -> Float[Tensor, "v 3"]:
        """The vertices of the `index`-th training frame."""
        mean = self.solver.spread(self.nodes.mean(0))
        along = mean - self.normals * (mean * self.normals).sum(1, keepdim=True)
        return self.rest + self.solver.spread(self.nodes[index]) - along

    def move(
        self, index: int, transforms: RigidTransforms, views: Sequence[ObservedView], paint: _Paint, *, reach: float
    ) -> None:
        """One step of Gauss and Newton for a frame; what it sees goes into `paint`."""
        shown = self._show(index, transforms)
        pull, texel_pull = (_Pull(count, self.rest.device) for count in (len(self.rest), len(self.lattice.texels)))
        for view in views:
            drawn = _draw(shown.vertices, self.topology.faces, view)
            _pull_by_colours(texel_pull, shown, view, drawn, self.paint, paint)
            _pull_by_outline(pull, shown, view, drawn, self.topology, reach)
        pull.add(self.lattice.corners, self.lattice.barycentric.double(), texel_pull.sums)
        rotations = unitquat_to_rotmat(transforms.quats).double()
        self.nodes[index] = self.solver.solve(self.nodes[index], pull.in_canonical(rotations))

    def _show(self, index: int, transforms: RigidTransforms) -> _Shown:
        vertices = transforms.apply(self.canonical(index).float())
        normals = vertex_normals(vertices, self.topology.faces)
        across = torch.nn.functional.normalize(self.lattice.interpolate(normals), dim=-1)
        basis = sh_basis(across, 2).double()
        return _Shown(
            vertices=vertices,
            points=self.lattice.interpolate(vertices).double(),
            normals=across.double(),
            basis=basis,
            shade=(basis @ self.paint.light).exp(),
        )


class _NodeSolver:
    """From what vertices want to what the nodes of the graph do."""

    def __init__(self, graph: EmbeddedGraph) -> None:
        self.links, self.weights = graph.links, graph.weights.double()
        self.count = len(graph.nodes)
        self.pairs = (self.links[:, :, None] * self.count + self.links[:, None]).reshape(-1)
        self.products = (self.weights[:, :, None] * self.weights[:, None]).reshape(len(self.links), -1, 1)
        eye = torch.eye(self.count, device=self.links.device)
        apart = (eye - graph.adjacency(eye)).double()
        self.restraint = HOLD * eye.double() + STIFFNESS * apart.T @ apart

    def spread(self, nodes: Float[Tensor, "g 3"]) -> Float[Tensor, "v 3"]:
        """What the nodes have, blended at the vertices."""
        return (nodes[self.links] * self.weights[..., None]).sum(1)

    def solve(self, nodes: Float[Tensor, "g 3"], pull: Float[Tensor, "v 3 4"]) -> Float[Tensor, "g 3"]:
        """Where the nodes lie in balance between the vertices' equations and their restraint."""
        size = self.count
        pulled = self.weights[..., None] * pull[:, None, :, 3]
        target = -(self.restraint @ nodes).index_add_(0, self.links.reshape(-1), -pulled.reshape(-1, 3))
        shared = self.products * pull[:, None, :, :3].reshape(-1, 1, 9)
        blocks = pull.new_zeros(size * size, 9).index_add_(0, self.pairs, shared.reshape(-1, 9))
        system = blocks.reshape(size, size, 3, 3).permute(0, 2, 1, 3).contiguous()
        for axis in range(3):
            system[:, axis, :, axis] += self.restraint
        factor = torch.linalg.cholesky(system.reshape(3 * size, 3 * size))
        return nodes + torch.cholesky_solve(target.reshape(-1, 1), factor).reshape(size, 3)


def _draw(vertices: Tensor, faces: Tensor, view: ObservedView) -> _Drawn:
    corners = project_vertices(vertices, view.viewmat.to(vertices), view.K.to(vertices))
    drawn = rasterize_mesh(corners, faces, width=view.width, height=view.height)
    screen = (corners[:, :2] / corners[:, 2:]).double()
    return _Drawn(triangle=drawn.triangle, depth=drawn.depth, screen=screen)


def _slopes(view: ObservedView, points: Float[Tensor, "k 3"]) -> Float[Tensor, "k 2 3"]:
    """How pixels move with points in the world, per metre."""
    rotation = view.viewmat[:3, :3]
    x, y, depth = (points @ rotation.T + view.viewmat[:3, 3]).T
    right = rotation[0] - (x / depth)[:, None] * rotation[2]
    down = rotation[1] - (y / depth)[:, None] * rotation[2]
    return torch.stack([right * (view.K[0, 0] / depth)[:, None], down * (view.K[1, 1] / depth)[:, None]], 1)


def _pull_by_colours(
    pull: _Pull,
    shown: _Shown,
    view: ObservedView,
    drawn: _Drawn,
    reference: Painted,
    paint: _Paint,
) -> None:
    """Points that are seen want to go where the image has their colour."""
    corners = project_vertices(shown.points, view.viewmat, view.K)
    pixels, depth = corners[:, :2] / corners[:, 2:], corners[:, 2]
    towards = view.position - shown.points
    facing = (towards * shown.normals).sum(1) / towards.norm(dim=1)
    column, row = pixels[:, 0].clamp(0, view.width - 1).long(), pixels[:, 1].clamp(0, view.height - 1).long()
    front = (drawn.triangle[row, column] >= 0) & (depth < drawn.depth[row, column] + VISIBLE_WITHIN_M)
    chosen = ((facing > FACING) & front).nonzero().squeeze(1)
    values = sample(view.colours, pixels[chosen]).double()
    whole = (values[:, 9] > 0.99).nonzero().squeeze(1)
    chosen, values = chosen[whole], values[whole]
    paint.see(chosen, facing[chosen], shown.shade[chosen], values[:, :3])
    painted = reference.colours[chosen, 0].isfinite().nonzero().squeeze(1)
    chosen, values = chosen[painted], values[painted]
    if len(chosen) == 0:
        return
    colours = reference.colours[chosen] * shown.shade[chosen]
    error = colours - values[:, :3]
    surprise = (error**2).mean(1).sqrt() / (OUTLIER * COLOUR_ERROR)
    weight = facing[chosen] / (1 + surprise**2) ** 2 / COLOUR_ERROR**2
    some = slice(None, None, LIGHT_STRIDE)
    paint.correct_light(shown.basis[chosen][some], weight[some], colours[some], -error[some])
    slopes = torch.stack([values[:, 3:6], values[:, 6:9]], 2) @ _slopes(view, shown.points[chosen])  # [k, 3 colours, 3]
    weighted = (slopes * weight[:, None, None]).mT
    pull.see(chosen, weighted @ slopes, (weighted @ error[..., None])[..., 0])


def _pull_by_outline(
    pull: _Pull,
    shown: _Shown,
    view: ObservedView,
    drawn: _Drawn,
    topology: Topology,
    reach: float,
) -> None:
    """The template's outline wants to go to that of the mask, across it."""
    screen = drawn.screen
    ends, share, outward = _outline_points(screen, topology, drawn.triangle)
    if len(ends) == 0:
        return
    points = _between(screen, ends, share)
    distance, nearest = NearestPoint(points).of(view.outline, reach)
    aligned = (outward[nearest] * view.outward).sum(1) > ALIGNED
    matched = (distance.isfinite() & aligned).nonzero().squeeze(1)
    nearest, normal = nearest[matched], view.outward[matched]
    ends, share = ends[nearest], share[nearest]
    off = ((view.outline[matched] - points[nearest]) * normal).sum(1)
    weight = OUTLINE_WEIGHT / (1 + (off / OUTLINE_OUTLIER) ** 2)
    places = _between(shown.vertices.double(), ends, share)
    slope = (normal[:, None] @ _slopes(view, places))[:, 0]
    both = torch.cat([slope, off[:, None]], 1)
    pull.add(ends, share, weight[:, None, None] * slope[:, :, None] * both[:, None])


def _between(corners: Float[Tensor, "v d"], ends: Int[Tensor, "k 2"], share: Float[Tensor, "k 2"]) -> Tensor:
    """Points on edges, `[k, d]`."""
    return corners[ends[:, 0]] * share[:, :1] + corners[ends[:, 1]] * share[:, 1:]


def _outline_points(
    screen: Float[Tensor, "v 2"], topology: Topology, triangle: Int[Tensor, "h w"]
) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k 2"], Float[Tensor, "k 2"]]:
    """Points on edges beyond which there is nothing: their ends, the ends' shares, and the way out, in pixels."""
    faces = topology.faces
    face, edge = outline_edges(screen, topology).nonzero(as_tuple=True)
    ends = torch.stack([faces[face, edge], faces[face, (edge + 1) % 3]], 1)
    along = screen[ends[:, 1]] - screen[ends[:, 0]]
    outward = torch.stack([along[:, 1], -along[:, 0]], 1) / along.norm(dim=1, keepdim=True).clamp(min=1e-9)
    inside = ((screen[faces[face, (edge + 2) % 3]] - screen[ends[:, 0]]) * outward).sum(1) > 0
    outward = torch.where(inside[:, None], -outward, outward)
    shares = screen.new_tensor([[1 - s, s] for s in ALONG_EDGE])
    share = shares.repeat(len(ends), 1)
    ends, outward = (rows.repeat_interleave(len(ALONG_EDGE), 0) for rows in (ends, outward))
    beyond = (_between(screen, ends, share) + 1.2 * outward).floor().long()
    height, width = triangle.shape
    column, row = beyond.T
    there = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = triangle[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    free = (~there | (seen < 0)).nonzero().squeeze(1)
    return ends[free], share[free], outward[free]
