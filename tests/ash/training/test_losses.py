"""`l1_ssim_loss` against its definition, and the definition against closed forms and scikit-image."""

from typing import Any

import pytest
import torch
from helpers.numerics import relative_error
from skimage.metrics import structural_similarity
from torch import Tensor

from ash.files import InputError
from ash.native.library import instruction_set
from ash.training.losses import l1_ssim_loss, l1_ssim_loss_naive, ssim_target

TOLERANCE = 2e-6
WEIGHTS = {"l1_weight": 0.9, "ssim_weight": 0.6}


def make_images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), target


def make_mask(kind: str, height: int, width: int) -> Tensor | None:
    mask = torch.zeros(height, width, dtype=torch.bool)
    if kind == "weights":
        return torch.rand(height, width, generator=torch.Generator().manual_seed(1))
    if kind == "last_row":
        mask[-1] = True
    else:
        mask[height // 3 : height // 3 + max(1, height // 4), width // 2 : width // 2 + max(1, width // 4)] = True
    return None if kind == "none" else mask


def compare(
    image: Tensor, target: Tensor, mask: Tensor | None = None, *, upstream: float = 1.0, weights: Any = WEIGHTS
) -> None:
    exact, image = image.double().requires_grad_(), image.clone().requires_grad_()
    truth = l1_ssim_loss_naive(exact, ssim_target(target.double(), mask), **weights)
    loss = l1_ssim_loss(image, ssim_target(target, mask), **weights)
    ((upstream * truth) + (upstream * loss)).backward()
    assert loss.item() == pytest.approx(truth.item(), rel=2e-6, abs=1e-6)
    assert relative_error(image.grad, exact.grad) < TOLERANCE


@pytest.mark.parametrize("kind", ["none", "box", "weights", "last_row"])
@pytest.mark.parametrize("size", [(1, 1), (3, 40), (40, 3), (7, 9), (33, 47), (64, 70)], ids=str)
def test_loss_is_its_definition(size: tuple[int, int], kind: str) -> None:
    compare(*make_images(*size), make_mask(kind, *size), upstream=-2.5)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0)], ids=["l1", "ssim"])
def test_each_term_alone_is_its_definition(weights: tuple[float, float]) -> None:
    """So that one cannot hide behind the other."""
    compare(*make_images(30, 30), weights=dict(zip(WEIGHTS, weights, strict=True)))


@pytest.mark.parametrize("width", [51, 255, 257, 530])
def test_every_instruction_set_does_wide_images_in_strips_without_seams(width: int, instructions: str) -> None:
    assert instruction_set() == instructions
    compare(*make_images(14, width), make_mask("box", 14, width))
    compare(*make_images(14, width))


def test_crops_and_images_that_are_not_contiguous() -> None:
    image, target = make_images(60, 80)
    compare(image[10:50, 20:63], target[10:50, 20:63])
    compare(image.transpose(0, 1), target.transpose(0, 1), make_mask("box", 80, 60))


def test_equal_images_have_no_loss_and_no_gradient() -> None:
    """Where I = T the L1 term has the gradient 0, not 1 or -1."""
    image = make_images(20, 30)[0].requires_grad_()
    loss = l1_ssim_loss(image, ssim_target(image.detach()), l1_weight=1.0, ssim_weight=1.0)
    loss.backward()
    assert abs(loss.item()) < 1e-6 and image.grad is not None and image.grad.abs().max() < 1e-6


def test_ssim_is_that_of_scikit_image_inside_the_border() -> None:
    image, target = make_images(48, 40)
    mask = torch.zeros(48, 40, dtype=torch.bool)
    mask[5:-5, 5:-5] = True
    ours = 1 - l1_ssim_loss(image, ssim_target(target, mask), l1_weight=0.0, ssim_weight=1.0).item()
    options = {"channel_axis": 2, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    theirs = structural_similarity(
        image.double().numpy(), target.double().numpy(), use_sample_covariance=False, **options
    )
    assert ours == pytest.approx(theirs, abs=1e-6)


def test_threads_repetition_and_the_want_of_a_gradient_change_no_bit() -> None:
    image, target = make_images(150, 90)
    cached = ssim_target(target, make_mask("box", 150, 90))
    results = []
    for threads in (1, 1, 2, 3, 9):
        leaf = image.clone().requires_grad_()
        loss = l1_ssim_loss(leaf, cached, **WEIGHTS, threads=threads)
        loss.backward()
        results.append((loss.item(), leaf.grad))
    assert all(value == results[0][0] and torch.equal(grad, results[0][1]) for value, grad in results)
    assert l1_ssim_loss(image, cached, **WEIGHTS).item() == results[0][0]


def test_definition_has_the_gradient_of_its_value() -> None:
    image, target = make_images(6, 7)
    cached = ssim_target(target.double(), make_mask("weights", 6, 7))
    leaf = image.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: l1_ssim_loss_naive(x, cached, l1_weight=0.5, ssim_weight=0.5), leaf)


def test_nan_in_the_image_is_not_hidden() -> None:
    image, target = make_images(30, 30)
    image[4, 5, 1] = torch.nan
    assert l1_ssim_loss(image, ssim_target(target), **WEIGHTS).isnan()


def test_wrong_input_is_named() -> None:
    image, target = make_images(20, 20)
    cached, double = ssim_target(target), ssim_target(target.double())
    for message, picture, aim, threads in (
        (r"image: expected the target's shape \(20, 20, 3\)", image[:-1], cached, 1),
        ("image: expected float32", image.double(), double, 1),
        ("target: expected float32", image, double, 1),
        ("threads", image, cached, 0),
    ):
        with pytest.raises(InputError, match=message):
            l1_ssim_loss(picture, aim, **WEIGHTS, threads=threads)
    for message, picture, mask in (
        ("mask: expected at least one pixel", target, torch.zeros(20, 20, dtype=torch.bool)),
        ("mask: expected finite weights", target, torch.full((20, 20), -1.0)),
        ("image: expected finite", target / 0, None),
    ):
        with pytest.raises(InputError, match=message):
            ssim_target(picture, mask)
