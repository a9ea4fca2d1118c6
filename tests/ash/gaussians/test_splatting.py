"""`splat` against its definition in value and gradient, the definition against closed forms, and wrong input."""

import itertools
import math
import os
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.numerics import (
    TOLERANCE,
    Drawer,
    Scene,
    assert_same,
    cast,
    change,
    compare,
    draw,
    gradients_of,
    random_scene,
    relative_error,
    splat_warp,
    tensors_of,
    values_and_gradients,
)
from torch import Tensor

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat, splat_by_warp, splat_naive
from ash.native.library import instruction_set, use_team
from ash.native.splatting import Viewport

FAST = pytest.mark.parametrize("drawer", [splat, splat_warp], ids=["native", "warp"])
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


def one_gaussian(**tensors: Tensor) -> Scene:
    """An isotropic Gaussian of 0.1 m, 2 m before a camera of focal length 40, in the middle of 21x21 pixels."""
    gaussian = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.1),
        "opacities": torch.tensor([0.8]),
        "sh": torch.tensor([[[1.0, 0.0, -1.0]]]),
    }
    K = torch.tensor([[[40.0, 0, 10.5], [0, 40.0, 10.5], [0, 0, 1]]])
    return Scene(gaussians=Gaussians(**(gaussian | tensors)), viewmats=torch.eye(4)[None], Ks=K, width=21, height=21)


# --- the definition ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawer", [splat_naive, splat])
def test_one_gaussian_has_its_closed_form(drawer: Drawer) -> None:
    drawn = draw(drawer, one_gaussian())
    offsets = torch.arange(21) - 10.0
    squared = offsets[:, None] ** 2 + offsets**2
    alpha = 0.8 * torch.exp(-0.5 * squared / (2.0**2 + 0.3))  # 40 / 2 * 0.1 = 2 pixels, and the dilation
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    colour = torch.tensor([0.5 + 0.28209479, 0.5, 0.5 - 0.28209479])
    assert relative_error(drawn.alpha[0], alpha) < 1e-6
    assert relative_error(drawn.rgb[0], alpha[..., None] * colour) < 1e-6
    assert relative_error(drawn.depth[0], 2 * alpha) < 1e-6
    assert relative_error(drawn.means2d, torch.tensor([[[10.5, 10.5]]])) < 1e-7


@pytest.mark.parametrize("drawer", [splat_naive, splat])
def test_nearer_gaussians_cover_farther_ones_and_the_background_shines_through(drawer: Drawer) -> None:
    two = one_gaussian(
        means=torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.tensor([0.5, 0.6]),
        sh=torch.tensor([[[1.0, 0, 0]], [[0.0, 1.0, 0]]]),
    )
    drawn = draw(drawer, replace(two, background=torch.tensor([0.0, 0.0, 2.0])))
    far, near = torch.tensor([0.78209479, 0.5, 0.5]), torch.tensor([0.5, 0.78209479, 0.5])
    expected = 0.6 * near + 0.4 * 0.5 * far + 0.2 * torch.tensor([0.0, 0.0, 2.0])
    assert relative_error(drawn.rgb[0, 10, 10], expected) < 1e-6
    assert drawn.depth[0, 10, 10].item() == pytest.approx(0.6 * 2 + 0.2 * 4, rel=1e-6)


@pytest.mark.parametrize("drawer", [splat_naive, splat])
def test_opacity_is_capped_and_a_finished_pixel_takes_no_more(drawer: Drawer) -> None:
    count = 5
    wall = one_gaussian(
        means=torch.tensor([[0.0, 0.0, 2.0 + i] for i in range(count)]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 5.0),
        opacities=torch.ones(count),
        sh=torch.zeros(count, 1, 3),
    )
    # The first leaves 0.01; the second would leave 1e-4, which rounds to either side; a faint one decides.
    faint = change(wall, opacities=torch.tensor([1.0, 0.98, 0.9, 0.5, 1.0]))
    centre = draw(drawer, faint).alpha[0, 10, 10].item()
    assert centre == pytest.approx(1 - 0.01 * 0.02, abs=1e-7)


def test_definition_does_not_depend_on_its_tiles() -> None:
    scene = cast(random_scene(), torch.float64)
    small, whole = draw(splat_naive, scene, tile=8), draw(splat_naive, scene, tile=128)
    for name in ("rgb", "alpha", "depth"):
        assert relative_error(getattr(small, name), getattr(whole, name)) < 1e-14


