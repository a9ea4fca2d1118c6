"""Of some points, which one is nearest: by SciPy's tree on the CPU, by all distances on any other device."""

from typing import cast

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

PAIRS_AT_ONCE = 1 << 26  # Distances that are held at a time: half a gigabyte in float64.


class NearestPoint:
    """Looks up the nearest of some points; distances are those of the points' precision."""

    def __init__(self, points: Float[Tensor, "n d"]) -> None:
        """At least one point, on the device on which they are looked up."""
        assert len(points)
        self.points = points
        self.tree = cKDTree(points.numpy()) if points.device.type == "cpu" else None

    def of(
        self, places: Float[Tensor, "m d"], within: float = float("inf")
    ) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
        """Distance and row of the point nearest to each place; infinite, and any row, where none lies `within`."""
        if self.tree is None:
            return nearest_naive(self.points, places, within)
        neighbours = self.tree.query(places.numpy(), distance_upper_bound=within)
        distance, row = cast("tuple[np.ndarray, np.ndarray]", neighbours)
        # Without a point in range the tree tells a number beyond the last.
        return torch.from_numpy(distance), torch.from_numpy(np.minimum(row, len(self.points) - 1))


def nearest_naive(
    points: Float[Tensor, "n d"], places: Float[Tensor, "m d"], within: float = float("inf")
) -> tuple[Float[Tensor, " m"], Int[Tensor, " m"]]:
    """`NearestPoint.of` by its definition: every place against every point, some places at a time."""
    parts = []
    for some in places.split(max(1, PAIRS_AT_ONCE // len(points))):
        distance, row = torch.cdist(some, points, compute_mode="donot_use_mm_for_euclid_dist").min(1)
        parts.append((distance.masked_fill(distance >= within, float("inf")), row))
    distances, rows = zip(*parts, strict=True)
    return torch.cat(distances), torch.cat(rows)
