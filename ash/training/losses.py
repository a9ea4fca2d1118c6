"""The photometric loss L1 + SSIM (ASH Eq. 8-9): `l1_ssim_loss_naive` defines it, `l1_ssim_loss` is fast.

SSIM (Wang et al. 2004) per channel: 11x11 Gaussian windows of sigma 1.5, zeros beyond the border, C1 = 0.01^2 and
C2 = 0.03^2.
"""

from collections.abc import Sequence
from ctypes import c_double
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from ash.config import TrainingConfig
from ash.files import InputError
from ash.native.library import address, check_memory, float32_on_cpu, load
from ash.training.batches import Batch

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def view_loss(
    drawn: Sequence[Float[Tensor, "_ _ _ 3"]], batches: Sequence[Batch], config: TrainingConfig
) -> Float[Tensor, ""]:
    """ASH Eq. 9, mean over the views of all batches."""
    losses = [
        l1_ssim_loss(image, exact_target(target), l1_weight=config.l1_weight, ssim_weight=config.ssim_weight)
        for images, batch in zip(drawn, batches, strict=True)
        for image, target in zip(images, batch.targets, strict=True)
    ]
    return torch.stack(losses).mean()


@dataclass(frozen=True, kw_only=True, slots=True)
class SsimTarget:
    """A target image, and which of its pixels count. Made by `ssim_target`."""

    image: Float[Tensor, "h w 3"]
    weights: Float[Tensor, "h w"] | None  # of the pixels in both means; None: all alike
    weight_sum: float  # over pixels and channels
    rows: tuple[int, int]  # those with weight: first, last + 1


def ssim_target(
    image: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | None = None
) -> SsimTarget:
    """Prepare a target image, or a crop of one, for the loss.

    Args:
        image: in 0..1, of the dtype and device of the images to come.
        mask: pixels that count, or their weights >= 0. Windows still see the whole image.

    Raises:
        InputError: the image or the mask holds NaN or infinity, or no pixel counts.
    """
    if not bool(torch.isfinite(image).all()):
        raise InputError("image: expected finite numbers, got NaN or infinity")
    height, width = image.shape[:2]
    weights, total, rows = None, float(3 * height * width), (0, height)
    if mask is not None:
        weights = mask.to(image.dtype).contiguous()
        if not bool(torch.isfinite(weights).all()) or bool((weights < 0).any()):
            raise InputError("mask: expected finite weights >= 0, got something else")
        filled = torch.nonzero(weights.sum(1))[:, 0]
        total = 3 * float(weights.double().sum())
        if len(filled) == 0:
            raise InputError("mask: expected at least one pixel that counts, got none")
        rows = (int(filled[0]), int(filled[-1]) + 1)
    return SsimTarget(image=image.detach().contiguous(), weights=weights, weight_sum=total, rows=rows)


def exact_target(image: Float[Tensor, "h w 3"]) -> SsimTarget:
    """`ssim_target` of a whole image that was composited from bytes: finite as it is, so that nobody needs to look."""
    return SsimTarget(image=image, weights=None, weight_sum=float(image.numel()), rows=(0, len(image)))


def _window_means(images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b h w 3"]:
    """Means over 11x11 Gaussian windows: the plain two-dimensional convolution."""
    steps = torch.arange(WINDOW_SIZE, dtype=torch.float64, device=images.device) - WINDOW_SIZE // 2
    line = torch.exp(-(steps**2) / (2 * WINDOW_SIGMA**2))
    window = torch.outer(line, line) / line.sum() ** 2
    kernel = window.to(images.dtype).expand(3, 1, WINDOW_SIZE, WINDOW_SIZE)
    planes = torch.nn.functional.conv2d(images.permute(0, 3, 1, 2), kernel, padding=WINDOW_SIZE // 2, groups=3)
    return planes.permute(0, 2, 3, 1).contiguous()


def l1_ssim_loss_naive(
    image: Float[Tensor, "h w 3"], target: SsimTarget, *, l1_weight: float, ssim_weight: float
) -> Float[Tensor, ""]:
    """`l1_weight` mean |I - T| + `ssim_weight` (1 - mean SSIM): the definition, in torch, any dtype and device.

    Both means are weighted with the target's mask.
    """
    truth = target.image
    moments = _window_means(torch.stack([image, truth, image * image, truth * truth, image * truth]))
    mean, target_mean, square, target_square, product = moments
    variance, target_variance = square - mean**2, target_square - target_mean**2
    covariance = product - mean * target_mean
    ssim = (2 * mean * target_mean + C1) * (2 * covariance + C2)
    ssim = ssim / ((mean**2 + target_mean**2 + C1) * (variance + target_variance + C2))
    weights = torch.ones_like(image) if target.weights is None else target.weights[..., None].expand_as(image)
    l1 = (weights * (image - target.image).abs()).sum() / target.weight_sum
    return l1_weight * l1 + ssim_weight * (1 - (weights * ssim).sum() / target.weight_sum)


def l1_ssim_loss(
    image: Float[Tensor, "h w 3"], target: SsimTarget, *, l1_weight: float, ssim_weight: float, threads: int = 1
) -> Float[Tensor, ""]:
    """`l1_ssim_loss_naive` in one fused native pass with the analytic gradient; float32 on the CPU.

    Elsewhere the definition itself runs. Differentiable in `image`; the gradient of |x| at 0 is 0. The same numbers
    come out for any number of threads.

    Raises:
        InputError: shapes differ, or the image is on the CPU and not float32. NaN in the image gives a NaN loss.
    """
    if image.shape != target.image.shape:
        raise InputError(f"image: expected the target's shape {tuple(target.image.shape)}, got {tuple(image.shape)}")
    if image.device.type != "cpu":
        return l1_ssim_loss_naive(image, target, l1_weight=l1_weight, ssim_weight=ssim_weight)
    if threads < 1:
        raise InputError(f"threads: expected at least 1, got {threads}")
    return _L1Ssim.apply(image, target, l1_weight, ssim_weight, threads)


class _L1Ssim(Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: SsimTarget, l1_weight: float, ssim_weight: float, threads: int
    ) -> Tensor:
        image = float32_on_cpu("image", image)
        float32_on_cpu("target", target.image)
        grad = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = (c_double * 2)()
        check_memory(
            load().ash_l1_ssim(
                *map(address, (image, target.image, target.weights)),
                image.shape[1],
                image.shape[0],
                *target.rows,
                l1_weight / target.weight_sum,
                -ssim_weight / target.weight_sum,
                threads,
                address(grad),
                sums,
            )
        )
        ctx.grad = grad
        l1, ssim = (total / target.weight_sum for total in sums)
        return torch.tensor(l1_weight * l1 + ssim_weight * (1 - ssim), dtype=image.dtype, device="cpu")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:
        # A loss that is the end of the graph has gradient 1, and the image need not be read again.
        return ctx.grad if grad_loss.item() == 1.0 else ctx.grad * grad_loss, None, None, None, None
