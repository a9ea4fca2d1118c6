"""What one step of training sees: the images of a capture in memory, and a few of them cut out as a batch."""

from dataclasses import dataclass, field, replace
from math import gcd

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ash.capture.dataset import Camera, Capture
from ash.capture.manifest import Split
from ash.config import TrainingConfig
from ash.devices import CPU
from ash.files import InputError
from ash.kept import Kept
from ash.native.library import address, float32_on_cpu, load

CROP_MARGIN = 12  # Pixels around the subject, so that a Gaussian that strays outside the mask is still seen.
RESERVED_VIEWS = 24  # Training views that no step sees, where there are enough: they tell when training may end.
RESERVED_SHARE = 8  # No more than an eighth of the training views are reserved,
RESERVED_OF_FRAME = 3  # and no more than a third of a frame's, where all cameras saw it.


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingImages:
    """All training images, decoded anew from where they no longer fit, with the box that the subject fills in each."""

    views: Kept[tuple[str, int], UInt8[np.ndarray, "h w 4"]]
    boxes: dict[tuple[str, int], tuple[int, int, int, int]]  # x0, y0, x1, y1 in pixels, half open
    cameras: dict[str, Camera]
    frames: tuple[int, ...]
    reserved: tuple[tuple[str, int], ...] = ()  # views that no batch holds
    device: torch.device = CPU  # where batches are made; the images stay in the processor's memory
    plates: dict[str, UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)  # the empty studio, where it is known

    def seeing(self, frame: int) -> list[str]:
        """The cameras that saw a frame."""
        return [name for name in self.cameras if (name, frame) in self.boxes]


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """One step's work: several views of one frame, cropped alike."""

    frame: int
    cameras: list[Camera]
    targets: Float[Tensor, "c h w 3"]  # over `background`
    foreground: Float[Tensor, "c h w"]
    background: Float[Tensor, " 3"] | Float[Tensor, "c h w 3"]  # a colour, or one for every pixel


def load_training_images(capture: Capture, device: torch.device = CPU) -> TrainingImages:
    """Look at every training image once, and keep those for which there is room; batches go to the device.

    Raises:
        InputError: an image is damaged, or shows nobody.
    """
    boxes = {}
    views: Kept[tuple[str, int], np.ndarray] = Kept(lambda view: capture.image(*view))
    train = capture.splits["train"]  # An oracle's capture holds the held-out cameras too.
    for camera, frame in train.views:
        image = views[camera, frame]
        rows, columns = np.nonzero(image[..., 3].any(1))[0], np.nonzero(image[..., 3].any(0))[0]
        if len(rows) == 0:
            raise InputError(f"{capture.folder}: nobody is seen by camera {camera} in frame {frame}")
        boxes[camera, frame] = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    return TrainingImages(
        views=views,
        boxes=boxes,
        cameras={name: capture.cameras[name] for name in train.cameras},
        frames=tuple(train.frames),
        reserved=reserved_views(train),
        plates={name: plate for name in train.cameras if (plate := capture.plate(name)) is not None},
        device=device,
    )


