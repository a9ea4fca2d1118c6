"""What one step of training sees: a few of a capture's images, cut out as a batch."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ash.capture.dataset import Camera
from ash.config import TrainingConfig
from ash.files import InputError
from ash.training.images import ReadAhead, TrainingImages, View

CROP_MARGIN = 12  # Pixels around the subject, so that a Gaussian that strays outside the mask is still seen.


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """A step's work on one frame: several views of it, cropped alike."""

    frame: int
    cameras: list[Camera]
    targets: Float[Tensor, "c h w 3"]  # over `background`
    foreground: Float[Tensor, "c h w"]
    background: Float[Tensor, " 3"] | Float[Tensor, "c h w 3"]  # a colour, or one for every pixel


@dataclass(frozen=True, kw_only=True, slots=True)
class BatchSpec:
    """What a step shows."""

    frame: int
    cameras: tuple[str, ...]
    colour: Float[Tensor, " 3"]  # behind the subject

    @property
    def views(self) -> tuple[View, ...]:
        """The images that it needs."""
        return tuple((camera, self.frame) for camera in self.cameras)


def sampled(images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> BatchSpec:
    """What a step shows: frames in a new random order every epoch, cameras at random."""
    epoch, position = divmod(step, len(images.frames))
    frame = images.frames[_order(seed, epoch, len(images.frames))[position]]
    rng = np.random.default_rng([seed, 2, step])
    cameras = [name for name in images.seeing(frame) if (name, frame) not in images.reserved]
    count = min(config.views_per_step, len(cameras))
    names = tuple(cameras[i] for i in rng.choice(len(cameras), count, replace=False))
    colour = np.zeros(3) if config.background == "black" else rng.random(3)
    return BatchSpec(frame=frame, cameras=names, colour=torch.from_numpy(colour).float())


@lru_cache(maxsize=2)  # Of a capture of 20,000 frames it takes longer than a GPU's step.
def _order(seed: int, epoch: int, frames: int) -> np.ndarray:
    return np.random.default_rng([seed, 1, epoch]).permutation(frames)


def draw_batch(images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> Batch:
    """The batch of a step."""
    shown = sampled(images, config, seed, step)
    batch = make_batch(images, shown.frame, list(shown.cameras), shown.colour)
    return in_studio(batch, images) if config.background == "studio" else batch


def draw_ahead(ahead: ReadAhead, images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> Batch:
    """`draw_batch`, while the images of the next steps are read."""
    views = ahead.of_step(step, lambda later: sampled(images, config, seed, later).views)
    return draw_batch(replace(images, views=views), config, seed, step)


def draw_step(ahead: ReadAhead, images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> list[Batch]:
    """What a step of `frames_per_step` frames shows: what as many steps of one frame would.

    So every frame is seen as often as the others. Where the epoch's end divides a step, the next epoch begins in it.
    """
    first = step * config.frames_per_step
    return [draw_ahead(ahead, images, config, seed, first + index) for index in range(config.frames_per_step)]


def in_studio(batch: Batch, images: TrainingImages) -> Batch:
    """The batch before what each camera saw of the empty studio, wherever its masks are not empty.

    Where a mask is too large, the studio shows in the image, and nothing needs to be drawn before it.

    Raises:
        InputError: nobody took a picture of the empty studio.
    """
    if not images.backgrounds:
        raise InputError("background='studio': expected plates/ in the capture, pictures of the empty studio")
    behind = torch.empty_like(batch.targets)
    for view, (camera, mask) in enumerate(zip(batch.cameras, batch.foreground, strict=True)):
        whole = images.cameras[camera.name]
        left, top = np.round(whole.K[:2, 2] - camera.K[:2, 2]).astype(int)
        empty = images.backgrounds[camera.name][top : top + camera.height, left : left + camera.width]
        pixels = torch.from_numpy(np.ascontiguousarray(empty)).to(images.device).float() / 255
        behind[view] = torch.where(mask[..., None] > 0, pixels, batch.background)
    share = 1 - batch.foreground[..., None]
    return replace(batch, targets=batch.targets + share * (behind - batch.background), background=behind)


def over(rgb: Float[Tensor, "c h w 3"], alpha: Float[Tensor, "c h w"], background: Tensor) -> Tensor:
    """Premultiplied colours over a background, one colour or one for every pixel."""
    return rgb + (1 - alpha)[..., None] * background


def make_batch(images: TrainingImages, frame: int, names: list[str], background: Tensor) -> Batch:
    """Crop views of one frame to boxes of one size, and move the principal points along."""
    boxes = [images.box((name, frame)) for name in names]
    full = images.cameras[names[0]]
    width = min(full.width, max(x1 - x0 for x0, _, x1, _ in boxes) + 2 * CROP_MARGIN)
    height = min(full.height, max(y1 - y0 for _, y0, _, y1 in boxes) + 2 * CROP_MARGIN)
    background = background.to(images.device)
    cameras, targets, masks = [], [], []
    for name, (x0, y0, x1, y1) in zip(names, boxes, strict=True):
        left = min(max(0, (x0 + x1 - width) // 2), full.width - width)
        top = min(max(0, (y0 + y1 - height) // 2), full.height - height)
        cameras.append(crop_camera(images.cameras[name], left, top, width, height))
        target, mask = composite(images.views[name, frame].window(left, top, width, height), background)
        targets.append(target)
        masks.append(mask)
    return Batch(
        frame=frame,
        cameras=cameras,
        targets=torch.stack(targets),
        foreground=torch.stack(masks),
        background=background,
    )


def composite(rgba: UInt8[Tensor, "h w 4"], background: Float[Tensor, " 3"]) -> tuple[Tensor, Tensor]:
    """Straight RGBA over a background, `[h, w, 3]`, and its alpha, `[h, w]`, both in 0..1."""
    image = rgba.float() / 255
    return image[..., :3] * image[..., 3:] + (1 - image[..., 3:]) * background, image[..., 3]


def crop_camera(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The camera that sees a window of another's image."""
    K = camera.K.copy()
    K[:2, 2] -= (left, top)
    return Camera(name=camera.name, width=width, height=height, K=K, viewmat=camera.viewmat)
