"""From tracked frames to a template that can be animated: what all frames share, and what the pose explains.

A few dozen frames of a few clips do not pin down a network: the graph networks, whose weights all nodes share, explain
no more than one shape for all frames. A ridge regression per node of the embedded graph, on the joints near it, does,
and is better than skinning on other motion, too. Cross-validation over training sequences refuses it: a sequence left
out is farther from the others than new poses are from all of them (docs/tuning.md).
"""

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ash.capture.dataset import Motion, Pose
from ash.rotations import RigidTransforms
from ash.template.graph import EmbeddedGraph
from ash.template_learning.deforming import LinearDeformation
from ash.template_learning.graph_nets import GraphDeformation
from ash.template_learning.tracking import Tracked

RIDGE = 0.3  # Against squared radians summed over frames.
FOLDS = 4  # of the frames, of which one is held out
BLEND_RIDGE = 1e-4  # Nodes without vertices of their own stay at zero.
ROUGHNESS = 0.1  # Weight of the Laplacian of the deformation, against the squared distance.
LOOK_EVERY = 20  # Steps between two looks at the frames held out.


Window = list[RigidTransforms]  # of the vertices, newest frame first


def fit_linear(deformation: LinearDeformation, motion: Motion, tracked: Tracked) -> None:
    """Fit the static displacement and the nodes' maps, in place."""
    dofs = torch.stack([deformation.window(Pose(motion, frame)) for frame in tracked.frames]).double()
    targets = _node_translations(deformation.graph, tracked.shift).double()
    mean, maps = _ridge(dofs, targets, deformation.reach.double())
    with torch.no_grad():
        deformation.static.copy_(tracked.canonical.mean(0) - deformation.rest)
        deformation.mean_window.copy_(mean)
        deformation.maps.copy_(maps)


def _node_translations(graph: EmbeddedGraph, shift: Float[Tensor, "t v 3"]) -> Float[Tensor, "t g 3"]:
    """Translations of the nodes whose blend is nearest to the shifts of the vertices, least squares: by SciPy."""
    count, links = graph.links.shape
    rows = np.repeat(np.arange(count), links)
    entries = (graph.weights.double().cpu().numpy().ravel(), (rows, graph.links.cpu().numpy().ravel()))
    blend = scipy.sparse.csr_matrix(entries, shape=(count, len(graph.nodes)))
    normal = (blend.T @ blend + BLEND_RIDGE * scipy.sparse.eye(len(graph.nodes))).tocsc()
    solve = scipy.sparse.linalg.splu(normal).solve
    solved = np.stack([solve(blend.T @ frame) for frame in shift.double().cpu().numpy()])
    return torch.from_numpy(solved).to(shift.device)


def _ridge(
    dofs: Float[Tensor, "t f"], targets: Float[Tensor, "t g 3"], reach: Float[Tensor, "g f"]
) -> tuple[Float[Tensor, " f"], Float[Tensor, "g f 3"]]:
    """Per node, the least-squares map from `reach * (dofs - mean)` to its translation; `reach` is part of the map."""
    mean = dofs.mean(0)
    centred = dofs - mean
    gram, moment = centred.T @ centred, torch.einsum("tf,tgo->gfo", centred, targets - targets.mean(0))
    maps = []
    for scale, right in zip(reach, moment, strict=True):  # One system at a time: together they would be gigabytes.
        left = scale[:, None] * gram * scale + RIDGE * torch.eye(len(scale), dtype=gram.dtype, device=gram.device)
        maps.append(scale[:, None] * torch.cholesky_solve(scale[:, None] * right, torch.linalg.cholesky(left)))
    return mean, torch.stack(maps)


def held_out_frames(sequence: np.ndarray, seed: int) -> Bool[Tensor, " t"]:
    """A quarter of the frames: every fourth sequence where there are several, else a stretch of the only one."""
    names = np.unique(sequence)
    stretches = np.arange(len(sequence)) * min(FOLDS, len(sequence)) // len(sequence)
    groups = np.searchsorted(names, sequence) if len(names) > 1 else stretches
    folds = min(FOLDS, int(groups.max()) + 1)
    return torch.from_numpy((groups % folds == seed % folds) & (folds > 1))


def _mean_square(error: Tensor) -> float:
    return float((error**2).sum(-1).mean())


def fit_graph(deformation: GraphDeformation, motion: Motion, tracked: Tracked, *, steps: int, seed: int) -> int:
    """Train the graph networks on the tracked frames, in place; returns for how many steps.

    One fold of the training frames is held out, and the step is found at which they fit it best: step 0, which deforms
    nothing, where no training helps. Then the networks learn as many steps on all frames, from the same start.
    """
    held = held_out_frames(motion.sequence[list(tracked.frames)], seed)
    windows = [deformation.window_transforms(Pose(motion, frame)) for frame in tracked.frames]
    start = {name: value.clone() for name, value in deformation.state_dict().items()}
    best, best_step = float("inf"), 0
    if held.any():
        for step in _train(deformation, windows, tracked, ~held, steps=steps, seed=seed):
            error = _held_out_error(deformation, windows, tracked, held.nonzero().squeeze(1).tolist())
            if error < best:
                best, best_step = error, step
        deformation.load_state_dict(start)
    for _ in _train(deformation, windows, tracked, torch.ones_like(held), steps=best_step, seed=seed):
        pass
    return best_step


def _train(
    deformation: GraphDeformation, windows: list[Window], tracked: Tracked, used: Tensor, *, steps: int, seed: int
) -> Iterator[int]:
    """Learn from the frames that are `used` `[t]`; stops at step 0, at every twentieth, and at the last."""
    indices = used.nonzero().squeeze(1).tolist()
    with torch.no_grad():
        deformation.static.copy_(tracked.canonical[indices].mean(0) - deformation.rest)
    optimiser = torch.optim.AdamW(deformation.networks(), lr=2e-3, weight_decay=0.1)
    for step in range(steps):
        if step % LOOK_EVERY == 0:
            yield step
        index = indices[np.random.default_rng([seed, step]).integers(len(indices))]
        canonical = deformation.deform(windows[index])
        shift = canonical - tracked.canonical[index]
        rough = shift - deformation.graph.vertex_adjacency(shift)
        loss = (shift**2).sum(1).mean() + ROUGHNESS * (rough**2).sum(1).mean()
        optimiser.zero_grad()
        (1e6 * loss).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    yield steps


@torch.no_grad()
def _held_out_error(
    deformation: GraphDeformation, windows: Sequence[Window], tracked: Tracked, held: Sequence[int]
) -> float:
    return float(np.mean([_mean_square(deformation.deform(windows[i]) - tracked.canonical[i]) for i in held]))
