"""Splatting where rounding, clamps and empty sets could bite: the fast versions are their definition there too."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.numerics import TOLERANCE, Scene, cast, change, compare, draw, random_scene, relative_error, splat_warp

from ash.gaussians.splatting import Splatted, splat, splat_naive

SCENE, FEW = random_scene(count=80), random_scene(count=30)
PANCAKES = change(SCENE, scales=torch.tensor([0.2, 0.15, 0.0]).repeat(80, 1))


def centres_close_to_the_camera() -> Scene:
    """Far outside the image for their depth: the Jacobian's clamp decides."""
    scene = random_scene(count=60)
    viewmats = scene.viewmats.clone()
    viewmats[:, 2, 3] = 0.3
    return change(replace(scene, viewmats=viewmats, near=0.05), scales=0.3 * scene.gaussians.scales)


def equal_depths() -> Scene:
    means = random_scene(count=90).gaussians.means
    means[:, 2] = 3.0
    means[::3, 2] = torch.nextafter(torch.tensor(3.0), torch.tensor(4.0))
    return change(replace(random_scene(count=90), viewmats=torch.eye(4)[None]), means=means)


def tile_borders() -> Scene:
    """Centres exactly on the corners of tiles and blocks, in an image that ends one pixel after a tile."""
    grid = torch.cartesian_prod(torch.arange(0, 69, 4.0), torch.arange(0, 37, 4.0))
    depth = 4.0 + 0.001 * torch.arange(len(grid))[:, None]
    means = torch.cat([(grid - torch.tensor([32.0, 16])) / 64 * depth, depth], 1)
    K = torch.tensor([[[64.0, 0, 32], [0, 64, 16], [0, 0, 1]]])
    scene = random_scene(count=len(grid), width=65, height=33)
    return change(replace(scene, Ks=K, viewmats=torch.eye(4)[None]), means=means)


# Where more than rounding is lost: a needle's alpha changes by 1e-4 when its rotation changes by one float32 unit; the
# gradient in a quaternion of length 1e-15 is 1e15 times that of its shortest neighbour, and so on.
HARD_SPOTS = {
    "half of it before the near plane": (replace(random_scene(count=200), near=2.9), TOLERANCE),
    "centres close to the camera": (centres_close_to_the_camera(), 1e-4),
    "needles": (change(SCENE, scales=torch.tensor([0.4, 1e-4, 1e-5]).repeat(80, 1)), 2e-3),
    "pancakes": (PANCAKES, 1e-4),
    "pancakes, compensated": (replace(PANCAKES, compensate=True), 1e-3),
    "specks": (change(SCENE, scales=torch.tensor([1e-3, 1e-4, 1e-5]).repeat(80, 1)), TOLERANCE),
    "opacities zero and one": (change(SCENE, opacities=(torch.arange(80) % 3 == 0).float()), TOLERANCE),
    "equal depths": (equal_depths(), TOLERANCE),
    "black colours": (change(SCENE, sh=SCENE.gaussians.sh * 4 - 1), TOLERANCE),
    "nothing": (random_scene(count=0), 0.0),
    "all behind": (replace(FEW, near=50.0), 0.0),
    "one pixel": (
        replace(FEW, width=1, height=1, Ks=torch.tensor([[[2.0, 0, 0.3], [0, 2, 0.6], [0, 0, 1]]])),
        TOLERANCE,
    ),
    "principal point outside the image": (
        replace(random_scene(), Ks=torch.tensor([[[80.0, 0, -20], [0, 90, 75], [0, 0, 1]]])),
        TOLERANCE,
    ),
    "tile borders": (tile_borders(), TOLERANCE),
    "larger than the image": (
        change(FEW, scales=3 + FEW.gaussians.scales, opacities=0.3 * FEW.gaussians.opacities),
        TOLERANCE,
    ),
    "quaternions of all lengths": (
        change(SCENE, quats=torch.logspace(-15, 12, 80)[:, None] * SCENE.gaussians.quats),
        TOLERANCE,
    ),
}


# Of Warp in float32: a splat larger than the image sums thousands of pixels in another order than the definition does.
@pytest.mark.parametrize(("drawer", "least"), [(splat, 0.0), (splat_warp, 5 * TOLERANCE)], ids=["native", "warp"])
@pytest.mark.parametrize(("scene", "tolerance"), HARD_SPOTS.values(), ids=HARD_SPOTS)
def test_hard_spot(scene: Scene, tolerance: float, drawer: Callable[..., Splatted], least: float) -> None:
    results = compare(scene, max(tolerance, least), drawer=drawer)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in results.values())


def test_more_gaussians_on_one_tile_than_16_bits_count() -> None:
    count = 70_000
    generator = torch.Generator().manual_seed(0)
    scene = random_scene(count=count, coefficients=1, width=8, height=8)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([0.2, 0.2, 1.0]) - torch.tensor([0.1, 0.1, -3.0])
    scene = change(
        replace(scene, Ks=torch.tensor([[[120.0, 0, 4], [0, 120, 4], [0, 0, 1]]]), viewmats=torch.eye(4)[None]),
        means=means,
        scales=torch.full((count, 3), 0.012),
        opacities=torch.full((count,), 0.0103),
    )
    drawn = draw(splat, scene, threads=2)
    assert (drawn.alpha > 0.97).all()
    # A few of so many pairs lie within rounding of a threshold and fall on its other side: 0.004 of a colour each.
    with torch.no_grad():
        truth = draw(splat_naive, cast(scene, torch.float64))
    assert relative_error(drawn.rgb, truth.rgb) < 1e-4
