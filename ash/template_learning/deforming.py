"""The learned deformation of Stg.1: from the motion window to canonical vertices (ASH appendix, Eq. 10).

Trained on its own and then frozen: the Gaussians and the mesh baseline both stand on it.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Pose, Skeleton, TemplateMesh
from ash.config import TemplateConfig
from ash.devices import MovingModule
from ash.rotations import RigidTransforms
from ash.template.graph import build_graph
from ash.template.motion import normalised_motion
from ash.template.skinning import near_joints

NEIGHBOUR_JOINT = 0.5  # How far a node feels a joint's neighbours in the skeleton, against the joint itself.


class LinearDeformation(MovingModule):
    """Eq. 10 with a linear map per node: T_j from the pose of the joints near node j, A_j = 0, D_i the same always.

    A node sees the degrees of freedom of the motion window weighed by `reach`: the skinning weight of a joint at the
    node, plus half that of the joint's neighbours. Which folds a sleeve throws is decided at the elbow.
    """

    def __init__(self, config: TemplateConfig, mesh: TemplateMesh, skeleton: Skeleton) -> None:
        super().__init__()
        self.config = config
        self.rest = torch.from_numpy(mesh.vertices).float()
        self.graph = build_graph(mesh, nodes=min(config.nodes, len(mesh.vertices)))
        near = joint_reach(mesh, skeleton)[self.graph.nodes]
        per_frame = torch.cat([torch.ones(len(near), 3), near.repeat_interleave(3, 1)], 1)
        self.reach = per_frame.repeat(1, config.window)
        nodes, inputs = self.reach.shape
        self.static = nn.Parameter(torch.zeros_like(self.rest), requires_grad=False)
        self.maps = nn.Parameter(torch.zeros(nodes, inputs, 3), requires_grad=False)
        self.mean_window = nn.Parameter(torch.zeros(inputs), requires_grad=False)

    def window(self, pose: Pose) -> Float[Tensor, " f"]:
        """The motion window, in a row: it does not say where the root is."""
        window, yaw_normalise = self.config.window, self.config.yaw_normalise
        return normalised_motion(pose, window=window, yaw_normalise=yaw_normalise).flatten().to(self.rest.device)

    def shift(self, pose: Pose) -> Float[Tensor, "v 3"]:
        """Canonical vertices less those at rest, metres; differentiable in what is learned."""
        window = self.window(pose) - self.mean_window
        translations = torch.einsum("f,gfo->go", window, self.maps)
        return self.static + self.graph.spread(translations)

    @torch.no_grad()
    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """The `ash.template.template.Deformation` protocol."""
        return self.rest + self.shift(pose)


def joint_reach(mesh: TemplateMesh, skeleton: Skeleton) -> Float[Tensor, "v j"]:
    """How much every joint matters at every vertex: its skinning weight, and half its neighbours'."""
    near = near_joints(skeleton).double()
    near = torch.where(torch.eye(len(near), dtype=torch.bool), near, NEIGHBOUR_JOINT * near)
    return (torch.from_numpy(mesh.skin_weights) @ near).float()
