"""The template from nothing but the training videos: the paper's claim, and supervision "images".

Every frame's vertices are moved until the template shows what the training cameras saw (weak supervision of Habermann
et al. 2021, by Gauss and Newton in place of gradient descent). Two things pull. Inside the subject, points of the
surface look for their colour, which is the mean of what all views show of them, under light of 27 numbers: in an image,
along its slope. At its outline, the template's outline is drawn to that of the mask. What moves are the nodes of the
embedded graph, held together and at home by weights that stand for how a template usually errs. Every pass looks at
every view once, sharper from pass to pass. What comes out are tracked frames, as from any other supervision.

Colours cannot tell where on the surface its paint lies: along it, the mean over the frames stays at rest.

The template is posed, shaded and drawn, and the nodes' equations are solved, on the template's device; between, images
are filtered and equations put together by NumPy and SciPy.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ash.capture.dataset import Camera, Capture, Pose
from ash.devices import moved
from ash.harmonics import sh_basis
from ash.mesh.drawing import Topology, topology_of
from ash.mesh.rasterizing import project_vertices, rasterize_mesh
from ash.rotations import RigidTransforms, unitquat_to_rotmat
from ash.template.graph import EmbeddedGraph
from ash.template.template import Template, vertex_normals
from ash.template_learning.observing import ObservedView, observe, sample
from ash.template_learning.tracking import Tracked
from ash.textures import TexelLattice, build_lattice
from ash.training.images import load_training_images

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


def track_images(capture: Capture, template: Template, graph: EmbeddedGraph, *, passes: int) -> Tracked:
    """Fit the template to the training images, frame by frame, `passes` times over."""
    images = load_training_images(capture)
    subject = _Subject(template, graph, len(images.frames))
    posed = [template.pose(Pose(capture.motion, frame)).transforms for frame in images.frames]
    for step in range(passes):
        progress = step / max(1, passes - 1)
        blur, reach = (first * (last / first) ** progress for first, last in (BLURS, REACHES))
        paint = _Paint(subject.paint)
        for index, frame in enumerate(images.frames):
            views = [
                observe(images.views[name, frame], images.cameras[name], blur=blur) for name in images.seeing(frame)
            ]
            subject.move(index, posed[index], views, paint, reach=reach)
        subject.paint = paint.mean()
    canonical = torch.from_numpy(np.stack([subject.canonical(i) for i in range(len(images.frames))])).float()
    return Tracked(frames=images.frames, canonical=canonical.to(template.device))


@dataclass(frozen=True, kw_only=True, slots=True)
class Painted:
    """What colours the surface has."""

    colours: Float[np.ndarray, "n 3"]  # of the points; NaN: hardly ever seen
    light: Float[np.ndarray, "9 3"]  # coefficients of the exponent that multiplies them


class _Paint:
    """Gathers the colours and the light of the next pass from what this one sees."""

    def __init__(self, known: Painted) -> None:
        self.known = known
        self.total, self.weight = np.zeros_like(known.colours), np.zeros_like(known.colours)
        self.normal, self.right = np.zeros((3, 9, 9)), np.zeros((3, 9))

    def see(self, points: Int[np.ndarray, " k"], weight: np.ndarray, shade: np.ndarray, seen: np.ndarray) -> None:
        """`shade`: what light makes of white there; `seen`: its colour, `[k, 3]` both."""
        self.total[points] += weight[:, None] * shade * seen
        self.weight[points] += weight[:, None] * shade**2

    def correct_light(self, basis: np.ndarray, weight: np.ndarray, drawn: np.ndarray, error: np.ndarray) -> None:
        """Normal equations of the light's coefficients, from colours `drawn` and how far they are off, `[k, 3]`."""
        for channel in range(3):
            slope = drawn[:, channel : channel + 1] * basis
            self.normal[channel] += (slope * weight[:, None]).T @ slope
            self.right[channel] += (slope * weight[:, None]).T @ error[:, channel]

    def mean(self) -> Painted:
        """The colours and the light that follow."""
        enough = (self.weight > SEEN_OFTEN).all(1, keepdims=True)
        colours = np.where(enough, self.total / np.where(enough, self.weight, 1), np.nan)
        damped = self.normal + 1e-3 * np.trace(self.normal, axis1=1, axis2=2)[:, None, None] * np.eye(9) / 9
        solvable = damped.any((1, 2))
        light = self.known.light.copy()
        light[:, solvable] += LIGHT_STEP * np.linalg.solve(damped[solvable], self.right[solvable][..., None])[..., 0].T
        return Painted(colours=colours, light=light)


