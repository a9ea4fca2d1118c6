"""The nearest point by SciPy's tree and by its definition."""

import pytest
import torch

from ash.template_learning import nearest
from ash.template_learning.nearest import NearestPoint, nearest_naive


@pytest.mark.parametrize("pairs_at_once", [1, 1000, 1 << 26])
@pytest.mark.parametrize("within", [0.2, float("inf")])
def test_the_tree_finds_what_the_definition_finds(
    within: float, pairs_at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nearest, "PAIRS_AT_ONCE", pairs_at_once)
    generator = torch.Generator().manual_seed(0)
    points, places = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (90, 70))
    distance, row = NearestPoint(points).of(places, within)
    expected, expected_row = nearest_naive(points, places, within)
    found = distance.isfinite()
    assert found.sum() > 20 and found.all() == (within == float("inf"))
    torch.testing.assert_close(distance, expected, rtol=1e-12, atol=0)
    assert torch.equal(row[found], expected_row[found])
    torch.testing.assert_close(distance[found], (places - points[row]).norm(dim=1)[found], rtol=1e-12, atol=0)
    assert int(row.max()) < len(points)  # Any row, but a row.


def test_nowhere_is_nearest_to_nothing() -> None:
    points = torch.zeros(3, 2, dtype=torch.float64)
    for distance, row in (NearestPoint(points).of(points[:0]), nearest_naive(points, points[:0])):
        assert len(distance) == len(row) == 0
