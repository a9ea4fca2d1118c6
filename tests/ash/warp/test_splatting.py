"""The Warp splatter against its definition, in value and gradient, by running the same kernels on Warp's CPU device."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import warp as wp
from helpers.captures import known_model
from helpers.figures import ring_cameras, tube_motion
from helpers.hard_spots import HARD_SPOTS
from helpers.numerics import (
    TOLERANCE,
    Scene,
    assert_same,
    cast,
    change,
    compare,
    draw,
    random_scene,
    splat_warp,
    tensors_of,
    values_and_gradients,
)
from torch import Tensor

from ash.capture.dataset import Pose
from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat, splat_by_warp, splat_naive
from ash.model import views_of
from ash.native.splatting import Viewport
from ash.warp import blending, projecting, projecting_back, rasterizing

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
# Of float32: a splat larger than the image sums thousands of pixels in another order than the native kernels do.
HARD = 5 * TOLERANCE


def tube_scene() -> Scene:
    """The tube of the tests' capture, bent, before three of its cameras."""
    with torch.no_grad():
        gaussians = known_model().posed_gaussians(Pose(tube_motion(6), 4))
    # Spheres have no gradient in their rotation but rounding.
    gaussians = replace(gaussians, scales=gaussians.scales * torch.tensor([1.0, 0.6, 0.3]))
    views = views_of(ring_cameras(3, 48))
    return Scene(gaussians=gaussians, **views, dilation=0.05)


@pytest.mark.parametrize(("make", "tolerance"), HARD_SPOTS, ids=lambda x: getattr(x, "__name__", ""))
def test_warp_at_a_hard_spot(make: Callable[[], Scene], tolerance: float) -> None:
    results = compare(make(), max(tolerance, HARD), drawer=splat_warp)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in results.values())


def test_warp_draws_a_tube_as_the_definition_and_as_the_native_kernels_do() -> None:
    compare(tube_scene(), 1e-4, drawer=splat_warp)
    native, warp = draw(splat, tube_scene()), draw(splat_warp, tube_scene())
    error = (native.rgb - warp.rgb).square().mean()
    assert -10 * math.log10(float(error)) > 100  # dB


def test_what_warp_cannot_do_is_refused() -> None:
    scene, view = random_scene(count=5), Viewport(70, 50, 0, 0.3, 0.01, 1)
    with pytest.raises(InputError, match=r"means: expected float32 on cpu, got torch\.float64"):
        draw(splat_warp, cast(scene, torch.float64))
    with pytest.raises(InputError, match="viewmats: splat has no gradient"):
        splat_by_warp(scene.gaussians, scene.viewmats.clone().requires_grad_(), scene.Ks, view, None)


@pytest.mark.parametrize(
    "module", [projecting, projecting_back, blending, rasterizing], ids=lambda module: module.__name__
)
def test_the_kernels_compile_for_a_gpu(module: ModuleType, tmp_path: Path) -> None:
    """NVRTC comes with Warp and needs neither a driver nor a GPU; PTX for 7.5 runs on every later one."""
    (made,) = wp.compile_aot_module(module, arch=75, use_ptx=True, module_dir=tmp_path)
    assert ".target sm_75" in made.read_text()


# --- where a GPU is at hand -------------------------------------------------------------------------------------------


def on_gpu(**arguments: Any) -> Splatted:
    """`splat` of a scene that was moved to the GPU; what it draws is moved back."""
    moved = {name: t.cuda() for name, t in tensors_of(arguments["gaussians"]).items()}
    viewmats = arguments["viewmats"].detach()
    drawn = splat(**(arguments | {"gaussians": Gaussians(**moved), "viewmats": viewmats}))
    return Splatted(rgb=drawn.rgb.cpu(), alpha=drawn.alpha.cpu(), depth=drawn.depth.cpu(), means2d=drawn.means2d.cpu())


def without_means2d(results: dict[str, Tensor]) -> dict[str, Tensor]:
    """The copy on the CPU has no gradient."""
    return {name: value for name, value in results.items() if name not in ("grad_means2d", "grad_viewmats")}


@needs_cuda
def test_a_gpu_draws_the_definition_and_the_same_bits_every_time() -> None:
    scene = random_scene(count=3000, coefficients=9, cameras=2, width=150, height=100)
    first, again = (without_means2d(values_and_gradients(on_gpu, scene, torch.float32)) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert_same(first, without_means2d(values_and_gradients(splat_naive, scene, torch.float64)), 1e-3)


def by_gsplat(gaussians: Gaussians, **arguments: Any) -> Splatted:
    """Images of gsplat on the GPU; it caps opacities at 0.999 and splats at 3.33 standard deviations."""
    from gsplat import rasterization

    there = {name: tensor.cuda() for name, tensor in tensors_of(gaussians).items()}
    image, alpha, info = rasterization(
        means=there["means"],
        quats=there["quats"],
        scales=there["scales"],
        opacities=there["opacities"],
        colors=there["sh"],
        viewmats=arguments["viewmats"].cuda(),
        Ks=arguments["Ks"].cuda(),
        width=arguments["width"],
        height=arguments["height"],
        near_plane=arguments["near"],
        eps2d=arguments["dilation"],
        sh_degree=math.isqrt(gaussians.sh.shape[1]) - 1,
        packed=False,
        backgrounds=arguments["background"].cuda().expand(len(arguments["viewmats"]), 3),
        render_mode="RGB+D",
        rasterize_mode="antialiased" if arguments["compensate"] else "classic",
    )
    means2d = info["means2d"].cpu()
    return Splatted(rgb=image[..., :3].cpu(), alpha=alpha[..., 0].cpu(), depth=image[..., 3].cpu(), means2d=means2d)


@needs_cuda
def test_gsplat_agrees() -> None:
    pytest.importorskip("gsplat")
    scene = random_scene(count=150, coefficients=9, cameras=2)
    scene = change(scene, opacities=0.5 * scene.gaussians.opacities)  # Below the caps of both.
    theirs = without_means2d(values_and_gradients(by_gsplat, scene, torch.float32))
    assert_same(theirs, without_means2d(values_and_gradients(on_gpu, scene, torch.float32)), 1e-3, {"means2d": 1.0})
