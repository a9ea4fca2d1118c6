import numpy as np
import pytest
import torch
from helpers.figures import tube_mesh, tube_motion, tube_skeleton
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Pose
from ash.config import TemplateConfig
from ash.files import InputError
from ash.rotations import RigidTransforms
from ash.template.graph import LINKS, build_graph, embedded_deformation, euler_to_rotmat
from ash.template_learning.graph_nets import GraphDeformation, GraphNet


@pytest.fixture(scope="module")
def graph():
    return build_graph(tube_mesh(), nodes=30)


def rest() -> torch.Tensor:
    return torch.from_numpy(tube_mesh().vertices).float()


def test_euler_angles_are_rz_ry_rx():
    angles = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    expected = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    np.testing.assert_allclose(euler_to_rotmat(torch.from_numpy(angles)).numpy(), expected, atol=1e-12)


def test_nodes_that_move_as_one_body_move_the_template_as_one_body(graph):
    angles = torch.tensor([0.3, -0.8, 1.1]).expand(len(graph.nodes), 3)
    rotation, shift = euler_to_rotmat(angles[:1])[0], torch.tensor([0.1, 0.2, -0.3])
    nodes = rest()[graph.nodes]
    deformed = embedded_deformation(rest(), graph, angles, nodes @ rotation.T + shift - nodes, torch.zeros_like(rest()))
    torch.testing.assert_close(deformed, rest() @ rotation.T + shift, atol=1e-6, rtol=0)


def test_displacements_are_added_after_the_graph(graph):
    zeros, displacements = torch.zeros(len(graph.nodes), 3), torch.randn_like(rest())
    deformed = embedded_deformation(rest(), graph, zeros, zeros, displacements)
    torch.testing.assert_close(deformed, rest() + displacements, atol=1e-6, rtol=0)


def test_weights_are_a_partition_and_fall_with_distance(graph):
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(len(rest())))
    assert graph.links.shape == (len(rest()), LINKS)
    assert (graph.weights[:, :-1] >= graph.weights[:, 1:] - 1e-6).all()
    own = torch.arange(len(graph.nodes))
    assert (graph.links[graph.nodes, 0] == own).all()


def test_neighbour_mean_and_its_gradient_are_those_of_the_dense_matrix(graph):
    mean = graph.vertex_adjacency
    dense = mean.operator.to_dense().double()
    torch.testing.assert_close(dense.sum(1), torch.ones(len(rest()), dtype=torch.float64), atol=1e-6, rtol=0)
    x, g = torch.randn(len(rest()), 2, requires_grad=True), torch.randn(len(rest()), 2)
    y = mean(x)
    torch.testing.assert_close(y.double(), dense @ x.double(), atol=1e-6, rtol=0)
    y.backward(g)
    torch.testing.assert_close(x.grad.double(), dense.T @ g.double(), atol=1e-6, rtol=0)


def test_too_few_or_too_many_nodes_are_refused():
    for nodes in (LINKS, 1000):
        with pytest.raises(InputError, match="embedded graph: expected"):
            build_graph(tube_mesh(), nodes=nodes)


def learned(**changes) -> GraphDeformation:
    torch.manual_seed(0)
    config = TemplateConfig(network="graph", window=3, **({"nodes": 30, "blocks": 1} | changes))
    deformation = GraphDeformation(config, tube_mesh(), tube_skeleton())
    for net in (deformation.graph_net, deformation.displacement_net):
        torch.nn.init.normal_(net.head.weight, std=0.1)
    return deformation


def test_learned_deformation_does_not_see_where_the_root_is_and_if_asked_heads():
    """Moving the whole motion changes no canonical vertex; nor does turning it, where the heading is normalised."""
    motion = tube_motion()
    motion.dofs[:, 3:6] = 0
    motion.dofs[:, 4] = 0.3 * np.arange(6)
    facing, turning = learned(), learned(yaw_normalise=True)
    before = [deformation(Pose(motion, 4)) for deformation in (facing, turning)]
    motion.dofs[:, :3] += [3.0, 0, -1.0]
    torch.testing.assert_close(facing(Pose(motion, 4)), before[0], atol=1e-5, rtol=0)
    turn = Rotation.from_rotvec([0, 1.2, 0])
    head = tube_skeleton().heads[0]
    motion.dofs[:, :3] = turn.apply(motion.dofs[:, :3] + head) - head
    motion.dofs[:, 4] += 1.2
    torch.testing.assert_close(turning(Pose(motion, 4)), before[1], atol=1e-5, rtol=0)
    assert not torch.allclose(facing(Pose(motion, 4)), before[0], atol=1e-3)


def test_learned_deformation_sees_the_past():
    motion, changed = tube_motion(), tube_motion()
    changed.dofs[2, 6:] += 0.5
    deformation = learned()
    unused = RigidTransforms(quats=torch.zeros(0, 4), translations=torch.zeros(0, 3))
    for frame, sees in ((4, True), (1, False)):
        before, after = (deformation.canonical(Pose(each, frame), unused) for each in (motion, changed))
        assert torch.allclose(before, after) != sees


@pytest.mark.parametrize("released", [False, True])
def test_weights_per_node_tell_nodes_apart_that_shared_weights_cannot(released, graph):
    """Equal inputs at all nodes: shared weights give equal outputs, weights per node do not."""
    torch.manual_seed(0)
    net = GraphNet(4, 2, TemplateConfig(blocks=1, released=released), nodes=len(graph.nodes))
    torch.nn.init.normal_(net.head.weight)
    out = net(torch.ones(len(graph.nodes), 4), graph.adjacency)
    assert (out.std(0).max() > 1e-3) == released


@pytest.mark.parametrize("dense", [False, True])
def test_the_dense_layer_alone_carries_news_across_the_whole_mesh(dense, graph):
    """One block reaches three hops; what a node says farther away can only come through the full matrix."""
    torch.manual_seed(0)
    net = GraphNet(3, 3, TemplateConfig(blocks=1), nodes=len(rest()), dense=dense)
    for layer in (net.head, net.across) if dense else (net.head,):
        torch.nn.init.normal_(layer.weight)
    x = rest().clone()
    before = net(x, graph.vertex_adjacency)
    x[0] += 1.0  # The lowest ring; the highest is eight edges away.
    assert (not torch.equal(net(x, graph.vertex_adjacency)[-1], before[-1])) == dense