def reserved_views(train: Split) -> tuple[tuple[str, int], ...]:
    """24 views, spread over frames and cameras; fewer of a small capture, none where a step would then lack cameras.

    At most an eighth of all views, and at most a third of the cameras in a frame; of frames that a part of the cameras
    saw, one of two.
    """
    parts = dict(zip(train.frames, train.cameras_per_frame, strict=True))
    room = {f: len(part) // RESERVED_OF_FRAME or int(bool(train.parts) and len(part) > 1) for f, part in parts.items()}
    frames = [frame for frame, some in room.items() if some]
    if not frames:
        return ()
    count = min(RESERVED_VIEWS, train.count // RESERVED_SHARE, len(frames) * min(room[frame] for frame in frames))
    cameras = len(train.cameras)
    # A stride without a common divisor comes to every camera before it comes back to one.
    stride = next(s for s in range(max(1, round(0.4 * cameras)), cameras + 1) if gcd(s, cameras) == 1)
    chosen: list[tuple[str, int]] = []
    for i in range(count):
        frame, wanted = frames[i * len(frames) // count], i * stride % cameras
        free = [name for name in parts[frame] if (name, frame) not in chosen]
        # The camera whose turn it is, or the next one that saw the frame.
        chosen.append((min(free, key=lambda name: (train.cameras.index(name) - wanted) % cameras), frame))
    return tuple(chosen)


def draw_batch(images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> Batch:
    """The batch of a step: frames in a new random order every epoch, cameras at random."""
    epoch, position = divmod(step, len(images.frames))
    order = np.random.default_rng([seed, 1, epoch]).permutation(len(images.frames))
    frame = images.frames[order[position]]
    rng = np.random.default_rng([seed, 2, step])
    cameras = [name for name in images.seeing(frame) if (name, frame) not in images.reserved]
    count = min(config.views_per_step, len(cameras))
    names = [cameras[i] for i in rng.choice(len(cameras), count, replace=False)]
    colour = np.zeros(3) if config.background == "black" else rng.random(3)
    batch = cut_batch(images, frame, names, torch.from_numpy(colour).float())
    return in_studio(batch, images) if config.background == "studio" else batch


def in_studio(batch: Batch, images: TrainingImages) -> Batch:
    """The batch before what each camera saw of the empty studio, wherever its masks are not empty.

    Where a mask is too large, the studio shows in the image, and nothing needs to be drawn before it.

    Raises:
        InputError: nobody took a picture of the empty studio.
    """
    if not images.plates:
        raise InputError("background='studio': expected plates/ in the capture, pictures of the empty studio")
    behind = torch.empty_like(batch.targets)
    for view, (camera, mask) in enumerate(zip(batch.cameras, batch.foreground, strict=True)):
        whole = images.cameras[camera.name]
        left, top = np.round(whole.K[:2, 2] - camera.K[:2, 2]).astype(int)
        plate = images.plates[camera.name][top : top + camera.height, left : left + camera.width]
        seen = torch.from_numpy(np.ascontiguousarray(plate)).to(images.device).float() / 255
        behind[view] = torch.where(mask[..., None] > 0, seen, batch.background)
    share = 1 - batch.foreground[..., None]
    return replace(batch, targets=batch.targets + share * (behind - batch.background), background=behind)


def over(rgb: Float[Tensor, "c h w 3"], alpha: Float[Tensor, "c h w"], background: Tensor) -> Tensor:
    """Premultiplied colours over a background, one colour or one for every pixel."""
    return rgb + (1 - alpha)[..., None] * background


def cut_batch(images: TrainingImages, frame: int, names: list[str], background: Tensor) -> Batch:
    """Crop views of one frame to boxes of one size, and move the principal points along."""
    boxes = [images.boxes[name, frame] for name in names]
    full = images.cameras[names[0]]
    width = min(full.width, max(x1 - x0 for x0, _, x1, _ in boxes) + 2 * CROP_MARGIN)
    height = min(full.height, max(y1 - y0 for _, y0, _, y1 in boxes) + 2 * CROP_MARGIN)
    background = background.to(images.device)
    cameras, targets, masks = [], [], []
    for name, (x0, y0, x1, y1) in zip(names, boxes, strict=True):
        left = min(max(0, (x0 + x1 - width) // 2), full.width - width)
        top = min(max(0, (y0 + y1 - height) // 2), full.height - height)
        cameras.append(crop_camera(images.cameras[name], left, top, width, height))
        window = images.views[name, frame][top : top + height, left : left + width]
        target, mask = composite(window, background)
        targets.append(target)
        masks.append(mask)
    return Batch(
        frame=frame,
        cameras=cameras,
        targets=torch.stack(targets),
        foreground=torch.stack(masks),
        background=background,
    )


def composite_naive(rgba: UInt8[np.ndarray, "h w 4"], background: Float[Tensor, " 3"]) -> tuple[Tensor, Tensor]:
    """Straight RGBA over a background, `[h, w, 3]`, and its alpha, `[h, w]`, both in 0..1: the definition.

    It is composited where the background lies; the bytes are moved there.
    """
    image = torch.from_numpy(rgba).to(background.device).float() / 255
    return image[..., :3] * image[..., 3:] + (1 - image[..., 3:]) * background, image[..., 3]


def composite(rgba: UInt8[np.ndarray, "h w 4"], background: Float[Tensor, " 3"]) -> tuple[Tensor, Tensor]:
    """`composite_naive` in one native pass over the window, whose pixels must lie side by side in their rows.

    On other devices than the CPU the definition itself runs.
    """
    if background.device.type != "cpu":
        return composite_naive(rgba, background)
    height, width = rgba.shape[:2]
    assert rgba.strides[1:] == (4, 1)
    rgb, alpha = torch.empty(height, width, 3, device="cpu"), torch.empty(height, width, device="cpu")
    outputs = address(float32_on_cpu("background", background)), address(rgb), address(alpha)
    load().ash_composite(rgba.ctypes.data, rgba.strides[0], width, height, *outputs)
    return rgb, alpha


def crop_camera(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The camera that sees a window of another's image."""
    K = camera.K.copy()
    K[:2, 2] -= (left, top)
    return Camera(name=camera.name, width=width, height=height, K=K, viewmat=camera.viewmat)
