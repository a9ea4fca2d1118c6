"""An image of one camera as a camera with another lens in the same place takes it, resampled bilinearly."""

import numpy as np

from ash.capture.dataset import Camera


def resample(image: np.ndarray, camera: Camera, target: Camera) -> tuple[np.ndarray, np.ndarray]:
    """An image `[h, w, k]` of `camera` as `target`, in its place and of its size, takes it; zero outside of the image.

    Also returns the sum of squared weights per pixel `[h, w]`: what remains of independent noise's variance.
    """
    x, y = np.meshgrid(np.arange(target.width) + 0.5, np.arange(target.height) + 0.5)
    rays = target.directions(np.stack([x, y], axis=-1))
    place = camera.project(camera.position + rays)[0] - 0.5
    low = np.floor(place).astype(np.int64)
    share = place - low
    result, squares = np.zeros(image.shape), np.zeros(image.shape[:2])
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = low[..., 0] + dx, low[..., 1] + dy
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            weight = np.abs(1 - dx - share[..., 0]) * np.abs(1 - dy - share[..., 1]) * inside
            value = image[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
            result += weight[..., None] * value
            squares += weight**2
    return result, squares


def resample_rgba(image: np.ndarray, camera: Camera, target: Camera) -> np.ndarray:
    """`resample` of uint8 RGBA `[h, w, 4]` with straight alpha; colours are interpolated premultiplied."""
    rgba = image / 255.0
    premultiplied, _ = resample(np.concatenate([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], axis=-1), camera, target)
    alpha = premultiplied[..., 3:]
    colour = np.where(alpha > 0.5 / 255, premultiplied[..., :3] / np.maximum(alpha, 1e-6), 0)
    return np.round(255 * np.clip(np.concatenate([colour, alpha], axis=-1), 0, 1)).astype(np.uint8)
