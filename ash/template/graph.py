"""The embedded graph of Stg.1, and how it deforms the template (ASH appendix, Eq. 10; Sumner et al. 2007)."""

import copy
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from ash.capture.dataset import TemplateMesh
from ash.files import InputError

LINKS = 4  # Nodes that move one vertex.


@dataclass(frozen=True, kw_only=True, slots=True)
class EmbeddedGraph:
    """A coarse graph over the template whose nodes carry a rotation and a translation each."""

    nodes: Int[Tensor, " g"]  # the template vertex that each node sits on
    links: Int[Tensor, "v l"]  # nodes that move a vertex, nearest first
    weights: Float[Tensor, "v l"]  # w of Eq. 10; rows sum to 1
    adjacency: "NeighbourMean"  # of the nodes
    vertex_adjacency: "NeighbourMean"  # of the vertices

    def spread(self, values: Float[Tensor, "g c"]) -> Float[Tensor, "v c"]:
        """What the nodes have, blended at the vertices."""
        return (values[self.links] * self.weights[..., None]).sum(1)


def build_graph(mesh: TemplateMesh, *, nodes: int) -> EmbeddedGraph:
    """Place about `nodes` nodes by quadric decimation, and link every vertex to its nearest ones along the surface.

    Weights fall with geodesic distance as (1 - d / d_max)^2, where d_max is the distance to the first node that is not
    linked (Sumner et al.). A vertex on a part of the mesh without nodes of its own is linked to the nearest in space.

    Raises:
        InputError: fewer nodes asked for than links per vertex, or more than there are vertices.
    """
    count = len(mesh.vertices)
    if not LINKS < nodes <= count:
        raise InputError(f"embedded graph: expected {LINKS + 1} to {count} nodes, got {nodes}")
    chosen = _spread_over(mesh, nodes) if 2 * nodes < len(mesh.faces) else np.arange(count)
    edges = edge_lengths(mesh.vertices, mesh.faces)
    distance = dijkstra(edges, directed=False, indices=chosen)  # [g, v]
    distance = np.where(np.isinf(distance), 1e3 + _spatial(mesh.vertices, chosen), distance)
    nearest = np.argsort(distance, axis=0, kind="stable")[: LINKS + 1].T
    ordered = np.take_along_axis(distance.T, nearest, axis=1)
    weights = (1 - ordered[:, :LINKS] / np.maximum(ordered[:, LINKS:], 1e-9)) ** 2
    weights[weights.sum(1) < 1e-12, 0] = 1.0
    links = torch.from_numpy(nearest[:, :LINKS].copy())
    return EmbeddedGraph(
        nodes=torch.from_numpy(chosen),
        links=links,
        weights=torch.from_numpy(weights / weights.sum(1, keepdims=True)).float(),
        adjacency=_mean_over_neighbours(_graph_edges(nearest, len(chosen))),
        vertex_adjacency=_mean_over_neighbours(edges),
    )


def _spread_over(mesh: TemplateMesh, nodes: int) -> np.ndarray:
    """The vertices nearest to those of the mesh decimated to about so many."""
    import trimesh  # Half a second, which most processes can spare.

    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    coarse = whole.simplify_quadric_decimation(face_count=2 * nodes)
    return np.unique(cKDTree(mesh.vertices).query(coarse.vertices)[1])


def edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> scipy.sparse.csr_matrix:
    """Lengths of a mesh's edges, `[v, v]` metres; no entry where there is no edge."""
    pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0)
    lengths = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    upper = scipy.sparse.coo_matrix((np.maximum(lengths, 1e-9), pairs.T), shape=(len(vertices),) * 2)
    return (upper + upper.T).tocsr()


def _spatial(vertices: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[chosen][:, None] - vertices[None], axis=-1)


def _graph_edges(nearest: np.ndarray, nodes: int) -> scipy.sparse.csr_matrix:
    """Two nodes are neighbours when a vertex is linked to both."""
    rows = np.repeat(nearest[:, :LINKS], LINKS, axis=1).reshape(-1)
    columns = np.tile(nearest[:, :LINKS], (1, LINKS)).reshape(-1)
    apart = rows != columns
    ones = np.ones(int(apart.sum()))
    return scipy.sparse.coo_matrix((ones, (rows[apart], columns[apart])), shape=(nodes, nodes)).tocsr()


class NeighbourMean:
    """Mean over the neighbours in a graph, as a sparse operator with its transpose at hand for the gradient.

    torch transposes the operator anew in each backward pass, which costs four times as much as multiplying by it.
    """

    def __init__(self, operator: scipy.sparse.csr_matrix) -> None:
        self.operator, self.transposed = _to_torch(operator), _to_torch(operator.T.tocsr())

    def to(self, device: torch.device) -> "NeighbourMean":
        """The same on a device."""
        other = copy.copy(self)
        other.operator, other.transposed = self.operator.to(device), self.transposed.to(device)
        return other

    def __call__(self, x: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Rows of the neighbours' means."""
        return _SparseProduct.apply(x, self)


class _SparseProduct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, mean: NeighbourMean) -> Tensor:
        ctx.mean = mean
        return mean.operator @ x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return ctx.mean.transposed @ gradient, None


def _to_torch(matrix: scipy.sparse.csr_matrix) -> Tensor:
    matrix.sort_indices()
    indices = (torch.from_numpy(matrix.indptr).long(), torch.from_numpy(matrix.indices).long())
    with warnings.catch_warnings():  # torch calls its CSR support beta; this one product is all that is used of it.
        warnings.simplefilter("ignore")
        values = torch.from_numpy(matrix.data).float()
        return torch.sparse_csr_tensor(*indices, values, size=matrix.shape, check_invariants=True, device=values.device)


def vertex_neighbours(mesh: TemplateMesh) -> NeighbourMean:
    """Mean over the vertices that share an edge."""
    return _mean_over_neighbours(edge_lengths(mesh.vertices, mesh.faces))


def _mean_over_neighbours(edges: scipy.sparse.csr_matrix) -> NeighbourMean:
    ones = edges.copy()
    ones.data = np.ones_like(ones.data)
    degree = np.maximum(np.asarray(ones.sum(1)).ravel(), 1)
    return NeighbourMean((scipy.sparse.diags(1 / degree) @ ones).tocsr())


def euler_to_rotmat(angles: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """R = R_z(c) R_y(b) R_x(a) for angles (a, b, c) in radians."""
    (ca, cb, cc), (sa, sb, sc) = angles.cos().unbind(1), angles.sin().unbind(1)
    rows = [
        torch.stack([cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa], -1),
        torch.stack([sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa], -1),
        torch.stack([-sb, cb * sa, cb * ca], -1),
    ]
    return torch.stack(rows, -2)


def embedded_deformation(
    rest: Float[Tensor, "v 3"],
    graph: EmbeddedGraph,
    angles: Float[Tensor, "g 3"],
    translations: Float[Tensor, "g 3"],
    displacements: Float[Tensor, "v 3"],
) -> Float[Tensor, "v 3"]:
    """Eq. 10: V_i = D_i + sum_j w_ij (R(A_j) (V_m,i - V_G,j) + V_G,j + T_j). Metres and radians, canonical space."""
    centres = rest[graph.nodes]
    rotations = euler_to_rotmat(angles)[graph.links]
    relative = rest[:, None] - centres[graph.links]
    moved = (rotations @ relative[..., None]).squeeze(-1) + (centres + translations)[graph.links]
    return displacements + (moved * graph.weights[..., None]).sum(1)