@pytest.mark.parametrize("compensate", [False, True])
def test_definition_has_the_gradient_of_its_value(compensate: bool) -> None:
    """Finite differences, where no opacity lies at a threshold."""
    scene = replace(random_scene(count=6, coefficients=16, width=9, height=8, seed=3), compensate=compensate)
    scene = cast(replace(scene, Ks=torch.tensor([[[14.0, 0, 4.2], [0, 13, 4.4], [0, 0, 1]]])), torch.float64)

    def images(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, viewmats: Tensor) -> Any:
        gaussians = Gaussians(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        moved = cameras + viewmats  # not checked to be a rotation: it is one to first order only
        drawn = draw(splat_naive, replace(scene, gaussians=gaussians, viewmats=moved))
        return drawn.rgb, drawn.alpha, drawn.depth

    cameras = scene.viewmats.detach()
    tensors = [*tensors_of(scene.gaussians).values(), torch.zeros_like(cameras, requires_grad=True)]
    assert torch.autograd.gradcheck(images, tensors, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)


# --- the fast paths: native kernels, and Warp's on its CPU device -----------------------------------------------------


@FAST
@pytest.mark.parametrize("compensate", [False, True])
@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_splat_is_its_definition(coefficients: int, compensate: bool, drawer: Drawer) -> None:
    compare(replace(random_scene(coefficients=coefficients, cameras=2), compensate=compensate), drawer=drawer)


def test_every_instruction_set_is_the_definition(instructions: str) -> None:
    assert instruction_set() == instructions
    compare(random_scene(coefficients=9, cameras=2, seed=1))
    compare(replace(random_scene(count=400, coefficients=4, seed=2), compensate=True, dilation=0.05, background=None))


OUTPUTS = ("rgb", "alpha", "depth", "means2d")


@FAST
@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("outputs", [*((name,) for name in OUTPUTS[:3]), OUTPUTS], ids="-".join)
def test_some_images_have_their_gradient(outputs: tuple[str, ...], constant: bool, drawer: Drawer) -> None:
    """The others' gradients are then absent altogether; a sum's is one number for all pixels."""
    gradients = []
    for each, dtype in ((drawer, torch.float32), (splat_naive, torch.float64)):
        scene = cast(random_scene(count=60), dtype)
        drawn, total = draw(each, scene), torch.zeros((), dtype=dtype)
        for name in outputs:
            image = getattr(drawn, name)
            factor = 1.0 if constant else torch.linspace(0.1, 1, image.numel(), dtype=dtype).reshape(image.shape)
            total = total + (image * factor).sum()
        total.backward()
        leaves = tensors_of(scene.gaussians) | ({"viewmats": scene.viewmats} if drawer is splat else {})
        gradients.append(gradients_of(leaves))
    assert_same(*gradients, TOLERANCE)


@pytest.mark.parametrize("factor", [0.5, 0.0, math.nan])
def test_the_comparison_notices_a_gradient_that_is_halved_zeroed_or_nan(factor: float) -> None:
    """In any tensor, however small beside the others."""
    truth = values_and_gradients(splat, random_scene(count=20), torch.float32)
    for name in truth:
        with pytest.raises(AssertionError, match=name):
            assert_same(truth | {name: factor * truth[name]}, truth, 0.1)


@pytest.mark.parametrize("of_torch", [True, False])
def test_threads_and_repetition_change_no_bit(of_torch: bool) -> None:
    scene = random_scene(count=3000, coefficients=9, cameras=2, width=150, height=100)
    first = values_and_gradients(splat, scene, torch.float32, threads=1)
    try:
        use_team(of_torch=of_torch)
        for threads in (1, 2, 5):
            again = values_and_gradients(splat, scene, torch.float32, threads=threads)
            assert all(torch.equal(first[name], again[name]) for name in first)
    finally:
        use_team(of_torch=True)


def test_threads_work_after_a_fork() -> None:
    scene = random_scene()
    expected = draw(splat, scene, threads=2).rgb
    child = os.fork()
    if child == 0:
        os._exit(0 if torch.equal(draw(splat, scene, threads=2).rgb, expected) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@FAST
def test_backward_may_come_twice_and_late(drawer: Drawer) -> None:
    scene = cast(random_scene(), torch.float32)
    drawn = draw(drawer, scene)
    for _ in range(6):  # other drawings come and go in between
        draw(drawer, random_scene(count=40, seed=9))
    drawn.rgb.sum().backward(retain_graph=True)
    once = scene.gaussians.means.grad.clone()
    drawn.rgb.sum().backward()
    assert torch.equal(scene.gaussians.means.grad, 2 * once)


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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_gpu_draws_the_definition_and_the_same_bits_every_time() -> None:
    scene = random_scene(count=3000, coefficients=9, cameras=2, width=150, height=100)
    first, again = (without_means2d(values_and_gradients(on_gpu, scene, torch.float32)) for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert_same(first, without_means2d(values_and_gradients(splat_naive, scene, torch.float64)), 1e-3)


# --- wrong input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("drawer", "name"),
    [*itertools.product((splat_naive, splat), (*PARAMETERS, "viewmats", "Ks")), *((splat_warp, n) for n in PARAMETERS)],
)
def test_nan_and_infinity_are_named(name: str, bad: float, drawer: Drawer) -> None:
    """The fast paths say at which Gaussian, too."""
    scene = random_scene(count=20, coefficients=16, cameras=2)
    owner = scene if name in ("viewmats", "Ks") else scene.gaussians
    tensor = getattr(owner, name).clone()
    tensor.view(-1)[-1 if owner is scene.gaussians else 2] = bad
    wrong = replace(scene, **{name: tensor}) if owner is scene else change(scene, **{name: tensor})
    where = ": .* at Gaussian 19$" if drawer is not splat_naive and owner is scene.gaussians else ""
    with pytest.raises(InputError, match=name + where):
        draw(drawer, wrong)


@pytest.mark.parametrize("drawer", [splat_naive, splat, splat_warp])
def test_wrong_numbers_are_named(drawer: Drawer) -> None:
    """By the fast paths with the first Gaussian that has one, whatever the threads."""
    scene = random_scene(count=5000)
    quats, opacities, scales = (getattr(scene.gaussians, name).clone() for name in ("quats", "opacities", "scales"))
    quats[[4999, 2500, 1234]], opacities[4], scales[7, 1] = 0.0, 1.5, -0.1
    for tensors, message in (
        ({"quats": quats}, "zero quaternion at Gaussian 1234$"),
        ({"opacities": opacities}, "opacities: .* at Gaussian 4$"),
        ({"scales": scales}, "scales: .* at Gaussian 7$"),
    ):
        for threads in [{"threads": n} for n in (1, 2, 4)] if drawer is splat else [{}]:
            with pytest.raises(InputError, match=next(iter(tensors)) if drawer is splat_naive else message):
                draw(drawer, change(scene, **tensors), **threads)
    if drawer is splat_warp:
        return  # `splat` checks these before it calls Warp.
    for wrong, message in (
        (change(scene, sh=torch.zeros(5000, 5, 3)), "sh"),
        (replace(scene, viewmats=2 * scene.viewmats), "viewmats"),
        (replace(scene, Ks=scene.Ks + torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])), "skew"),
        (replace(scene, width=0), "size"),
    ):
        with pytest.raises(InputError, match=message):
            draw(drawer, wrong)


def test_what_the_fast_paths_cannot_do_is_refused() -> None:
    scene, view = random_scene(count=5), Viewport(70, 50, 0, 0.3, 0.01, 1)
    for drawer in (splat, splat_warp):
        with pytest.raises(InputError, match=r"means: expected float32.* got torch\.float64"):
            draw(drawer, cast(scene, torch.float64))
    with pytest.raises(InputError, match="Ks: splat has no gradient"):
        draw(splat, replace(scene, Ks=scene.Ks.clone().requires_grad_()))
    with pytest.raises(InputError, match="background: splat has no gradient"):
        draw(splat, replace(scene, background=torch.zeros(3, requires_grad=True)))
    with pytest.raises(InputError, match="viewmats: splat has no gradient"):
        splat_by_warp(scene.gaussians, scene.viewmats.clone().requires_grad_(), scene.Ks, view, None)
    with pytest.raises(InputError, match="threads"):
        draw(splat, scene, threads=0)
