"""`l1_ssim_loss` against its definition, and the definition against closed forms and scikit-image."""

import pytest
import torch
from helpers.numerics import relative_error
from skimage.metrics import structural_similarity
from torch import Tensor

from ash.files import InputError
from ash.native.library import instruction_set
from ash.training.losses import _L1Ssim, l1_ssim_loss, l1_ssim_loss_naive, ssim_target

SIZES = [(1, 1), (3, 40), (40, 3), (7, 9), (33, 47), (64, 70)]
MASKS = ("none", "box", "weights", "last_row")
TOLERANCE = 2e-6


def make_images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), target


def make_mask(kind: str, height: int, width: int) -> Tensor | None:
    mask = torch.zeros(height, width, dtype=torch.bool)
    if kind == "none":
        return None
    if kind == "weights":
        return torch.rand(height, width, generator=torch.Generator().manual_seed(1))
    if kind == "last_row":
        mask[-1] = True
    else:
        mask[height // 3 : height // 3 + max(1, height // 4), width // 2 : width // 2 + max(1, width // 4)] = True
    return mask


def compare(image: Tensor, target: Tensor, mask: Tensor | None, threads: int = 1, upstream: float = 1.0) -> None:
    exact = image.double().requires_grad_()
    truth = l1_ssim_loss_naive(exact, ssim_target(target.double(), mask), l1_weight=0.9, ssim_weight=0.6)
    (upstream * truth).backward()
    image = image.clone().requires_grad_()
    loss = l1_ssim_loss(image, ssim_target(target, mask), l1_weight=0.9, ssim_weight=0.6, threads=threads)
    (upstream * loss).backward()
    assert loss.item() == pytest.approx(truth.item(), rel=2e-6, abs=1e-6)
    assert image.grad is not None and exact.grad is not None
    assert relative_error(image.grad, exact.grad) < TOLERANCE


@pytest.mark.parametrize("kind", MASKS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_loss_is_its_definition(size: tuple[int, int], kind: str) -> None:
    compare(*make_images(*size), make_mask(kind, *size), upstream=-2.5)


def test_every_instruction_set_is_the_definition(instructions: str) -> None:
    assert instruction_set() == instructions
    compare(*make_images(45, 51), make_mask("box", 45, 51))


@pytest.mark.parametrize("width", [255, 257, 266, 530])
def test_wide_images_are_done_in_strips_without_seams(width: int, instructions: str) -> None:
    compare(*make_images(24, width), make_mask("box", 24, width))
    compare(*make_images(24, width), None)


def test_crops_and_images_that_are_not_contiguous() -> None:
    image, target = make_images(60, 80)
    compare(image[10:50, 20:63], target[10:50, 20:63], None)
    compare(image.transpose(0, 1), target.transpose(0, 1), make_mask("box", 80, 60))


def test_equal_images_have_no_loss_and_no_gradient() -> None:
    """Where I = T the L1 term has the gradient 0, not 1 or -1."""
    image = make_images(20, 30)[0].requires_grad_()
    loss = l1_ssim_loss(image, ssim_target(image.detach()), l1_weight=1.0, ssim_weight=1.0)
    loss.backward()
    assert abs(loss.item()) < 1e-6 and image.grad is not None and image.grad.abs().max() < 1e-6


def test_constant_images_have_their_closed_form() -> None:
    """Away from the border: l1 = |a - b| and SSIM = (2ab + C1) / (a^2 + b^2 + C1)."""
    a, b, c1 = 0.25, 0.75, 1e-4
    mask = torch.zeros(31, 31, dtype=torch.bool)
    mask[10:20, 10:20] = True
    target = ssim_target(torch.full((31, 31, 3), b), mask)
    loss = l1_ssim_loss(torch.full((31, 31, 3), a), target, l1_weight=0.3, ssim_weight=0.7)
    expected = 0.3 * 0.5 + 0.7 * (1 - (2 * a * b + c1) / (a * a + b * b + c1))
    # The variance of a constant is what float32 leaves of it: 1e-7 beside C2 = 9e-4.
    assert loss.item() == pytest.approx(expected, rel=1e-3)


def test_ssim_is_that_of_scikit_image_inside_the_border() -> None:
    image, target = make_images(48, 40)
    mask = torch.zeros(48, 40, dtype=torch.bool)
    mask[5:-5, 5:-5] = True
    ours = 1 - l1_ssim_loss(image, ssim_target(target, mask), l1_weight=0.0, ssim_weight=1.0).item()
    theirs = structural_similarity(
        image.double().numpy(),
        target.double().numpy(),
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert ours == pytest.approx(theirs, abs=1e-6)


def test_threads_and_repetition_change_no_bit() -> None:
    image, target = make_images(150, 90)
    cached = ssim_target(target, make_mask("box", 150, 90))
    results = []
    for threads in (1, 1, 2, 3, 9):
        leaf = image.clone().requires_grad_()
        loss = l1_ssim_loss(leaf, cached, l1_weight=0.9, ssim_weight=0.1, threads=threads)
        loss.backward()
        results.append((loss.item(), leaf.grad))
    assert all(value == results[0][0] and torch.equal(grad, results[0][1]) for value, grad in results)


def test_a_halved_gradient_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = _L1Ssim.backward
    monkeypatch.setattr(_L1Ssim, "backward", staticmethod(lambda ctx, g: (0.5 * honest(ctx, g)[0], *[None] * 4)))
    with pytest.raises(AssertionError):
        compare(*make_images(20, 20), None)


def test_only_the_ssim_terms_gradient_is_noticed_too() -> None:
    """Each term alone, so that one cannot hide behind the other."""
    image, target = make_images(30, 30)
    for l1_weight, ssim_weight in ((1.0, 0.0), (0.0, 1.0)):
        leaf, exact = image.clone().requires_grad_(), image.double().requires_grad_()
        l1_ssim_loss(leaf, ssim_target(target), l1_weight=l1_weight, ssim_weight=ssim_weight).backward()
        cached = ssim_target(target.double())
        l1_ssim_loss_naive(exact, cached, l1_weight=l1_weight, ssim_weight=ssim_weight).backward()
        assert leaf.grad is not None and exact.grad is not None
        assert relative_error(leaf.grad, exact.grad) < TOLERANCE


def test_definition_has_the_gradient_of_its_value() -> None:
    image, target = make_images(6, 7)
    cached = ssim_target(target.double(), make_mask("weights", 6, 7))
    leaf = image.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: l1_ssim_loss_naive(x, cached, l1_weight=0.5, ssim_weight=0.5), leaf)


def test_without_a_gradient_the_value_is_the_same() -> None:
    image, target = make_images(40, 30)
    cached = ssim_target(target)
    with_gradient = l1_ssim_loss(image.clone().requires_grad_(), cached, l1_weight=0.9, ssim_weight=0.1)
    assert l1_ssim_loss(image, cached, l1_weight=0.9, ssim_weight=0.1).item() == with_gradient.item()


def test_nan_in_the_image_is_not_hidden() -> None:
    image, target = make_images(30, 30)
    image[4, 5, 1] = torch.nan
    assert l1_ssim_loss(image, ssim_target(target), l1_weight=0.9, ssim_weight=0.1).isnan()


def test_wrong_input_is_named() -> None:
    image, target = make_images(20, 20)
    cached = ssim_target(target)
    with pytest.raises(InputError, match=r"image: expected the target's shape \(20, 20, 3\)"):
        l1_ssim_loss(image[:-1], cached, l1_weight=1.0, ssim_weight=1.0)
    with pytest.raises(InputError, match="image: expected float32"):
        l1_ssim_loss(image.double(), ssim_target(target.double()), l1_weight=1.0, ssim_weight=1.0)
    with pytest.raises(InputError, match="target: expected float32"):
        l1_ssim_loss(image, ssim_target(target.double()), l1_weight=1.0, ssim_weight=1.0)
    with pytest.raises(InputError, match="threads"):
        l1_ssim_loss(image, cached, l1_weight=1.0, ssim_weight=1.0, threads=0)
    with pytest.raises(InputError, match="mask: expected at least one pixel"):
        ssim_target(target, torch.zeros(20, 20, dtype=torch.bool))
    with pytest.raises(InputError, match="mask: expected finite weights"):
        ssim_target(target, torch.full((20, 20), -1.0))
    with pytest.raises(InputError, match="image: expected finite"):
        ssim_target(target / 0)
