"""Scores of avatars, in a few lines of their own: what is tested must not be what tests."""

import math

import numpy as np

from ash.capture.dataset import Capture, Pose
from ash.protocol import Avatar, StageClock


def draw(avatar: Avatar, capture: Capture, camera: str, frame: int) -> np.ndarray:
    """A view, premultiplied RGBA, float32 `[h, w, 4]`."""
    return avatar.render(Pose(capture.motion, frame), capture.cameras[camera], clock=StageClock())


def psnr(image: np.ndarray, reference: np.ndarray, alpha: np.ndarray) -> float:
    """PSNR in dB of float colours `[h, w, 3]`, where `alpha` `[h, w]` is above one half; infinite if they are equal."""
    mse = float(np.mean((image - reference)[alpha > 0.5] ** 2))
    return -10 * math.log10(mse) if mse > 0 else math.inf


def foreground_psnr(avatar: Avatar, capture: Capture, views: list[tuple[str, int]]) -> float:
    """PSNR in dB over the true foreground of views."""
    errors = []
    for camera, frame in views:
        truth = capture.image(camera, frame).astype(np.float64) / 255
        error = draw(avatar, capture, camera, frame)[..., :3] - truth[..., :3] * truth[..., 3:]
        errors.append((error[truth[..., 3] > 0.5] ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))
