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
from ash.warp import blending, projecting, projecting_back, rasterizing, splatting

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
# Of float32: a splat larger than the image sums thousands of pixels in another order than the native kernels do.
HARD = 5 * TOLERANCE


def tube_scene() -> Scene:
    """The tube of the tests' capture, bent, before three of its cameras."""
    with torch.no_grad():
        ((_, gaussians),) = known_model().gaussians(Pose(tube_motion(6), 4))
    # Spheres have no gradient in their rotation but rounding.
    gaussians = replace(gaussians, scales=gaussians.scales * torch.tensor([1.0, 0.6, 0.3]))
    views = views_of(ring_cameras(3, 48))
    return Scene(gaussians=gaussians, **views, dilation=0.05)


@pytest.mark.parametrize("compensate", [False, True])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_warp_is_the_definition(coefficients: int, compensate: bool) -> None:
    compare(replace(random_scene(coefficients=coefficients, cameras=2), compensate=compensate), drawer=splat_warp)


@pytest.mark.parametrize(("make", "tolerance"), HARD_SPOTS, ids=lambda x: getattr(x, "__name__", ""))
def test_warp_at_a_hard_spot(make: Callable[[], Scene], tolerance: float) -> None:
    results = compare(make(), max(tolerance, HARD), drawer=splat_warp)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in results.values())


def test_warp_draws_a_tube_as_the_definition_and_as_the_native_kernels_do() -> None:
    compare(tube_scene(), 1e-4, drawer=splat_warp)
    native, warp = draw(splat, tube_scene()), draw(splat_warp, tube_scene())
    error = (native.rgb - warp.rgb).square().mean()
    assert -10 * math.log10(float(error)) > 100  # dB


@pytest.mark.parametrize("output", ["rgb", "alpha", "depth"])
def test_each_image_alone_has_its_gradient(output: str) -> None:
    gradients = []
    for drawer, dtype in ((splat_warp, torch.float32), (splat_naive, torch.float64)):
        scene = cast(random_scene(), dtype)
        image = getattr(draw(drawer, scene), output)
        (image * torch.linspace(0.1, 1, image.numel(), dtype=dtype).reshape(image.shape)).sum().backward()
        leaves = tensors_of(scene.gaussians)
        gradients.append({name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()})
    assert_same(*gradients, TOLERANCE)


def test_a_gradient_that_is_one_number_everywhere_is_taken_as_it_is() -> None:
    """A sum hands back a single number for all pixels, which is made an array before a kernel reads it."""
    gradients = []
    for drawer, dtype in ((splat_warp, torch.float32), (splat_naive, torch.float64)):
        scene = cast(random_scene(count=60), dtype)
        drawn = draw(drawer, scene)
        (drawn.rgb.sum() + 0.5 * drawn.depth.sum() - 0.3 * drawn.alpha.sum() + drawn.means2d.sum()).backward()
        gradients.append({name: tensor.grad for name, tensor in tensors_of(scene.gaussians).items()})
    assert_same(*gradients, TOLERANCE)


PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@pytest.mark.parametrize("factor", [0.0, 0.5])
@pytest.mark.parametrize("parameter", [*PARAMETERS, "means2d"])
def test_a_halved_or_zeroed_gradient_is_noticed(parameter: str, factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    of_blend = parameter == "means2d"
    node = splatting._BlendByWarp if of_blend else splatting._ProjectByWarp
    position = 2 if of_blend else 1 + PARAMETERS.index(parameter)
    honest = node.backward

    def mutant(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        results = list(honest(ctx, *grads))
        results[position] = factor * results[position]
        return tuple(results)

    monkeypatch.setattr(node, "backward", staticmethod(mutant))
    with pytest.raises(AssertionError, match=f"grad_{parameter}"):
        compare(random_scene(), drawer=splat_warp)


def test_several_cameras_are_one_camera_several_times() -> None:
    scene = random_scene(cameras=3)
    together = draw(splat_warp, scene)
    for i in range(3):
        alone = draw(splat_warp, replace(scene, viewmats=scene.viewmats[i : i + 1], Ks=scene.Ks[i : i + 1]))
        assert torch.equal(alone.rgb[0], together.rgb[i])


def test_backward_may_come_twice_and_gives_the_same_bits() -> None:
    scene = cast(random_scene(), torch.float32)
    drawn = draw(splat_warp, scene)
    drawn.rgb.sum().backward(retain_graph=True)
    once = scene.gaussians.means.grad.clone()
    drawn.rgb.sum().backward()
    assert torch.equal(scene.gaussians.means.grad, 2 * once)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", PARAMETERS)
def test_nan_and_infinity_are_named(name: str, bad: float) -> None:
    scene = random_scene(count=20, coefficients=16, cameras=2)
    tensor = getattr(scene.gaussians, name).clone()
    tensor.view(-1)[-1] = bad
    with pytest.raises(InputError, match=f"{name}: .* at Gaussian 19$"):
        draw(splat_warp, change(scene, **{name: tensor}))


def test_the_first_wrong_number_is_named() -> None:
    scene = random_scene(count=500)
    quats, opacities, scales = (getattr(scene.gaussians, name).clone() for name in ("quats", "opacities", "scales"))
    quats[[430, 123, 250]], opacities[4], scales[7, 1] = 0.0, 1.5, -0.1
    with pytest.raises(InputError, match=r"zero quaternion at Gaussian 123$"):
        draw(splat_warp, change(scene, quats=quats))
    with pytest.raises(InputError, match=r"opacities: .* at Gaussian 4$"):
        draw(splat_warp, change(scene, opacities=opacities))
    with pytest.raises(InputError, match=r"scales: .* at Gaussian 7$"):
        draw(splat_warp, change(scene, scales=scales))


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
