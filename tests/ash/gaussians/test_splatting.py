"""`splat` against its definition in value and gradient, the definition against closed forms, and wrong input."""

import itertools
import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.numerics import (
    TOLERANCE,
    Scene,
    assert_same,
    cast,
    change,
    compare,
    draw,
    random_scene,
    relative_error,
    splat_warp,
    tensors_of,
    values_and_gradients,
)
from torch import Tensor

from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted, splat, splat_naive
from ash.native import splatting as native
from ash.native.library import instruction_set, use_team
from ash.warp import splatting as warp

Drawer = Callable[..., Splatted]
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
        gradients.append({name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()})
    assert_same(*gradients, TOLERANCE)


NODES = {
    splat: (native._Project, native._Blend, (*PARAMETERS, "viewmats")),
    splat_warp: (warp._ProjectByWarp, warp._BlendByWarp, PARAMETERS),
}


@pytest.mark.parametrize(
    ("drawer", "parameter"), [(drawer, name) for drawer, (*_, names) in NODES.items() for name in (*names, "means2d")]
)
def test_a_halved_gradient_is_noticed(drawer: Drawer, parameter: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And so is one that is zeroed, which is off by twice as much."""
    project, blend, names = NODES[drawer]
    node, position = (blend, 2) if parameter == "means2d" else (project, 1 + names.index(parameter))
    honest = node.backward

    def mutant(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        results = list(honest(ctx, *grads))
        results[position] = 0.5 * results[position]
        return tuple(results)

    monkeypatch.setattr(node, "backward", staticmethod(mutant))
    with pytest.raises(AssertionError, match=f"grad_{parameter}"):
        compare(random_scene(), drawer=drawer)


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


@FAST
def test_several_cameras_are_one_camera_several_times(drawer: Drawer) -> None:
    scene = random_scene(cameras=3)
    together = draw(drawer, scene)
    for i in range(3):
        alone = draw(drawer, replace(scene, viewmats=scene.viewmats[i : i + 1], Ks=scene.Ks[i : i + 1]))
        assert torch.equal(alone.rgb[0], together.rgb[i])


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


@pytest.mark.parametrize("drawer", [splat_naive, splat])
def test_wrong_numbers_are_named(drawer: Drawer) -> None:
    scene = random_scene(count=20)
    quats, opacities, scales = (getattr(scene.gaussians, name).clone() for name in ("quats", "opacities", "scales"))
    quats[13], opacities[4], scales[7, 1] = 0.0, 1.5, -0.1
    for tensors in ({"quats": quats}, {"opacities": opacities}, {"scales": scales}):
        with pytest.raises(InputError, match=next(iter(tensors))):
            draw(drawer, change(scene, **tensors))
    with pytest.raises(InputError, match="sh"):
        draw(drawer, change(scene, sh=torch.zeros(20, 5, 3)))
    with pytest.raises(InputError, match="viewmats"):
        draw(drawer, replace(scene, viewmats=2 * scene.viewmats))
    with pytest.raises(InputError, match="skew"):
        draw(drawer, replace(scene, Ks=scene.Ks + torch.tensor([[0.0, 1, 0], [0, 0, 0], [0, 0, 0]])))
    with pytest.raises(InputError, match="size"):
        draw(drawer, replace(scene, width=0))


@FAST
def test_the_first_wrong_number_is_named(drawer: Drawer) -> None:
    scene = random_scene(count=500)
    quats, opacities, scales = (getattr(scene.gaussians, name).clone() for name in ("quats", "opacities", "scales"))
    quats[[430, 123, 250]], opacities[4], scales[7, 1] = 0.0, 1.5, -0.1
    for tensors, message in (
        ({"quats": quats}, r"zero quaternion at Gaussian 123$"),
        ({"opacities": opacities}, r"opacities: .* at Gaussian 4$"),
        ({"scales": scales}, r"scales: .* at Gaussian 7$"),
    ):
        with pytest.raises(InputError, match=message):
            draw(drawer, change(scene, **tensors))


def test_the_first_bad_gaussian_is_named_whatever_the_threads() -> None:
    scene = random_scene(count=5000)
    quats = scene.gaussians.quats.clone()
    quats[[4999, 2500, 1234]] = 0
    for threads in (1, 2, 4):
        with pytest.raises(InputError, match=r"zero quaternion at Gaussian 1234$"):
            draw(splat, change(scene, quats=quats), threads=threads)


def test_what_splat_cannot_do_is_refused() -> None:
    scene = random_scene(count=5)
    with pytest.raises(InputError, match=r"means: expected float32"):
        draw(splat, cast(scene, torch.float64))
    with pytest.raises(InputError, match="Ks: splat has no gradient"):
        draw(splat, replace(scene, Ks=scene.Ks.clone().requires_grad_()))
    with pytest.raises(InputError, match="background: splat has no gradient"):
        draw(splat, replace(scene, background=torch.zeros(3, requires_grad=True)))
    with pytest.raises(InputError, match="threads"):
        draw(splat, scene, threads=0)