@dataclass(slots=True)
class _Pull:
    """Normal equations of where the vertices of a frame want to go: world, metres.

    A point within a triangle is three vertices: its equation is shared out between them, which bounds the sum from
    above, so that a step never overshoots.
    """

    count: int
    normal: np.ndarray = field(init=False)  # [v, 3, 3]
    right: np.ndarray = field(init=False)  # [v, 3]

    def __post_init__(self) -> None:
        self.normal, self.right = np.zeros((self.count, 3, 3)), np.zeros((self.count, 3))

    def add(self, vertices: np.ndarray, weights: np.ndarray, normal: np.ndarray, right: np.ndarray) -> None:
        """Points `[k]` of corners `vertices` `[k, c]` with `weights`, their `normal` `[k, 3, 3]`, `right` `[k, 3]`."""
        for corner, share in zip(vertices.T, weights.T, strict=True):
            for i in range(3):
                self.right[:, i] += np.bincount(corner, share * right[:, i], self.count)
                for j in range(i, 3):
                    self.normal[:, i, j] += np.bincount(corner, share * normal[:, i, j], self.count)

    def in_canonical(self, rotations: Float[np.ndarray, "v 3 3"]) -> tuple[np.ndarray, np.ndarray]:
        """The equations for shifts before posing: `normal` whole, and `right`."""
        upper = np.triu(np.ones((3, 3), bool))
        whole = np.where(upper, self.normal, self.normal.transpose(0, 2, 1))
        turned = rotations.transpose(0, 2, 1)
        return turned @ whole @ rotations, (turned @ self.right[..., None])[..., 0]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shown:
    """The template as a frame has it."""

    vertices: Float[Tensor, "v 3"]  # metres, world; on the template's device
    corners: Float[np.ndarray, "v 3"]  # the same
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    basis: Float[np.ndarray, "n 9"]  # of light
    shade: Float[np.ndarray, "n 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Drawn:
    """What a camera sees of the template."""

    triangle: Int[np.ndarray, "h w"]  # -1: none
    depth: Float[np.ndarray, "h w"]  # metres
    screen: Float[np.ndarray, "v 2"]  # the vertices in pixels


class _Subject:
    """Everything that is learned: translations of the nodes per frame, colours, light."""

    def __init__(self, template: Template, graph: EmbeddedGraph, frames: int) -> None:
        mesh = template.mesh
        self.lattice: TexelLattice = moved(build_lattice(mesh, TEXELS), template.device)
        self.topology: Topology = topology_of(torch.from_numpy(mesh.faces))  # Whose outlines NumPy follows.
        self.faces = template.faces
        self.rest = mesh.vertices
        self.normals = vertex_normals(torch.from_numpy(mesh.vertices), self.topology.faces).numpy()
        self.solver = _NodeSolver(graph)
        self.nodes = np.zeros((frames, len(graph.nodes), 3))
        self.paint = Painted(colours=np.full((len(self.lattice.texels), 3), np.nan), light=np.zeros((9, 3)))
        self._slide = np.zeros_like(self.rest)

    def canonical(self, index: int) -> Float[np.ndarray, "v 3"]:
        """The vertices of the `index`-th training frame."""
        mean = self.solver.spread(self.nodes.mean(0))
        along = mean - self.normals * (mean * self.normals).sum(1, keepdims=True)
        shifted: np.ndarray = self.rest + self.solver.spread(self.nodes[index]) - along
        return shifted

    def move(
        self, index: int, transforms: RigidTransforms, views: Sequence[ObservedView], paint: _Paint, *, reach: float
    ) -> None:
        """One step of Gauss and Newton for a frame; what it sees goes into `paint`."""
        shown = self._show(index, transforms)
        pull, seen = _Pull(len(self.rest)), _Pull(len(self.lattice.texels))
        for view in views:
            drawn = _draw(shown.vertices, self.faces, view.camera)
            _pull_by_colours(seen, shown, view, drawn, self.paint, paint)
            _pull_by_outline(pull, shown, view, drawn, self.topology, reach)
        pull.add(_here(self.lattice.corners), _here(self.lattice.barycentric.double()), seen.normal, seen.right)
        rotations = _here(unitquat_to_rotmat(transforms.quats).double())
        self.nodes[index] = self.solver.solve(self.nodes[index], *pull.in_canonical(rotations))

    def _show(self, index: int, transforms: RigidTransforms) -> _Shown:
        vertices = transforms.apply(torch.from_numpy(self.canonical(index)).float().to(self.faces.device))
        normals = vertex_normals(vertices, self.faces)
        across = torch.nn.functional.normalize(self.lattice.interpolate(normals), dim=-1)
        basis = _here(sh_basis(across, 2).double())
        return _Shown(
            vertices=vertices,
            corners=_here(vertices.double()),
            points=_here(self.lattice.interpolate(vertices).double()),
            normals=_here(across.double()),
            basis=basis,
            shade=np.exp(basis @ self.paint.light),
        )


class _NodeSolver:
    """From what vertices want to what the nodes of the graph do."""

    def __init__(self, graph: EmbeddedGraph) -> None:
        self.device = graph.links.device
        self.links, self.weights = _here(graph.links), _here(graph.weights.double())
        self.count, links = len(graph.nodes), self.links.shape[1]
        pairs = self.links[:, :, None] * self.count + self.links[:, None]
        self.pairs = pairs.reshape(-1)
        self.products = (self.weights[:, :, None] * self.weights[:, None]).reshape(-1)
        self.vertices = np.repeat(np.arange(len(self.links)), links * links)
        apart = np.eye(self.count) - _here(graph.adjacency(torch.eye(self.count, device=self.device)).double())
        self.restraint = HOLD * np.eye(self.count) + STIFFNESS * apart.T @ apart

    def spread(self, nodes: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "v 3"]:
        """What the nodes have, blended at the vertices."""
        return (nodes[self.links] * self.weights[..., None]).sum(1)

    def solve(
        self, nodes: Float[np.ndarray, "g 3"], normal: Float[np.ndarray, "v 3 3"], right: Float[np.ndarray, "v 3"]
    ) -> Float[np.ndarray, "g 3"]:
        """Where the nodes lie in balance between the vertices' equations and their restraint."""
        size = self.count
        system = np.zeros((size, 3, size, 3))
        target = np.zeros((size, 3))
        for i in range(3):
            system[:, i, :, i] = self.restraint
            pulled = (self.weights * right[:, i : i + 1]).ravel()
            target[:, i] = np.bincount(self.links.ravel(), pulled, size) - self.restraint @ nodes[:, i]
        for i in range(3):
            for j in range(i, 3):
                block = np.bincount(self.pairs, self.products * normal[self.vertices, i, j], size * size)
                system[:, i, :, j] += block.reshape(size, size)
                if i != j:
                    system[:, j, :, i] += block.reshape(size, size)
        whole = torch.from_numpy(system.reshape(3 * size, 3 * size)).to(self.device)
        wanted = torch.from_numpy(target.reshape(-1, 1)).to(self.device)
        step = torch.cholesky_solve(wanted, torch.linalg.cholesky(whole))
        return nodes + _here(step).reshape(size, 3)


def _here(tensor: Tensor) -> np.ndarray:
    """What equations are put together from: on the CPU, whatever the device."""
    return tensor.cpu().numpy()


def _draw(vertices: Tensor, faces: Tensor, camera: Camera) -> _Drawn:
    viewmat, K = (torch.from_numpy(matrix).to(vertices) for matrix in (camera.viewmat, camera.K))
    corners = project_vertices(vertices, viewmat, K)
    drawn = rasterize_mesh(corners, faces, width=camera.width, height=camera.height)
    screen = (corners[:, :2] / corners[:, 2:]).double()
    return _Drawn(triangle=_here(drawn.triangle), depth=_here(drawn.depth), screen=_here(screen))


def _slopes(camera: Camera, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 2 3"]:
    """How pixels move with points in the world, per metre."""
    rotation, K = camera.viewmat[:3, :3], camera.K
    x, y, depth = (points @ rotation.T + camera.viewmat[:3, 3]).T
    right = rotation[0] - (x / depth)[:, None] * rotation[2]
    down = rotation[1] - (y / depth)[:, None] * rotation[2]
    return np.stack([right * (K[0, 0] / depth)[:, None], down * (K[1, 1] / depth)[:, None]], 1)


def _pull_by_colours(
    pull: _Pull,
    shown: _Shown,
    view: ObservedView,
    drawn: _Drawn,
    known: Painted,
    paint: _Paint,
) -> None:
    """Points that are seen want to go where the image has their colour."""
    camera = view.camera
    pixels, depth = camera.project(shown.points)
    towards = camera.position - shown.points
    facing = (towards * shown.normals).sum(1) / np.linalg.norm(towards, axis=1)
    column = np.clip(pixels[:, 0], 0, camera.width - 1).astype(np.int64)
    row = np.clip(pixels[:, 1], 0, camera.height - 1).astype(np.int64)
    front = (drawn.triangle[row, column] >= 0) & (depth < drawn.depth[row, column] + VISIBLE_WITHIN_M)
    chosen = np.flatnonzero((facing > FACING) & front)
    values = sample(view.colours, pixels[chosen]).astype(np.float64)
    whole = values[:, 9] > 0.99
    chosen, values = chosen[whole], values[whole]
    paint.see(chosen, facing[chosen], shown.shade[chosen], values[:, :3])
    painted = np.isfinite(known.colours[chosen, 0])
    chosen, values = chosen[painted], values[painted]
    if len(chosen) == 0:
        return
    colours = known.colours[chosen] * shown.shade[chosen]
    error = colours - values[:, :3]
    surprise = np.sqrt((error**2).mean(1)) / (OUTLIER * COLOUR_ERROR)
    weight = facing[chosen] / (1 + surprise**2) ** 2 / COLOUR_ERROR**2
    some = slice(None, None, LIGHT_STRIDE)
    paint.correct_light(shown.basis[chosen][some], weight[some], colours[some], -error[some])
    slopes = np.stack([values[:, 3:6], values[:, 6:9]], 2) @ _slopes(camera, shown.points[chosen])  # [k, 3 colours, 3]
    pull.normal[chosen] += (slopes * weight[:, None, None]).transpose(0, 2, 1) @ slopes
    pull.right[chosen] += ((error * weight[:, None])[:, None] @ slopes)[:, 0]


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
    points = screen[ends[:, 0]] * share[:, :1] + screen[ends[:, 1]] * share[:, 1:]
    distance, nearest = cKDTree(points).query(view.outline, distance_upper_bound=reach)
    found = np.flatnonzero(np.isfinite(distance))
    found = found[(outward[nearest[found]] * view.outward[found]).sum(1) > ALIGNED]
    nearest, normal = nearest[found], view.outward[found]
    ends, share = ends[nearest], share[nearest]
    off = ((view.outline[found] - points[nearest]) * normal).sum(1)
    weight = OUTLINE_WEIGHT / (1 + (off / OUTLINE_OUTLIER) ** 2)
    places = shown.corners[ends[:, 0]] * share[:, :1] + shown.corners[ends[:, 1]] * share[:, 1:]
    slope = (normal[:, None] @ _slopes(view.camera, places))[:, 0]
    pull.add(ends, share, weight[:, None, None] * slope[:, :, None] * slope[:, None], (weight * off)[:, None] * slope)


def _outline_points(
    screen: Float[np.ndarray, "v 2"], topology: Topology, triangle: Int[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]:
    """Points on edges beyond which there is nothing: their ends, the ends' shares, and the way out, in pixels."""
    faces, across = topology.faces.numpy(), topology.across.numpy()
    a, b, c = (screen[faces[:, corner]] for corner in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] > 0
    ahead = across > np.arange(len(faces))[:, None]
    face, edge = np.nonzero((across < 0) | (ahead & (turn[across] != turn[:, None])))
    ends = np.stack([faces[face, edge], faces[face, (edge + 1) % 3]], 1)
    along = screen[ends[:, 1]] - screen[ends[:, 0]]
    outward = np.stack([along[:, 1], -along[:, 0]], 1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    inside = ((screen[faces[face, (edge + 2) % 3]] - screen[ends[:, 0]]) * outward).sum(1) > 0
    outward = np.where(inside[:, None], -outward, outward)
    share = np.tile(np.array([[1 - s, s] for s in ALONG_EDGE]), (len(ends), 1))
    ends, outward = (np.repeat(rows, len(ALONG_EDGE), 0) for rows in (ends, outward))
    points = screen[ends[:, 0]] * share[:, :1] + screen[ends[:, 1]] * share[:, 1:]
    beyond = np.floor(points + 1.2 * outward).astype(np.int64)
    height, width = triangle.shape
    there = ((beyond >= 0) & (beyond < (width, height))).all(1)
    column, row = np.where(there[:, None], beyond, 0).T
    free = ~there | (triangle[row, column] < 0)
    return ends[free], share[free], outward[free]
