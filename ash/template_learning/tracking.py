"""Where the template's vertices lie in every training frame: what Stg.1 learns from, before and apart from the avatar.

Supervision is exact ("vertices": an oracle, correspondences known), what a lab has ("chamfer": a surface per frame,
no correspondences; UMA, the successor of ASH, states this loss), or nothing but the videos ("images", in
`ash.template_learning.image_tracking`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ash.capture.dataset import Capture, Pose
from ash.capture.formats import read_scan, read_template_truth
from ash.rotations import RigidTransforms
from ash.template.graph import NeighbourMean, vertex_neighbours
from ash.template.template import Template, vertex_normals

RANGE_M = 0.1  # A surface point farther away than this is no match,
ALIGNED = 0.7  # nor one whose normal differs by more than this cosine.
POINTS = 5000  # Of a surface that look for their nearest vertex.
SHARED_SWEEPS = (16, 4, 2)  # Smoothing of the correction that all frames share, pass by pass,
SHARED_FRAMES = 16  # seen from some of them,
OWN_SWEEPS = (8, 4, 2, 1)  # and then of each frame's own.


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracked:
    """The template in the training frames."""

    frames: tuple[int, ...]
    canonical: Float[Tensor, "t v 3"]  # metres, deformed but unposed

    @property
    def shift(self) -> Float[Tensor, "t v 3"]:
        """From the mean over the frames."""
        return self.canonical - self.canonical.mean(0)


Correction = Callable[[int, Tensor], tuple[Tensor, Tensor]]  # Frame, posed vertices -> shift [v, 3], weight [v].


def track_vertices(capture: Capture, template: Template) -> Tracked:
    """The oracle: the true vertices, brought back to canonical space."""
    frames = capture.splits["train"].frames
    truth = torch.from_numpy(read_template_truth(capture)).float()
    canonical = [template.pose(Pose(capture.motion, f)).transforms.apply_inverse(truth[f]) for f in frames]
    return Tracked(frames=frames, canonical=torch.stack(canonical))


def track_chamfer(capture: Capture, template: Template) -> Tracked:
    """Non-rigid registration to a surface per frame: both ways to the nearest point, along its normal.

    Moving along the surface's normals alone leaves the vertices free to stay where skinning put them along it, which
    is what nobody without correspondences can know. First one correction is found for all frames, then each frame's
    own; corrections are smoothed over the template, less from pass to pass.
    """
    scans = {frame: _Scan(*read_scan(capture, frame)) for frame in capture.splits["train"].frames}

    def towards_scan(frame: int, posed: Tensor) -> tuple[Tensor, Tensor]:
        return scans[frame].correction(posed, vertex_normals(posed, template.faces))

    return _register(capture, template, towards_scan)


def _register(capture: Capture, template: Template, correction: Correction) -> Tracked:
    frames = capture.splits["train"].frames
    neighbours = vertex_neighbours(template.mesh)
    transforms = {frame: template.pose(Pose(capture.motion, frame)).transforms for frame in frames}
    rest = torch.from_numpy(template.mesh.vertices).float()
    canonical = rest.expand(len(frames), -1, -1).clone()
    some = range(0, len(frames), -(-len(frames) // SHARED_FRAMES))
    for sweeps in SHARED_SWEEPS:
        found = [_in_canonical(transforms[frames[i]], canonical[i], frames[i], correction) for i in some]
        shift, weight = (torch.stack(parts) for parts in zip(*found, strict=True))
        total = weight.sum(0)
        mean = (shift * weight[..., None]).sum(0) / total.clamp(min=1)[:, None]
        canonical += smoothed(mean, total / len(some), neighbours, sweeps)
    for sweeps in OWN_SWEEPS:
        for index, frame in enumerate(frames):
            shift, weight = _in_canonical(transforms[frame], canonical[index], frame, correction)
            canonical[index] += smoothed(shift, weight, neighbours, sweeps)
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
    """Weighted mean of the shifts around every vertex; what no weighted vertex is near stays where it is."""
    both = torch.cat([shift * weight[:, None], weight[:, None]], 1)
    for _ in range(sweeps):
        both = 0.5 * (both + neighbours(both))
    return both[:, :3] / both[:, 3:].clamp(min=0.05)


class _Scan:
    """A surface of one frame, to look up the nearest points of."""

    def __init__(self, vertices: Float[np.ndarray, "s 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self.points = torch.from_numpy(vertices).float()
        self.normals = vertex_normals(self.points, torch.from_numpy(faces))
        self.tree = cKDTree(vertices)
        self.few = torch.arange(0, len(vertices), max(1, len(vertices) // POINTS))

    def correction(self, posed: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Mean shift along the normals of the scan, from each vertex' nearest point and from the points nearest to it;
        and 1 where there is any, else 0."""
        # A vertex without a point in range gets an infinite distance and a number beyond the last point.
        distance, nearest = self.tree.query(posed.numpy(), distance_upper_bound=RANGE_M)
        back, vertex = cKDTree(posed.numpy()).query(self.points[self.few].numpy())
        vertices = torch.cat([torch.arange(len(posed)), torch.from_numpy(vertex)])
        points = torch.cat([torch.from_numpy(nearest).clamp(max=len(self.points) - 1), self.few])
        normal = self.normals[points]
        matches = (torch.from_numpy(np.concatenate([distance, back])) < RANGE_M) & (
            (normal * normals[vertices]).sum(1) > ALIGNED
        )
        shift = normal * ((self.points[points] - posed[vertices]) * normal).sum(1, keepdim=True)
        total = torch.zeros_like(posed).index_add_(0, vertices[matches], shift[matches])
        count = torch.zeros(len(posed)).index_add_(0, vertices, matches.float())
        return total / count.clamp(min=1)[:, None], (count > 0).float()


def template_error_mm(template: Template, capture: Capture, frames: tuple[int, ...]) -> Float[np.ndarray, "t v"]:
    """Distance of every posed vertex from where it really is, millimetres: known only because the truth was made."""
    truth = read_template_truth(capture)
    posed = [template.pose(Pose(capture.motion, frame)).vertices.numpy() for frame in frames]
    return 1e3 * np.linalg.norm(np.stack(posed) - truth[list(frames)], axis=-1)
