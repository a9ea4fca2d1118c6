"""Splatting where rounding, clamps and empty sets could bite: the fast version is its definition there too."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.hard_spots import HARD_SPOTS
from helpers.numerics import Scene, cast, change, compare, draw, random_scene, relative_error

from ash.gaussians.splatting import splat, splat_naive


@pytest.mark.parametrize(("make", "tolerance"), HARD_SPOTS, ids=lambda x: getattr(x, "__name__", ""))
def test_hard_spot(make: Callable[[], Scene], tolerance: float) -> None:
    results = compare(make(), tolerance)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in results.values())


def test_more_than_100000_gaussians_on_one_tile() -> None:
    count = 120_000
    generator = torch.Generator().manual_seed(0)
    scene = random_scene(count=count, coefficients=1, width=8, height=8)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([0.2, 0.2, 1.0]) - torch.tensor([0.1, 0.1, 0.0])
    scene = change(
        replace(scene, Ks=torch.tensor([[[120.0, 0, 4], [0, 120, 4], [0, 0, 1]]]), viewmats=torch.eye(4)[None]),
        means=means + torch.tensor([0.0, 0.0, 3.0]),
        scales=torch.full((count, 3), 0.012),
        opacities=torch.full((count,), 0.006),
    )
    drawn = draw(splat, scene, threads=2)
    assert (drawn.alpha > 0.97).all()
    # A few of so many pairs lie within rounding of a threshold and fall on its other side: 0.004 of a colour each.
    with torch.no_grad():
        truth = draw(splat_naive, cast(scene, torch.float64))
    assert relative_error(drawn.rgb, truth.rgb) < 1e-4
