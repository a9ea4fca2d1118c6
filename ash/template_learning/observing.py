"""A training image as the template is fitted to it: blurred colours with their slopes, and the subject's outline."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, minimum_filter

from ash.capture.dataset import Camera
from ash.training.batches import crop_camera
from ash.training.images import Cutout

MARGIN = 14  # Pixels around the subject, so that a template that sticks out is still seen whole.
OPAQUE = 0.98  # Colours count where the subject fills a pixel and its neighbours at least so much.
OUTLINE_BLUR = 0.7  # Pixels; of alpha, whose slope is the outline's normal.


@dataclass(frozen=True, kw_only=True, slots=True)
class ObservedView:
    """The window of a training image that holds the subject."""

    camera: Camera  # that sees the window alone
    colours: Float[np.ndarray, "h w 10"]  # blurred sRGB, its slopes to the right and down, and 1 where it counts
    outline: Float[np.ndarray, "o 2"]  # points where alpha is one half, pixels
    outward: Float[np.ndarray, "o 2"]  # unit normals there


def observe(cutout: Cutout, camera: Camera, *, blur: float) -> ObservedView:
    """Prepare a view. `blur`: standard deviation, pixels."""
    box = cutout.box
    x0, y0 = max(0, box[0] - MARGIN), max(0, box[1] - MARGIN)
    x1, y1 = min(camera.width, box[2] + MARGIN), min(camera.height, box[3] + MARGIN)
    window = cutout.window(x0, y0, x1 - x0, y1 - y0).numpy().astype(np.float32) / 255
    alpha = window[..., 3]
    weight = gaussian_filter(alpha, blur)
    colours = gaussian_filter(window[..., :3] * alpha[..., None], (blur, blur, 0)) / np.maximum(weight, 1e-3)[..., None]
    down, right = np.gradient(colours, axis=(0, 1))
    counts = minimum_filter(alpha, 3 + 2 * int(np.ceil(blur))) > OPAQUE
    outline, outward = _outline(alpha)
    return ObservedView(
        camera=crop_camera(camera, x0, y0, x1 - x0, y1 - y0),
        colours=np.concatenate([colours, right, down, counts[..., None]], -1, dtype=np.float32),
        outline=outline,
        outward=outward,
    )


def _outline(alpha: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "o 2"], Float[np.ndarray, "o 2"]]:
    """Where alpha passes one half between two neighbouring pixels, and the way out of the subject there."""
    over = alpha.astype(np.float64) - 0.5
    found = []
    for axis in (0, 1):
        a, b = (np.delete(over, side, axis) for side in (-1, 0))
        row, column = np.nonzero(a * b < 0)
        share = a[row, column] / (a[row, column] - b[row, column])
        found.append(np.stack([column + 0.5 + share * axis, row + 0.5 + share * (1 - axis)], 1))
    points = np.concatenate(found)
    down, right = np.gradient(gaussian_filter(alpha, OUTLINE_BLUR))
    inward = sample(np.stack([right, down], -1), points).astype(np.float64)
    return points, -inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-6)


def sample(image: Float[np.ndarray, "h w c"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n c"]:
    """Bilinear samples at pixels (x, y), whose centres lie at +0.5; outside, those of the border."""
    height, width = image.shape[:2]
    x, y = np.clip(points[:, 0] - 0.5, 0, width - 1), np.clip(points[:, 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    right = (x - left)[:, None].astype(image.dtype)
    down = (y - top)[:, None].astype(image.dtype)
    flat, first = image.reshape(height * width, -1), top * width + left
    above = flat[first] * (1 - right) + flat[first + 1] * right
    below = flat[first + width] * (1 - right) + flat[first + width + 1] * right
    return above * (1 - down) + below * down
