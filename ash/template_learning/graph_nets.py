"""The paper's networks of Stg.1: graph convolutions from the motion window to the embedded graph and displacements.

ASH appendix A and Habermann et al. 2021 (DDC).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Pose, Skeleton, TemplateMesh
from ash.config import TemplateConfig
from ash.devices import MovingModule, moved
from ash.rotations import RigidTransforms, quat_multiply, root_yaw, rotate, rotvec_to_unitquat
from ash.template.graph import EmbeddedGraph, NeighbourMean, build_graph, embedded_deformation
from ash.template.skinning import SkinWeights, dual_quaternion_skinning, forward_kinematics, sparse_skin_weights

GRAPH_UNIT = 0.1  # Metres and radians per unit of the graph net's output.
DISPLACEMENT_UNIT = 0.01  # Metres per unit of the displacement net's output.
WIDTH = 16  # Channels of the graph convolutions.


class GraphConvolution(nn.Module):
    """y = x W_self + (mean of the neighbours' x) W_neighbour + b, with the same weights for all nodes."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.own = nn.Linear(inputs, outputs)
        self.neighbours = nn.Linear(inputs, outputs, bias=False)

    def forward(self, x: Float[Tensor, "n i"], adjacency: NeighbourMean) -> Float[Tensor, "n o"]:
        """One hop."""
        return self.own(x) + self.neighbours(adjacency(x))


class PerNodeConvolution(nn.Module):
    """y_i = half x_i W_i and half the neighbours' mean of x_j W_j, + b_i: weights per node, as released."""

    def __init__(self, inputs: int, outputs: int, *, nodes: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.randn(nodes, inputs, outputs) * (2 / inputs) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(nodes, outputs))

    def forward(self, x: Float[Tensor, "n i"], adjacency: NeighbourMean) -> Float[Tensor, "n o"]:
        """One hop."""
        own = torch.einsum("ni,nio->no", x, self.weights)
        return 0.5 * (own + adjacency(own)) + self.bias


class GraphNet(nn.Module):
    """Residual graph convolutions with a head that starts at zero.

    `dense`: halfway, a full matrix over the nodes, shared by the channels (the release's displacement network).
    """

    def __init__(self, inputs: int, outputs: int, config: TemplateConfig, *, nodes: int, dense: bool = False) -> None:
        super().__init__()

        def hop(i: int, o: int) -> nn.Module:
            return PerNodeConvolution(i, o, nodes=nodes) if config.released else GraphConvolution(i, o)

        self.first = hop(inputs, WIDTH)
        self.blocks = nn.ModuleList(hop(WIDTH, WIDTH) for _ in range(2 * config.blocks))
        self.across = nn.Linear(nodes, nodes, bias=False) if dense else None
        if self.across is not None:
            nn.init.normal_(self.across.weight, std=1e-3 / nodes**0.5)
        self.head = nn.Linear(WIDTH, outputs)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, x: Float[Tensor, "n i"], adjacency: NeighbourMean) -> Float[Tensor, "n o"]:
        """Node features to node outputs."""
        x = self.first(x, adjacency).relu()
        pairs = list(zip(self.blocks[::2], self.blocks[1::2], strict=True))
        for index, (a, b) in enumerate(pairs):
            x = x + b(a(x, adjacency).relu(), adjacency).relu()
            if self.across is not None and index == (len(pairs) - 1) // 2:
                x = x + self.across(x.T).T
        return self.head(x)


class GraphDeformation(MovingModule):
    """Motion window -> embedded graph (angles, translations) and displacements -> canonical vertices (Eq. 10).

    Both networks also see the rest positions: shared weights must know where a node is. `static` is what all frames
    share.
    """

    def __init__(self, config: TemplateConfig, mesh: TemplateMesh, skeleton: Skeleton) -> None:
        super().__init__()
        self.config, self.skeleton = config, skeleton
        self.rest = torch.from_numpy(mesh.vertices).float()
        self.graph: EmbeddedGraph = build_graph(mesh, nodes=min(config.nodes, len(mesh.vertices)))
        self.skin: SkinWeights = sparse_skin_weights(torch.from_numpy(mesh.skin_weights).float())
        vertices, nodes = len(mesh.vertices), len(self.graph.nodes)
        self.graph_net = GraphNet(7 * config.window + 3, 6, config, nodes=nodes)
        self.displacement_net = GraphNet(3 * config.window + 3, 3, config, nodes=vertices, dense=config.released)
        self.static = nn.Parameter(torch.zeros_like(self.rest), requires_grad=False)

    def networks(self) -> list[nn.Parameter]:
        """What is trained."""
        return [*self.graph_net.parameters(), *self.displacement_net.parameters()]

    def forward(self, pose: Pose) -> Float[Tensor, "v 3"]:
        """Canonical vertices of a frame; differentiable in the networks' weights."""
        return self.deform(self.window_transforms(pose))

    def deform(self, transforms: list[RigidTransforms]) -> Float[Tensor, "v 3"]:
        """Canonical vertices from the window's skinning transforms, newest first."""
        nodes = self.graph.nodes
        inputs = [torch.cat([_upper(t.quats[nodes]), t.apply(self.rest)[nodes]], 1) for t in transforms]
        moved = GRAPH_UNIT * self.graph_net(torch.cat([*inputs, self.rest[nodes]], 1), self.graph.adjacency)
        skinned = torch.cat([*(t.apply(self.rest) for t in transforms), self.rest], 1)
        moves = DISPLACEMENT_UNIT * self.displacement_net(skinned, self.graph.vertex_adjacency)
        return embedded_deformation(self.rest, self.graph, moved[:, :3], moved[:, 3:], self.static + moves)

    @torch.no_grad()
    def window_transforms(self, pose: Pose) -> list[RigidTransforms]:
        """Per-vertex skinning of the window's frames, newest first, seen from the newest frame's root (and heading)."""
        now = torch.from_numpy(pose.dofs)
        origin = now[:3] + torch.from_numpy(self.skeleton.heads[0])
        zero = now.new_zeros(())
        yaw = root_yaw(now) if self.config.yaw_normalise else zero
        unturn = rotvec_to_unitquat(torch.stack([zero, -yaw, zero]))
        window = []
        for past in pose.window(self.config.window):
            joints = forward_kinematics(self.skeleton, torch.from_numpy(pose.motion.dofs[past]))
            turn = unturn.expand(len(joints.quats), 4)
            relative = RigidTransforms(
                quats=quat_multiply(turn, joints.quats).float(),
                translations=rotate(turn, joints.translations - origin).float(),
            )
            window.append(dual_quaternion_skinning(moved(relative, self.rest.device), self.skin))
        return window

    @torch.no_grad()
    def canonical(self, pose: Pose, transforms: RigidTransforms) -> Float[Tensor, "v 3"]:
        """The `ash.template.template.Deformation` protocol."""
        return self(pose)


def _upper(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """One of q and -q, always the same: a network should not see two names of one rotation."""
    return torch.where(quats[:, :1] < 0, -quats, quats)
