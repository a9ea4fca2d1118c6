"""Training images of a capture of any size: of each the part that shows the subject, as many as there is room for.

What there is no room for is read anew each time it is asked for; `ReadAhead` does that while a step is made.
"""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from math import gcd
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from ash.bounded_cache import MAX_BYTES, BoundedCache
from ash.capture.dataset import Camera, Capture, fewer_views
from ash.capture.manifest import Split
from ash.config import TrainingConfig
from ash.devices import CPU
from ash.files import InputError

RESERVED_VIEWS = 24  # Training views that no step sees, where there are enough: they tell when training may end.
RESERVED_SHARE = 8  # No more than an eighth of the training views are reserved,
RESERVED_OF_FRAME = 3  # and no more than a third of a frame's, where all cameras saw it.
GPU_SHARE = 4  # Of a GPU's free memory, a quarter may hold images.
READERS = min(16, max(4, os.cpu_count() or 4))  # threads; each decodes about 40 images of 1285x940 a second
STEPS_AHEAD = READERS  # at one view a step, none of them waits for another

View = tuple[str, int]  # camera, frame
Box = tuple[int, int, int, int]  # x0, y0, x1, y1 in pixels, half open


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageCrop:
    """The part of a training image that shows the subject; beside it the image is empty."""

    pixels: UInt8[Tensor, "h w 4"]  # sRGB, straight alpha
    left: int
    top: int

    @property
    def box(self) -> Box:
        """What it fills of the image."""
        height, width = self.pixels.shape[:2]
        return self.left, self.top, self.left + width, self.top + height

    def window(self, left: int, top: int, width: int, height: int) -> UInt8[Tensor, "h w 4"]:
        """Any window of the image, empty where nobody is."""
        whole = self.pixels.new_zeros(height, width, 4)
        x0, y0, x1, y1 = self.box
        x0, y0, x1, y1 = max(left, x0), max(top, y0), min(left + width, x1), min(top + height, y1)
        if x0 < x1 and y0 < y1:
            visible = self.pixels[y0 - self.top : y1 - self.top, x0 - self.left : x1 - self.left]
            whole[y0 - top : y1 - top, x0 - left : x1 - left] = visible
        return whole


@runtime_checkable
class Views(Protocol):
    """Crops by view: all of a capture, or those of a step."""

    def __getitem__(self, view: View) -> ImageCrop:
        """Of a view."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingImages:
    """The training images of a capture, and what is known of them."""

    views: Views
    cameras: dict[str, Camera]
    split: Split  # which camera saw which frame
    reserved: tuple[View, ...] = ()  # views that no batch holds
    whole: bool = False  # batches show whole images, not the subject alone
    device: torch.device = CPU  # where cutouts lie and batches are made
    backgrounds: dict[str, UInt8[np.ndarray, "h w 3"]] = field(
        default_factory=dict
    )  # the empty studio, where it is known

    @property
    def frames(self) -> tuple[int, ...]:
        """Those that some camera saw."""
        return self.split.frames

    def seeing(self, frame: int) -> tuple[str, ...]:
        """The cameras that saw a frame."""
        return self.split.seeing(frame)

    def box(self, view: View) -> Box:
        """What a batch has to show of a view."""
        camera = self.cameras[view[0]]
        return (0, 0, camera.width, camera.height) if self.whole else self.views[view].box


def training_part(capture: Capture, training: TrainingConfig) -> Capture:
    """The capture with as many views as a configuration trains on."""
    return fewer_views(capture, cameras=training.camera_share, footage_s=training.footage_s)


def load_training_images(
    capture: Capture, device: torch.device = CPU, *, max_bytes: int | None = None
) -> TrainingImages:
    """Read training images until there is no room for more; the others are read when they are asked for.

    `max_bytes`: room on the device; by default 256 MiB, on a GPU a quarter of what is free there.

    Raises:
        InputError: an image is damaged, or shows nobody; one that is read later raises it then.
    """
    train = capture.splits["train"]  # An oracle's capture holds the held-out cameras too.
    views: BoundedCache[View, ImageCrop] = BoundedCache(
        lambda view: read_crop(capture, *view, device), max_bytes=max_bytes or _room_on(device)
    )
    for view in train.views:
        if views.is_full:
            break
        views[view]
    return TrainingImages(
        views=views,
        cameras={name: capture.cameras[name] for name in train.cameras},
        split=train,
        reserved=reserved_views(train),
        backgrounds={name: empty for name in train.cameras if (empty := capture.background(name)) is not None},
        device=device,
    )


def read_crop(capture: Capture, camera: str, frame: int, device: torch.device = CPU) -> ImageCrop:
    """Read a view, and keep of it on the device what shows the subject.

    Raises:
        InputError: the image is damaged, or shows nobody.
    """
    image = capture.image(camera, frame)
    rows, columns = np.nonzero(image[..., 3].any(1))[0], np.nonzero(image[..., 3].any(0))[0]
    if len(rows) == 0:
        raise InputError(f"{capture.folder}: nobody is seen by camera {camera} in frame {frame}")
    top, left = int(rows[0]), int(columns[0])
    subject = np.ascontiguousarray(image[top : rows[-1] + 1, left : columns[-1] + 1])
    return ImageCrop(pixels=torch.from_numpy(subject).to(device), left=left, top=top)


def reserved_views(train: Split) -> tuple[View, ...]:
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
    chosen: list[View] = []
    for i in range(count):
        frame, wanted = frames[i * len(frames) // count], i * stride % cameras
        free = [name for name in parts[frame] if (name, frame) not in chosen]
        # The camera whose turn it is, or the next one that saw the frame.
        chosen.append((min(free, key=lambda name: (train.cameras.index(name) - wanted) % cameras), frame))
    return tuple(chosen)


def _room_on(device: torch.device) -> int:
    return torch.cuda.mem_get_info(device)[0] // GPU_SHARE if device.type == "cuda" else MAX_BYTES


class ReadAhead:
    """Crops of the coming steps, read by threads while a step is made; what is kept already is not read.

    At most those of `STEPS_AHEAD` steps wait, besides what is kept. Without `readers` a step reads its own.
    """

    def __init__(self, views: Views, *, readers: int = READERS) -> None:
        self._views = views
        self._pool = ThreadPoolExecutor(readers) if readers else None
        self._coming: dict[int, dict[View, Future[ImageCrop]]] = {}

    def of_step(self, step: int, needed: Callable[[int], tuple[View, ...]]) -> Views:
        """The views of a step, while those of the next ones are read; `needed` tells the views of any step.

        Raises:
            InputError: what reading one of this step's views came upon.
        """
        if self._pool is None:
            return self._views
        soon = range(step, step + STEPS_AHEAD)
        for given_up in self._coming.keys() - set(soon):  # After a roll-back, say.
            self._cancel(given_up)
        for coming in soon:
            if coming not in self._coming:
                read = self._views.__getitem__
                self._coming[coming] = {view: self._pool.submit(read, view) for view in needed(coming)}
        return {view: future.result() for view, future in self._coming.pop(step).items()}

    @property
    def waiting(self) -> int:
        """Views that are read or being read, and that no step has taken yet."""
        return sum(map(len, self._coming.values()))

    def close(self) -> None:
        """End the threads."""
        for step in tuple(self._coming):
            self._cancel(step)
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def _cancel(self, step: int) -> None:
        for future in self._coming.pop(step).values():
            future.cancel()
