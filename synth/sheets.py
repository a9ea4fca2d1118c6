"""Contact sheets and turntables: what a scene looks like at a glance, drawn from a finished capture."""

from pathlib import Path

import numpy as np
from PIL import Image

from ash.dataset import Capture

BACKGROUND = 0.28  # grey under the transparent parts


def flatten(rgba: np.ndarray) -> np.ndarray:
    """An RGBA image over grey, uint8 `[h, w, 3]`."""
    alpha = rgba[..., 3:] / 255
    return np.round(rgba[..., :3] * alpha + 255 * BACKGROUND * (1 - alpha)).astype(np.uint8)


def contact_sheet(capture: Capture, *, cameras: int = 4, frames: int = 8) -> np.ndarray:
    """Training views, one row per camera, spread over rig and motion; the last columns show test poses."""
    train, test = capture.splits["train"], capture.splits["novel_pose"]
    rows = []
    shown = _spread(train.cameras, cameras)
    held_out = _spread(test.cameras, cameras)
    for k, camera in enumerate(shown):
        row = [flatten(capture.image(camera, frame)) for frame in _spread(train.frames, frames - 2)]
        row += [flatten(capture.image(held_out[k % len(held_out)], frame)) for frame in _spread(test.frames, 2)]
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def write_contact_sheet(capture: Capture, path: Path, *, cameras: int = 4, frames: int = 8) -> None:
    """Write the sheet as PNG (or JPEG, by the file's name)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(contact_sheet(capture, cameras=cameras, frames=frames)).save(path)


def write_turntable(capture: Capture, path: Path, *, milliseconds: int = 90) -> None:
    """Write an animated picture (WebP or GIF, by the file's name): the motion seen from cameras in order of azimuth."""
    train = capture.splits["train"]
    azimuth = {name: np.arctan2(*capture.cameras[name].position[[0, 2]]) for name in train.cameras}
    around = sorted(train.cameras, key=lambda name: azimuth[name])
    frames = []
    for k, frame in enumerate(train.frames):
        camera = around[k * len(around) // len(train.frames)]
        frames.append(Image.fromarray(flatten(capture.image(camera, frame))))
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)


def _spread(items: tuple, count: int) -> list:
    return [items[k] for k in np.round(np.linspace(0, len(items) - 1, min(count, len(items)))).astype(int)]
