"""The loop: Adam over anything that draws views differentiably. ASH, its ablations and the mesh baseline all use it.

Sampling is a function of (seed, step), so that a run stopped anywhere and resumed makes the same steps.
"""

import json
import math
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import safetensors
import safetensors.torch
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ash.adam import Adam
from ash.config import TrainingConfig
from ash.dataset import Camera, Capture
from ash.files import InputError, write_atomic
from ash.losses import cache_target, l1_ssim_loss

CROP_MARGIN = 12  # Pixels around the subject, so that a Gaussian that strays outside the mask is still seen.
LOG_EVERY = 50
RESERVED_VIEWS = 4  # Training views that no step sees: the training curve is drawn from them.
CURVE = tuple(i / 32 for i in (1, 2, 4, 8, 12, 16, 20, 24, 28, 32))  # Shares of the steps after which they are drawn.
FINAL_LEARNING_RATE = 0.02  # Of the initial one, at the end of the cosine.


class Diverged(FloatingPointError):
    """Training produced NaN or infinity twice. That is a result, and is recorded as one."""


class Interrupted(KeyboardInterrupt):
    """SIGTERM came; the state was saved."""


@runtime_checkable
class Trainable(Protocol):
    """What the loop needs of a model."""

    @property
    def module(self) -> torch.nn.Module:
        """Everything that is saved in a checkpoint."""

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Adam's groups, each with its own `lr`."""

    def draw_training_views(self, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
        """Differentiable rgb `[c, h, w, 3]` over `background`, for cameras of one size.

        Raises:
            FloatingPointError: what the weights make cannot be drawn, because it holds NaN or infinity, say.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingImages:
    """All training images in memory, with the box that the subject fills in each."""

    views: dict[tuple[str, int], UInt8[np.ndarray, "h w 4"]]
    boxes: dict[tuple[str, int], tuple[int, int, int, int]]  # x0, y0, x1, y1 in pixels, half open
    cameras: dict[str, Camera]
    frames: tuple[int, ...]
    reserved: tuple[tuple[str, int], ...] = ()  # views that no batch holds


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """One step's work: several views of one frame, cropped alike."""

    frame: int
    cameras: list[Camera]
    targets: Float[Tensor, "c h w 3"]  # over `background`
    foreground: Float[Tensor, "c h w"]
    background: Float[Tensor, " 3"]


def load_training_images(capture: Capture) -> TrainingImages:
    """Read every training image once.

    Raises:
        InputError: an image is damaged, or shows nobody.
    """
    views, boxes = {}, {}
    train = capture.splits["train"]  # An oracle's capture holds the held-out cameras too.
    for camera, frame in train.views:
        image = capture.image(camera, frame)
        rows, columns = np.nonzero(image[..., 3].any(1))[0], np.nonzero(image[..., 3].any(0))[0]
        if len(rows) == 0:
            raise InputError(f"{capture.folder}: nobody is seen by camera {camera} in frame {frame}")
        views[camera, frame] = image
        boxes[camera, frame] = (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    return TrainingImages(
        views=views,
        boxes=boxes,
        cameras={name: capture.cameras[name] for name in train.cameras},
        frames=tuple(train.frames),
        reserved=reserved_views(tuple(train.cameras), tuple(train.frames)),
    )


def reserved_views(cameras: tuple[str, ...], frames: tuple[int, ...]) -> tuple[tuple[str, int], ...]:
    """A few views of different cameras in different frames; none where a step would then lack cameras."""
    count = min(RESERVED_VIEWS, len(frames) // 2)
    if len(cameras) < 3 or count == 0:
        return ()
    where = [(i * len(cameras) // count, i * len(frames) // count) for i in range(count)]
    return tuple((cameras[camera], frames[frame]) for camera, frame in where)


def draw_batch(images: TrainingImages, config: TrainingConfig, seed: int, step: int) -> Batch:
    """The batch of a step: frames in a new random order every epoch, cameras at random."""
    epoch, position = divmod(step, len(images.frames))
    order = np.random.default_rng([seed, 1, epoch]).permutation(len(images.frames))
    frame = images.frames[order[position]]
    rng = np.random.default_rng([seed, 2, step])
    cameras = [name for name in images.cameras if (name, frame) not in images.reserved]
    count = min(config.views_per_step, len(cameras))
    names = [cameras[i] for i in rng.choice(len(cameras), count, replace=False)]
    colour = rng.random(3) if config.background == "random" else np.zeros(3)
    return cut_batch(images, frame, names, torch.from_numpy(colour).float())


def cut_batch(images: TrainingImages, frame: int, names: list[str], background: Tensor) -> Batch:
    """Crop views of one frame to boxes of one size, and move the principal points along."""
    boxes = [images.boxes[name, frame] for name in names]
    full = images.cameras[names[0]]
    width = min(full.width, max(x1 - x0 for x0, _, x1, _ in boxes) + 2 * CROP_MARGIN)
    height = min(full.height, max(y1 - y0 for _, y0, _, y1 in boxes) + 2 * CROP_MARGIN)
    cameras, targets, masks = [], [], []
    for name, (x0, y0, x1, y1) in zip(names, boxes, strict=True):
        left = min(max(0, (x0 + x1 - width) // 2), full.width - width)
        top = min(max(0, (y0 + y1 - height) // 2), full.height - height)
        cameras.append(crop_camera(images.cameras[name], left, top, width, height))
        pixels = images.views[name, frame][top : top + height, left : left + width]
        rgba = torch.from_numpy(pixels).float() / 255
        targets.append(rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * background)
        masks.append(rgba[..., 3])
    return Batch(
        frame=frame,
        cameras=cameras,
        targets=torch.stack(targets),
        foreground=torch.stack(masks),
        background=background,
    )


def crop_camera(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The camera that sees a window of another's image."""
    K = camera.K.copy()
    K[:2, 2] -= (left, top)
    return Camera(name=camera.name, width=width, height=height, K=K, viewmat=camera.viewmat)


def fit(
    learner: Trainable,
    images: TrainingImages,
    config: TrainingConfig,
    *,
    seed: int,
    folder: Path,
    before_start: Callable[[], None] = lambda: None,
) -> None:
    """Train to the end, from the checkpoint in `folder` if there is one.

    `before_start` runs only when training starts afresh (warm-ups that do not render).

    Raises:
        Diverged: a loss, gradient or weight was not finite, again after one roll-back with half the learning rate.
        Interrupted: SIGTERM came; the checkpoint holds everything up to the last whole step.
    """
    if not config.crop:
        whole = {
            (name, frame): (0, 0, images.cameras[name].width, images.cameras[name].height)
            for name, frame in images.boxes
        }
        images = replace(images, boxes=whole)
    run = _Run(learner, config, images, folder)
    if not run.resume():
        before_start()
        run.average_afresh()
        if not run.save():
            raise Diverged("the warm-up left weights that are not finite")
    with _sigterm() as asked_to_stop:
        while run.step < config.steps or not run.save():  # What cannot be saved was rolled back: on from there.
            batch = draw_batch(images, config, seed, run.step)
            run.advance(batch)
            if asked_to_stop():
                run.save()
                raise Interrupted(f"stopped at step {run.step} of {config.steps}; run again to go on")
            run.save_if_due()
    run.finish()


def view_loss(images: Float[Tensor, "c h w 3"], batch: Batch, config: TrainingConfig) -> Tensor:
    """ASH Eq. 9, mean over the views."""
    losses = [
        l1_ssim_loss(image, cache_target(target), l1_weight=config.l1_weight, ssim_weight=config.ssim_weight)
        for image, target in zip(images, batch.targets, strict=True)
    ]
    return torch.stack(losses).mean()


class _Run:
    """The state of one training: model, optimiser, step and elapsed seconds."""

    def __init__(self, learner: Trainable, config: TrainingConfig, images: TrainingImages, folder: Path) -> None:
        self.learner, self.config, self.images = learner, config, images
        groups = learner.parameter_groups()
        self.optimiser = Adam(groups, eps=1e-15)
        self.initial_rates = [group["lr"] for group in groups]
        self.path, self.log = folder / "checkpoint.safetensors", folder / "log.jsonl"
        self.step, self.seconds, self.rate_scale = 0, 0.0, 1.0
        self.curve_steps = {round(share * config.steps) for share in CURVE}
        self.average: dict[str, Tensor] = {}
        self.average_afresh()
        self.started = self.saved_at = time.monotonic()

    def average_afresh(self) -> None:
        """Let the average of the weights start from the weights as they are."""
        if self.config.ema:
            self.average = {name: value.detach().clone() for name, value in self.learner.module.named_parameters()}

    def advance(self, batch: Batch) -> None:
        """One step of Adam."""
        factor = self._schedule() * self.rate_scale
        for group, rate in zip(self.optimiser.groups, self.initial_rates, strict=True):
            group["lr"] = rate * factor
        self.optimiser.zero_grad()
        try:
            drawn = self.learner.draw_training_views(batch.frame, batch.cameras, batch.background, self.step)
        except FloatingPointError as error:
            self._roll_back(str(error))
            return
        loss = view_loss(drawn, batch, self.config)
        loss.backward()  # type: ignore[no-untyped-call]
        if not self._finite(loss):
            self._roll_back("loss or gradient not finite")
            return
        self.optimiser.step()
        for name, value in self.learner.module.named_parameters() if self.average else ():
            # A short memory at first, so that the start is soon forgotten.
            self.average[name].lerp_(value.detach(), 1 - min(self.config.ema, (1 + self.step) / (10 + self.step)))
        self.step += 1
        if self.step % LOG_EVERY == 1 or self.step == self.config.steps or self.step in self.curve_steps:
            self._write_log(loss)

    def _schedule(self) -> float:
        """The factor of the learning rates at this step."""
        if self.config.schedule == "constant":
            return 1.0
        fraction = self.step / self.config.steps
        return FINAL_LEARNING_RATE + (1 - FINAL_LEARNING_RATE) * 0.5 * (1 + math.cos(math.pi * fraction))

    def _finite(self, loss: Tensor) -> bool:
        gradients = [p.grad for p in self.optimiser.parameters if p.grad is not None]
        return all(torch.isfinite(g.sum()) for g in [loss.detach(), *gradients])

    def _roll_back(self, why: str) -> None:
        if self.rate_scale < 1:
            raise Diverged(f"{why} at step {self.step}, again after a roll-back")
        self.resume()
        self.rate_scale = 0.5

    def _write_log(self, loss: Tensor) -> None:
        row = {"step": self.step, "seconds": round(self._elapsed(), 3), "loss": float(loss.detach())}
        if self.step in self.curve_steps and self.images.reserved:
            began = time.monotonic()
            row["train_psnr"] = self._reserved_psnr()
            self.started += time.monotonic() - began  # Looking is not training.
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a") as file:
            file.write(json.dumps(row) + "\n")

    @torch.no_grad()
    def _reserved_psnr(self) -> float:
        """Foreground PSNR of the training views that no step sees, in dB, with the weights as they are."""
        errors = []
        for name, frame in self.images.reserved:
            view = cut_batch(self.images, frame, [name], torch.zeros(3))
            try:
                drawn = self.learner.draw_training_views(frame, view.cameras, view.background, self.step)
            except FloatingPointError:
                return math.nan  # The next step meets the same, and deals with it.
            errors.append((drawn.clamp(0, 1) - view.targets)[view.foreground > 0.5].square().flatten())
        return float(-10 * torch.log10(torch.cat(errors).mean()))

    def _elapsed(self) -> float:
        return self.seconds + time.monotonic() - self.started

    def save_if_due(self) -> None:
        """Save once per `checkpoint_seconds`."""
        if time.monotonic() - self.saved_at > self.config.checkpoint_seconds:
            self.save()

    def save(self) -> bool:
        """Write the checkpoint atomically. False: the weights are not finite, and were rolled back instead."""
        if not all(torch.isfinite(value).all() for value in self.learner.module.state_dict().values()):
            if self.path.exists():
                self._roll_back("weights not finite")
            return False
        tensors = {f"model.{name}": value.contiguous() for name, value in self.learner.module.state_dict().items()}
        for index, moments in enumerate(self.optimiser.moments):
            for name, value in (moments or {}).items():
                tensors[f"adam.{index}.{name}"] = value.contiguous()
        tensors |= {f"average.{name}": value.contiguous() for name, value in self.average.items()}
        facts = {"step": str(self.step), "seconds": repr(self._elapsed()), "rate_scale": repr(self.rate_scale)}
        write_atomic(self.path, safetensors.torch.save(tensors, metadata=facts))
        self.saved_at = time.monotonic()
        return True

    @torch.no_grad()
    def finish(self) -> None:
        """Give the model the averaged weights, if they were averaged; the checkpoint keeps both."""
        for name, value in self.learner.module.named_parameters() if self.average else ():
            value.copy_(self.average[name])

    def resume(self) -> bool:
        """Load the checkpoint, if there is one."""
        if not self.path.exists():
            return False
        tensors, facts = read_safetensors(self.path)
        load_module(self.learner.module, {n[6:]: t for n, t in tensors.items() if n.startswith("model.")}, self.path)
        for index, parameter in enumerate(self.optimiser.parameters):
            if f"adam.{index}.step" not in tensors:  # It never had a gradient.
                self.optimiser.moments[index] = None
                continue
            moments = self.optimiser.moments[index] = Adam.moments_like(parameter)
            for name, value in moments.items():
                value.copy_(tensors[f"adam.{index}.{name}"])
        for name, value in self.average.items():
            value.copy_(tensors[f"average.{name}"])
        self.step, self.seconds = int(facts["step"]), float(facts["seconds"])
        self.rate_scale = float(facts["rate_scale"])
        self.started = time.monotonic()
        return True


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file, or an InputError that names it."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, safetensors.SafetensorError) as error:
        raise InputError(f"{path}: expected a safetensors checkpoint ({error})") from error


def load_module(module: torch.nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load parameters and check that they fit and are finite."""
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"{path}: holds NaN or infinity")
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path}: was written by another configuration ({error})") from error


class _sigterm:
    """Turns SIGTERM into a question that the loop asks after each step (main thread only)."""

    def __enter__(self) -> Callable[[], bool]:
        self.asked = False
        try:
            self.previous = signal.signal(signal.SIGTERM, self._ask)
        except ValueError:  # Not the main thread: signals are somebody else's business.
            self.previous = None
        return lambda: self.asked

    def _ask(self, *_: object) -> None:
        self.asked = True

    def __exit__(self, *_: object) -> None:
        if self.previous is not None:
            signal.signal(signal.SIGTERM, self.previous)
