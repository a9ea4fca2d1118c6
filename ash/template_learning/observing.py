"""A training image as the template is fitted to it: blurred colours with their slopes, and the subject's outline."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ash.capture.dataset import Camera
from ash.training.batches import crop_camera
from ash.training.images import ImageCrop

MARGIN = 14  # Pixels around the subject, so that a template that sticks out is still seen whole.
OPAQUE = 0.98  # Colours count where the subject fills a pixel and its neighbours at least so much.
OUTLINE_BLUR = 0.7  # Pixels; of alpha, whose slope is the outline's normal.
BLUR_REACH = 4.0  # Standard deviations.


@dataclass(frozen=True, kw_only=True, slots=True)
class ObservedView:
    """The window of a training image that holds the subject, on the cutout's device."""

    width: int
    height: int
    viewmat: Float[Tensor, "4 4"]  # of the camera that sees the window alone, float64
    K: Float[Tensor, "3 3"]
    colours: Float[Tensor, "h w 10"]  # blurred sRGB, its slopes to the right and down, and 1 where it counts
    outline: Float[Tensor, "o 2"]  # points where alpha is one half, pixels, float64
    outward: Float[Tensor, "o 2"]  # unit normals there

    @property
    def position(self) -> Float[Tensor, " 3"]:
        """Optical centre in the world, metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


def observe(cutout: ImageCrop, camera: Camera, *, blur: float) -> ObservedView:
    """Prepare a view. `blur`: standard deviation, pixels."""
    device, box = cutout.pixels.device, cutout.box
    x0, y0 = max(0, box[0] - MARGIN), max(0, box[1] - MARGIN)
    x1, y1 = min(camera.width, box[2] + MARGIN), min(camera.height, box[3] + MARGIN)
    cropped = crop_camera(camera, x0, y0, x1 - x0, y1 - y0)
    window = (cutout.window(x0, y0, x1 - x0, y1 - y0).float() / 255).permute(2, 0, 1).contiguous()
    alpha = window[3]
    premultiplied = torch.cat([window[:3] * alpha, window[3:]])
    spread = blurred(premultiplied, blur)
    colours = spread[:3] / spread[3].clamp(min=1e-3)
    counts = _least_around(alpha, 1 + int(np.ceil(blur))) > OPAQUE
    outline, outward = _outline(alpha)
    return ObservedView(
        width=cropped.width,
        height=cropped.height,
        viewmat=torch.from_numpy(cropped.viewmat).to(device),
        K=torch.from_numpy(cropped.K).to(device),
        colours=torch.cat([colours, _slope(colours, 2), _slope(colours, 1), counts[None]])
        .permute(1, 2, 0)
        .contiguous(),
        outline=outline,
        outward=outward,
    )


def blurred(image: Float[Tensor, "c h w"], deviation: float) -> Float[Tensor, "c h w"]:
    """A Gaussian blur in float64, stored as float32 after each axis; beyond the border the image is mirrored.

    `deviation`: standard deviation, pixels. The taps and their order are those of SciPy's `gaussian_filter`.
    """
    reach = int(BLUR_REACH * deviation + 0.5)
    taps = np.exp(-0.5 / deviation**2 * np.arange(-reach, reach + 1) ** 2)
    taps /= taps.sum()
    for axis in (1, 2):
        size = image.shape[axis]
        place = torch.arange(-reach, size + reach, device=image.device) % (2 * size)
        padded = image.index_select(axis, torch.minimum(place, 2 * size - 1 - place)).double()
        total, pair = padded.narrow(axis, reach, size) * taps[reach], torch.empty_like(image, dtype=torch.float64)
        for k in range(reach):
            torch.add(padded.narrow(axis, k, size), padded.narrow(axis, 2 * reach - k, size), out=pair)
            total.add_(pair, alpha=taps[k])
        image = total.float()
    return image


def _least_around(image: Float[Tensor, "h w"], reach: int) -> Float[Tensor, "h w"]:
    """The least value within so many pixels, by rows and by columns."""
    for axis in (0, 1):
        least, size = image.clone(), image.shape[axis]
        for k in range(1, min(reach + 1, size)):
            for to, of in ((0, k), (k, 0)):
                part = least.narrow(axis, to, size - k)
                torch.minimum(part, image.narrow(axis, of, size - k), out=part)
        image = least
    return image


def _slope(image: Float[Tensor, "c h w"], axis: int) -> Float[Tensor, "c h w"]:
    """Central differences per pixel, one-sided at the border."""
    return torch.gradient(image, dim=axis)[0]


def _outline(alpha: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "o 2"], Float[Tensor, "o 2"]]:
    """Where alpha passes one half between two neighbouring pixels, and the way out of the subject there."""
    over = alpha.double() - 0.5
    crossings = []
    for axis in (0, 1):
        a, b = over.narrow(axis, 0, over.shape[axis] - 1), over.narrow(axis, 1, over.shape[axis] - 1)
        row, column = (a * b < 0).nonzero(as_tuple=True)
        a, b = a[row, column], b[row, column]
        share = a / (a - b)
        crossings.append(torch.stack([column + 0.5 + share * axis, row + 0.5 + share * (1 - axis)], 1))
    points = torch.cat(crossings)
    soft = blurred(alpha[None], OUTLINE_BLUR)
    inward = sample(torch.cat([_slope(soft, 2), _slope(soft, 1)]).permute(1, 2, 0).contiguous(), points).double()
    return points, -inward / inward.norm(dim=1, keepdim=True).clamp(min=1e-6)


def sample(image: Float[Tensor, "h w c"], points: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear samples at pixels (x, y), whose centres lie at +0.5; outside, those of the border."""
    height, width = image.shape[:2]
    x, y = (points[:, 0] - 0.5).clamp(0, width - 1), (points[:, 1] - 0.5).clamp(0, height - 1)
    left, top = x.long().clamp(max=width - 2), y.long().clamp(max=height - 2)
    right, down = (x - left).to(image.dtype)[:, None], (y - top).to(image.dtype)[:, None]
    flat, first = image.reshape(height * width, -1), top * width + left
    above = flat[first] * (1 - right) + flat[first + 1] * right
    below = flat[first + width] * (1 - right) + flat[first + width + 1] * right
    return above * (1 - down) + below * down
