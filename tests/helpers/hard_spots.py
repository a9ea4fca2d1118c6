"""Scenes of Gaussians where rounding, clamps and empty sets could bite, each with the error that is allowed there."""

from collections.abc import Callable
from dataclasses import replace

import torch
from helpers.numerics import TOLERANCE, Scene, change, random_scene


def behind_and_across_the_near_plane() -> Scene:
    scene = random_scene(count=200)
    return replace(scene, near=2.9)  # of 3 m to the middle: half the Gaussians lie before the plane


def centres_close_to_the_camera() -> Scene:
    """Far outside the image for their depth: the Jacobian's clamp decides."""
    scene = random_scene(count=60)
    viewmats = scene.viewmats.clone()
    viewmats[:, 2, 3] = 0.3
    return change(replace(scene, viewmats=viewmats, near=0.05), scales=0.3 * scene.gaussians.scales)


def needles() -> Scene:
    scene = random_scene(count=80)
    return change(scene, scales=torch.tensor([0.4, 1e-4, 1e-5]).repeat(80, 1))


def pancakes() -> Scene:
    scene = random_scene(count=80)
    return change(scene, scales=torch.tensor([0.2, 0.15, 0.0]).repeat(80, 1))


def pancakes_compensated() -> Scene:
    return replace(pancakes(), compensate=True)


def specks() -> Scene:
    scene = random_scene(count=300)
    return change(scene, scales=torch.tensor([1e-3, 1e-4, 1e-5]).repeat(300, 1))


def opacities_zero_and_one() -> Scene:
    scene = random_scene(count=80)
    return change(scene, opacities=(torch.arange(80) % 3 == 0).float())


def equal_depths() -> Scene:
    scene = replace(random_scene(count=90), viewmats=torch.eye(4)[None])
    means = scene.gaussians.means.clone()
    means[:, 2] = 3.0
    means[::3, 2] = torch.nextafter(torch.tensor(3.0), torch.tensor(4.0))
    return change(scene, means=means)


def black_colours() -> Scene:
    scene = random_scene(count=80)
    return change(scene, sh=scene.gaussians.sh * 4 - 1)


def nothing() -> Scene:
    return random_scene(count=0)


def all_behind() -> Scene:
    return replace(random_scene(count=30), near=50.0)


def one_pixel() -> Scene:
    return replace(
        random_scene(count=40), width=1, height=1, Ks=torch.tensor([[[2.0, 0, 0.3], [0, 2, 0.6], [0, 0, 1]]])
    )


def principal_point_outside_the_image() -> Scene:
    scene = random_scene()
    K = scene.Ks.clone()
    K[0, 0, 2], K[0, 1, 2] = -20, 75
    return replace(scene, Ks=K)


def tile_borders() -> Scene:
    """Centres exactly on the corners of tiles and blocks, in an image that ends one pixel after a tile."""
    grid = torch.stack(torch.meshgrid(torch.arange(0, 69, 4.0), torch.arange(0, 37, 4.0), indexing="ij"), -1).reshape(
        -1, 2
    )
    scene = random_scene(count=len(grid), width=65, height=33)
    K = torch.tensor([[[64.0, 0, 32], [0, 64, 16], [0, 0, 1]]])
    means = torch.cat([(grid - torch.tensor([32.0, 16])) / 64 * 4, torch.full((len(grid), 1), 4.0)], 1)
    means[:, 2] += 0.001 * torch.arange(len(grid))
    means[:, :2] *= means[:, 2:] / 4
    return change(replace(scene, Ks=K, viewmats=torch.eye(4)[None]), means=means)


def larger_than_the_image() -> Scene:
    scene = random_scene(count=30)
    return change(scene, scales=3 + scene.gaussians.scales, opacities=0.3 * scene.gaussians.opacities)


def quaternions_of_all_lengths() -> Scene:
    scene = random_scene(count=80)
    lengths = torch.logspace(-15, 12, 80)
    return change(scene, quats=lengths[:, None] * scene.gaussians.quats)


# Where more than rounding is lost: a needle's alpha changes by 1e-4 when its rotation changes by one float32 unit; the
# gradient in a quaternion of length 1e-15 is 1e15 times that of its shortest neighbour, and so on.
HARD_SPOTS: list[tuple[Callable[[], Scene], float]] = [
    (behind_and_across_the_near_plane, TOLERANCE),
    (centres_close_to_the_camera, 1e-4),
    (needles, 2e-3),
    (pancakes, 1e-4),
    (pancakes_compensated, 1e-3),
    (specks, TOLERANCE),
    (opacities_zero_and_one, TOLERANCE),
    (equal_depths, TOLERANCE),
    (black_colours, TOLERANCE),
    (nothing, 0.0),
    (all_behind, 0.0),
    (one_pixel, TOLERANCE),
    (principal_point_outside_the_image, TOLERANCE),
    (tile_borders, TOLERANCE),
    (larger_than_the_image, TOLERANCE),
    (quaternions_of_all_lengths, TOLERANCE),
]
