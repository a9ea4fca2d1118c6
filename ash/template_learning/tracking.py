"""Where the template's vertices lie in every training frame: what Stg.1 learns from, before and apart from the avatar.

Supervision is nothing but the videos ("images", in `ash.template_learning.image_tracking`) or what a studio has
("scans": a surface per frame with noise and holes, no correspondences; UMA, the successor of ASH, states this loss).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ash.capture.dataset import Capture, Pose
from ash.capture.formats import read_scan, read_template_truth
from ash.rotations import RigidTransforms
from ash.template.graph import NeighbourMean, vertex_neighbours
from ash.template.template import Template, vertex_normals
from ash.template_learning.nearest import NearestPoint

RANGE_M = 0.1  # A surface point farther away than this is no match,
ALIGNED = 0.7  # nor one whose normal differs by more than this cosine.
HOLE_M = 0.02  # A vertex whose nearest point lies farther beside it lies over a hole.
LAYER_M = 0.004  # One that is so much farther off its point than the point's nearest vertex is another layer's.
SCAN_RIM = 3  # Vertices from a hole that a scan is not believed: it was seen from aside there.
TRIM = 3.0  # Root mean squares by which a point may be off what is around it,
TRIM_SWEEPS = 2  # so far around.
NORMAL_SWEEPS = 3  # Of smoothing of a mesh's normals.
POINTS = 5000  # Of a surface that look for their nearest vertex.
SHARED_SWEEPS = (16, 4, 2)  # Smoothing of the correction that all frames share, pass by pass,
SHARED_FRAMES = 16  # seen from some of them,
OWN_SWEEPS = (8, 4, 2, 1)  # and then of each frame's own.


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracked:
    """The template in the training frames."""

    frames: tuple[int, ...]
    canonical: Float[Tensor, "t v 3"]  # metres, deformed but unposed; on the template's device

    @property
    def shift(self) -> Float[Tensor, "t v 3"]:
        """From the mean over the frames."""
        return self.canonical - self.canonical.mean(0)


Correction = Callable[[int, Tensor], tuple[Tensor, Tensor]]  # Frame, posed vertices -> shift [v, 3], weight [v].


def track_scans(capture: Capture, template: Template) -> Tracked:
    """Non-rigid registration to the scans of the training frames: both ways to the nearest point, along its normal.

    Moving along the mesh's normals alone leaves the vertices free to stay where skinning put them along it, which is
    what nobody without correspondences can know. First one correction is found for all frames, then each frame's own;
    corrections are smoothed over the template, less from pass to pass. Where the mesh has a hole nothing pulls, and a
    point that is far off all others around it is noise: the template follows its neighbours there.
    """
    device = template.device
    meshes = {frame: _Mesh(*read_scan(capture, frame), device=device) for frame in capture.splits["train"].frames}
    neighbours = vertex_neighbours(template.mesh).to(device)

    def towards_mesh(frame: int, posed: Tensor) -> tuple[Tensor, Tensor]:
        return meshes[frame].correction(posed, vertex_normals(posed, template.faces), neighbours)

    return _register(capture, template, towards_mesh)


def _register(capture: Capture, template: Template, correction: Correction) -> Tracked:
    frames = capture.splits["train"].frames
    neighbours = vertex_neighbours(template.mesh).to(template.device)
    transforms = {frame: template.pose(Pose(capture.motion, frame)).transforms for frame in frames}
    rest = torch.from_numpy(template.mesh.vertices).float().to(template.device)
    canonical = rest.expand(len(frames), -1, -1).clone()
    some = range(0, len(frames), -(-len(frames) // SHARED_FRAMES))
    for sweeps in SHARED_SWEEPS:
        corrections = [_in_canonical(transforms[frames[i]], canonical[i], frames[i], correction) for i in some]
        shift, weight = (torch.stack(parts) for parts in zip(*corrections, strict=True))
        total = weight.sum(0)
        mean = (shift * weight[..., None]).sum(0) / total.clamp(min=1)[:, None]
        canonical += smoothed(mean, total / len(some), neighbours, sweeps)
    for sweeps in OWN_SWEEPS:
        for index, frame in enumerate(frames):
            shift, weight = _in_canonical(transforms[frame], canonical[index], frame, correction)
            canonical[index] += smoothed(shift, weight, neighbours, sweeps)
            canonical[index] = rest + (canonical[index] - rest) * _confidence(weight, neighbours)
    return Tracked(frames=frames, canonical=canonical)


def _in_canonical(
    transforms: RigidTransforms, canonical: Tensor, frame: int, correction: Correction
) -> tuple[Tensor, Tensor]:
    posed = transforms.apply(canonical)
    shift, weight = correction(frame, posed)
    return transforms.apply_inverse(posed + shift) - canonical, weight


def smoothed(
    shift: Float[Tensor, "v 3"], weight: Float[Tensor, " v"], neighbours: NeighbourMean, sweeps: int
) -> Float[Tensor, "v 3"]:
    """Mean of the weighted shifts around every vertex: where nothing has weight, nothing moves."""
    mean = shift * weight[:, None]
    for _ in range(sweeps):
        mean = 0.5 * (mean + neighbours(mean))
    return mean


def _confidence(weight: Float[Tensor, " v"], neighbours: NeighbourMean) -> Float[Tensor, "v 1"]:
    """1 where most neighbours have a match, falling to 0 in the middle of a hole of the scan."""
    share = weight[:, None]
    for _ in range(OWN_SWEEPS[0]):
        share = 0.5 * (share + neighbours(share))
    return (2 * share).clamp(max=1)


class _Mesh:
    """A surface of one frame on a device, to look up the nearest points of."""

    def __init__(
        self, vertices: Float[np.ndarray, "s 3"], faces: Int[np.ndarray, "f 3"], *, device: torch.device
    ) -> None:
        places = torch.from_numpy(vertices).double().to(device)
        self.nearest, self.points = NearestPoint(places), places.float()
        self.normals = _smooth_normals(self.points, torch.from_numpy(faces).to(device))
        self.believed = ~torch.from_numpy(_rim(faces, len(vertices))).to(device)
        self.few = torch.arange(0, len(vertices), max(1, len(vertices) // POINTS), device=device)

    def correction(self, posed: Tensor, normals: Tensor, neighbours: NeighbourMean) -> tuple[Tensor, Tensor]:
        """Mean shift along the normals of the mesh, from each vertex' nearest point and from the points nearest to it;
        and 1 where there is any, else 0."""
        vertices, points = self._matches(posed, normals)
        normal = self.normals[points]
        off = ((self.points[points] - posed[vertices]) * normal).sum(1, keepdim=True)
        around, _ = _mean_of_matches(off, vertices, len(posed))
        for _ in range(TRIM_SWEEPS):
            around = 0.5 * (around + neighbours(around))
        surprise = (off - around[vertices]).abs().squeeze(1)
        matched = (surprise <= TRIM * surprise.square().mean().sqrt()).nonzero().squeeze(1)
        return _mean_of_matches((off * normal)[matched], vertices[matched], len(posed))

    def _matches(self, posed: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Pairs of a vertex and a point that belong together."""
        distance, forward = self.nearest.of(posed.double(), RANGE_M)
        back, vertex = NearestPoint(posed.double()).of(self.points.double())
        off, beside = self._apart(posed, forward)
        # A leg under a skirt that alone was scanned is not to be drawn to it: the skirt's own vertices are nearer.
        owner_off, _ = self._apart(posed[vertex[forward]], forward)
        nearer = off.abs() < owner_off.abs() + LAYER_M
        own = (distance.isfinite() & (beside < HOLE_M) & nearer).nonzero().squeeze(1)
        few = self.few[(back[self.few] < RANGE_M).nonzero().squeeze(1)]
        vertices, points = torch.cat([own, vertex[few]]), torch.cat([forward[own], few])
        aligned = (self.normals[points] * normals[vertices]).sum(1) > ALIGNED
        matched = (aligned & self.believed[points]).nonzero().squeeze(1)
        return vertices[matched], points[matched]

    def _apart(self, places: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """How far points lie from places along their normals, and how far beside them; metres."""
        normal, apart = self.normals[points], self.points[points] - places
        off = (apart * normal).sum(1)
        return off, (apart - normal * off[:, None]).norm(dim=1)


def _rim(faces: Int[np.ndarray, "f 3"], count: int) -> Bool[np.ndarray, " s"]:
    """Vertices on open edges, and those around them, SCAN_RIM deep: a scanner sees them at grazing angles."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    _, name, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_inverse=True, return_counts=True)
    rim = np.zeros(count, bool)
    rim[edges[uses[name] == 1].ravel()] = SCAN_RIM > 0
    for _ in range(SCAN_RIM - 1):
        rim[faces[rim[faces].any(1)].ravel()] = True
    return rim


def _smooth_normals(vertices: Float[Tensor, "s 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "s 3"]:
    """Normals without the grain of a scan: means over the faces around, some rounds of it."""
    normals = vertex_normals(vertices, faces)
    for _ in range(NORMAL_SWEEPS):
        of_faces = normals[faces].mean(1).repeat_interleave(3, 0)
        normals = torch.nn.functional.normalize(torch.zeros_like(normals).index_add_(0, faces.reshape(-1), of_faces))
    return normals


def _mean_of_matches(values: Tensor, vertices: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Mean of the values `[n, c]` of each vertex' matches, and 1 where there is any, else 0."""
    total = values.new_zeros(count, values.shape[1]).index_add_(0, vertices, values)
    matches = values.new_zeros(count).index_add_(0, vertices, values.new_ones(len(vertices)))
    return total / matches.clamp(min=1)[:, None], (matches > 0).float()


def template_error_mm(template: Template, capture: Capture, frames: tuple[int, ...]) -> Float[np.ndarray, "t v"]:
    """Distance of every posed vertex from where it really is, millimetres: known only because the truth was made."""
    truth = read_template_truth(capture)
    posed = [template.pose(Pose(capture.motion, frame)).vertices.cpu().numpy() for frame in frames]
    return 1e3 * np.linalg.norm(np.stack(posed) - truth[list(frames)], axis=-1)
