"""What images add to a template after it was learned: the paper leaves it to the future, DDC lives by it.

`Refinement` is a displacement of the vertices that all frames share. `MotionRefinement` adds the paper's networks of
Stg.1, embedded graph and displacements, trained by what is drawn in place of by a surface. Both start at nothing.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Pose, Skeleton, TemplateMesh
from ash.config import TemplateConfig
from ash.devices import MovingModule, moved
from ash.rotations import RigidTransforms
from ash.template.graph import vertex_neighbours
from ash.template.template import Deformation, Template
from ash.template_learning.graph_nets import GraphDeformation

UNIT_M = 0.004  # Of what is learned: Adam's step of 0.02 is then a twelfth of a millimetre.
SWEEPS = 4  # Of smoothing over neighbours: a vertex is pulled by the pixels around it, not by a handful of its own.


class Refinement(MovingModule):
    """A displacement of every canonical vertex, the same in all frames, that an avatar learns with the rest of it."""

    def __init__(self, mesh: TemplateMesh) -> None:
        super().__init__()
        self.neighbours = vertex_neighbours(mesh)
        self.rough = nn.Parameter(torch.zeros(len(mesh.vertices), 3))

    def forward(self) -> Float[Tensor, "v 3"]:
        """Metres, canonical."""
        shift: Tensor = self.rough
        for _ in range(SWEEPS):
            shift = 0.5 * (shift + self.neighbours(shift))
        return UNIT_M * shift


class MotionRefinement(nn.Module):
    """A displacement of every canonical vertex that follows the motion: Eq. 10 on top of a template that is there."""

    def __init__(self, config: TemplateConfig, mesh: TemplateMesh, skeleton: Skeleton) -> None:
        super().__init__()
        self.shared = Refinement(mesh)
        self.nets = GraphDeformation(config, mesh, skeleton)

    def window(self, pose: Pose) -> list[RigidTransforms]:
        """What the networks see of a frame."""
        return self.nets.window_transforms(pose)

    def forward(self, window: list[RigidTransforms]) -> Float[Tensor, "v 3"]:
        """Metres, canonical."""
        return self.shared() + self.nets.deform(window) - self.nets.rest


class RefinedDeformation:
    """A deformation with what images add to it. The `ash.template.template.Deformation` protocol."""

    def __init__(self, inner: Deformation, refinement: MotionRefinement) -> None:
        self.inner, self.refinement = inner, refinement

    def to(self, device: torch.device) -> "RefinedDeformation":
        """The same on a device; the networks themselves are moved, because the avatar trains them."""
        return RefinedDeformation(moved(self.inner, device), self.refinement.to(device))

    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """Differentiable in the refinement; the inner deformation is frozen."""
        return self.inner.canonical(pose, transforms) + self.refinement(self.refinement.window(pose))


def refined_template(template: Template, config: TemplateConfig) -> tuple[Template, MotionRefinement]:
    """The same template with vertices that will be learned with the avatar, and what learns them."""
    refinement = MotionRefinement(config, template.mesh, template.skeleton)
    return template.deformed_by(RefinedDeformation(template.deformation, refinement)), refinement
