"""Of what kind a template's errors are: what of them is always there, and how long the rest stays."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra

from ash.capture.dataset import Capture, Pose, TemplateMesh
from ash.capture.formats import read_template_truth
from ash.template.graph import edge_lengths
from ash.template.template import Template

ROUNDS = 20  # Each corrects for the few frames by what the last one found.
SOURCES = 200  # Vertices that are compared with those around them for the length,
FARTHEST_M = 0.3  # no farther from them,
STEP_M = 0.01  # in classes of this width.
LENGTHS_M = np.geomspace(0.005, 0.5, 200)  # Among these, the one that fits best.
DETOUR = 1.5  # Ways along the surface that are longer than the straight one by more lead to another layer.


@dataclass(frozen=True, kw_only=True, slots=True)
class ErrorKind:
    """What `ash.config.TemplateConfig` plants, measured."""

    rms_mm: float
    static: float  # share of the mean square that is the same in all frames
    lag: float  # correlation of the rest from frame to frame
    length_m: (
        float  # at which two vertices' errors have a correlation of exp(-1/2), by a Gaussian fit; infinite: no error
    )


def error_kind(template: Template, capture: Capture, frames: tuple[int, ...]) -> ErrorKind:
    """Measure a template against the truth in some frames, in canonical space."""
    truth = torch.from_numpy(read_template_truth(capture)).float()
    posed = [template.pose(Pose(capture.motion, frame)) for frame in frames]
    errors = [p.canonical - p.transforms.apply_inverse(truth[f]) for p, f in zip(posed, frames, strict=True)]
    return measure_errors(torch.stack(errors).double().numpy(), capture.motion.sequence[list(frames)], capture.template)


def measure_errors(
    errors: Float[np.ndarray, "t v 3"], sequence: Int[np.ndarray, " t"], mesh: TemplateMesh
) -> ErrorKind:
    """Of errors in metres, frame by frame. Frames of one number in `sequence` follow each other.

    The mean over few frames holds some of what changes, and what is left once it is taken away is less alike than it
    was: both are corrected for, as of a process whose correlation falls by `lag` with each frame.
    """
    square = float((errors**2).sum(-1).mean())
    if square == 0 or len(errors) < 2:
        return ErrorKind(rms_mm=1e3 * square**0.5, static=1.0, lag=0.0, length_m=np.inf)
    rest_of = errors - errors.mean(0)
    mean_share = float((errors.mean(0) ** 2).sum(-1).mean()) / square
    following = np.flatnonzero(sequence[1:] == sequence[:-1])
    alike = float((rest_of[following] * rest_of[following + 1]).sum(-1).mean()) if len(following) else 0.0
    raw = alike / max(float((rest_of**2).sum(-1).mean()), 1e-30)
    lag = raw
    for _ in range(ROUNDS):
        held = _share_in_mean(sequence, lag)
        lag = float(np.clip(raw * (1 - held) + held, -0.99, 0.99))
    held = _share_in_mean(sequence, lag)
    static = float(np.clip((mean_share - held) / (1 - held), 0, 1))
    return ErrorKind(rms_mm=1e3 * square**0.5, static=static, lag=lag, length_m=_length(errors, mesh))


def _share_in_mean(sequence: Int[np.ndarray, " t"], lag: float) -> float:
    """What share of the square of what changes is left in its mean over the frames."""
    same = sequence[:, None] == sequence[None]
    apart = np.abs(np.subtract.outer(np.arange(len(sequence)), np.arange(len(sequence))))
    return float((same * np.sign(lag) ** apart * np.abs(lag) ** apart).mean())


def _length(errors: Float[np.ndarray, "t v 3"], mesh: TemplateMesh) -> float:
    """L of the correlation exp(-d^2 / 2 L^2) at distance d that fits the errors best, least squares.

    Only vertices of one layer are compared: the way along the surface is hardly longer than the straight one.
    """
    rest, edges = mesh.vertices, edge_lengths(mesh.vertices, mesh.faces)
    chosen = np.random.default_rng(0).permutation(len(rest))[:SOURCES]
    along = dijkstra(edges, directed=False, indices=chosen, limit=DETOUR * FARTHEST_M)
    straight = np.linalg.norm(rest[chosen][:, None] - rest[None], axis=-1)
    source, other = np.nonzero((along <= DETOUR * straight) & (straight > 0) & (straight < FARTHEST_M))
    pairs, distance = np.stack([chosen[source], other], 1), straight[source, other]
    product = np.mean([(e[pairs[:, 0]] * e[pairs[:, 1]]).sum(-1) for e in errors], 0)
    square = (errors**2).sum(-1).mean(0)
    size = 0.5 * (square[pairs[:, 0]] + square[pairs[:, 1]])
    classes = (distance / STEP_M).astype(np.int64)
    found = np.bincount(classes, product) / np.maximum(np.bincount(classes, size), 1e-30)
    weight, middle = np.bincount(classes, size), (np.arange(len(found)) + 0.5) * STEP_M
    fits = np.exp(-0.5 * (middle / LENGTHS_M[:, None]) ** 2)
    return float(LENGTHS_M[(weight * (found - fits) ** 2).sum(1).argmin()])
