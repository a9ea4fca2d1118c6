"""Training the deformable template (Stg.1), before and apart from the avatar.

Supervision is either exact ("vertices": an oracle, correspondences known) or what a lab has ("chamfer": a surface
per frame, no correspondences; UMA, the successor of ASH, states this loss).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ash.config import one_of
from ash.dataset import Capture, read_surface_truth, read_template_truth
from ash.deforming import LearnedDeformation
from ash.files import InputError
from ash.template import RestDeformation, Template

SURFACE_POINTS = 6000


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingConfig:
    """One frame per step, Adam with a linear decay."""

    supervision: str = "chamfer"
    steps: int = 1500
    learning_rate: float = 2e-3
    smoothness: float = 0.1  # Weight of the Laplacian of the deformation, against squared millimetres.

    def __post_init__(self) -> None:
        """Refuse an unknown supervision."""
        one_of("supervision", self.supervision, ("vertices", "chamfer"))
        if self.steps < 1:
            raise InputError(f"tracking: expected at least one step, got {self.steps}")


Distance = Callable[[Tensor], Tensor]  # Posed vertices [v, 3], metres -> mean squared error, metres^2.


def track(deformation: LearnedDeformation, capture: Capture, config: TrackingConfig, *, seed: int) -> None:
    """Fit the deformation to the training frames, in place."""
    frames = capture.splits["train"].frames
    distances = _distances(capture, config, seed)
    windows = {frame: deformation.window_transforms(capture.motion, frame) for frame in frames}
    skinned = Template(capture.template, capture.skeleton, RestDeformation(capture.template))
    optimiser = torch.optim.Adam(deformation.parameters(), lr=config.learning_rate, fused=True)
    for step in range(config.steps):
        epoch, position = divmod(step, len(frames))
        frame = frames[np.random.default_rng([seed, epoch]).permutation(len(frames))[position]]
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * (1 - step / config.steps)
        canonical = deformation.deform(windows[frame])
        posed = skinned.pose(capture.motion, frame).transforms.apply(canonical)
        loss = distances[frame](posed) + config.smoothness * _roughness(deformation, canonical)
        optimiser.zero_grad()
        (1e6 * loss).backward()  # type: ignore[no-untyped-call]
        optimiser.step()


def _roughness(deformation: LearnedDeformation, canonical: Float[Tensor, "v 3"]) -> Tensor:
    """Mean squared difference between a vertex's shift and the mean shift of its neighbours."""
    shift = canonical - deformation.rest
    return ((shift - deformation.graph.vertex_adjacency(shift)) ** 2).sum(1).mean()


def _distances(capture: Capture, config: TrackingConfig, seed: int) -> dict[int, Distance]:
    frames = capture.splits["train"].frames
    if config.supervision == "vertices":
        truth = torch.from_numpy(read_template_truth(capture)).float()
        return {frame: _to_vertices(truth[frame]) for frame in frames}
    return {frame: _chamfer(read_surface_truth(capture, frame), seed) for frame in frames}


def _to_vertices(truth: Float[Tensor, "v 3"]) -> Distance:
    return lambda posed: ((posed - truth) ** 2).sum(1).mean()


def _chamfer(surface: Float[np.ndarray, "s 3"], seed: int) -> Distance:
    """Mean squared distance both ways; nearest points are found anew each time, and held while differentiating."""
    chosen = np.random.default_rng(seed).choice(len(surface), min(SURFACE_POINTS, len(surface)), replace=False)
    tree, points = cKDTree(surface), torch.from_numpy(surface).float()

    def distance(posed: Tensor) -> Tensor:
        vertices = posed.detach().numpy()
        to_surface = points[torch.from_numpy(tree.query(vertices)[1])]
        to_template = posed[torch.from_numpy(cKDTree(vertices).query(surface[chosen])[1])]
        return ((posed - to_surface) ** 2).sum(1).mean() + ((to_template - points[chosen]) ** 2).sum(1).mean()

    return distance


def template_error_mm(template: Template, capture: Capture, frames: tuple[int, ...]) -> Float[np.ndarray, "t v"]:
    """Distance of every posed vertex from where it really is, millimetres: known only because the truth was made."""
    truth = read_template_truth(capture)
    posed = [template.pose(capture.motion, frame).vertices.numpy() for frame in frames]
    return 1e3 * np.linalg.norm(np.stack(posed) - truth[list(frames)], axis=-1)
