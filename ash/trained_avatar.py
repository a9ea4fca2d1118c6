"""What the avatars that are trained here share: ASH, its ablations and the mesh baseline."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from ash.bounded_cache import BoundedCache
from ash.capture.dataset import Camera, Capture, Pose
from ash.checkpoints import contiguous_state, load_module, read_safetensors
from ash.decoders import apart, decoding_in, decoding_precision
from ash.devices import device_named
from ash.files import write_atomic
from ash.protocol import TrainingOutcome
from ash.template.template import Template
from ash.template_learning.learning import template_of
from ash.textures import DecoderInputs, add_texture_noise_to_frames
from ash.training.batches import Batch
from ash.training.images import TrainingImages, load_training_images, training_part
from ash.training.loop import Trainer
from ash.training.losses import view_loss

SPREAD_FRAMES = 40  # Training frames, evenly taken, over which the decoders' output is averaged and compared.

Own = TypeVar("Own", bound="TrainedAvatar")


class TrainedAvatar(ABC):
    """An avatar on a template whose module is learned from images.

    The protocols `ash.protocol.Avatar` and `ash.training.loop.Trainable`, but for how a frame is decoded and drawn.
    What decoders make of a frame is added to a static `base`.
    """

    # Everything that a checkpoint holds; has `template`, `frame_inputs(pose)`, `decode(inputs)` and `residual(inputs)`.
    module: Any

    def __init__(self, config: Any, capture: Capture, template: Template) -> None:
        """`config` has `model`, `training`, `template`, `seed` and `device`, as `ash.config.AshConfig` has them.

        `capture`: the part that it learns from; `template`: on the CPU.
        """
        self.config = config
        self.device = device_named(config.device)
        self.template = template
        self._motion = capture.motion
        self._outcome: TrainingOutcome | None = None
        self._inputs: BoundedCache[int, Any] = BoundedCache(self._make_inputs)

    @classmethod
    def from_capture(cls: type[Own], config: Any, capture: Capture) -> Own:
        """The avatar, untrained, on the template of its configuration.

        A template that is learned is learned now, on the device of the configuration, or read from the capture's store.
        """
        capture = training_part(capture, config.training)
        template = template_of(config.template, capture, seed=config.seed, device=device_named(config.device))
        return cls(config, capture, template)

    @property
    @abstractmethod
    def base(self) -> nn.Parameter:
        """What the decoders add to."""

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Adam's groups, each with its own `lr`."""

    @torch.no_grad()
    def _make_inputs(self, frame: int) -> Any:
        return self.module.frame_inputs(Pose(self._motion, frame))

    def _inputs_of(self, frame: int) -> Any:
        """What decoders take of a training frame: posed once, as far as there is room, for the template is frozen."""
        return self._inputs[frame]

    @abstractmethod
    def _draw(self, decoded: Tensor, inputs: Any, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
        """Rgb `[c, h, w, 3]` over `background`, for cameras of one size; gradients as this step has them."""

    @abstractmethod
    def template_vertices(self, pose: Pose) -> np.ndarray:
        """The posed template, `[v, 3]` metres."""

    def _has_decoders(self) -> bool:
        return True

    @abstractmethod
    def _warm_up(self, images: TrainingImages) -> None:
        """What is learned before the first step."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Warm up and train; see `ash.training.loop.Trainer.fit`."""
        images = load_training_images(training_part(capture, self.config.training), self.device)
        trainer = Trainer(self, self.config.training, images, folder=folder, seed=self.config.seed)
        outcome = trainer.fit(before_start=lambda: self._warm_up(images))
        spread = self._residual_spread(images.frames) if self._has_decoders() else None
        self._outcome = replace(outcome, precision=self._precision, correction_spread=spread)
        self.template.clear_cache()

    def loss(self, batches: Sequence[Batch], step: int) -> Tensor:
        """ASH Eq. 9 of the decoded frames.

        Raises:
            FloatingPointError: what the weights make cannot be drawn, because it holds NaN or infinity, say.
        """
        inputs = [self._inputs_of(batch.frame) for batch in batches]
        drawn = [
            self._draw(decoded, of_frame, batch.cameras, batch.background, step)
            for decoded, of_frame, batch in zip(self._decode_step(inputs, step), inputs, batches, strict=True)
        ]
        return view_loss(drawn, batches, self.config.training)

    def render_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Tensor:
        """Rgb `[c, h, w, 3]` of a training frame over `background`.

        Raises:
            FloatingPointError: as `loss`.
        """
        inputs = self._inputs_of(frame)
        (decoded,) = self._decode([inputs])
        return self._draw(decoded, inputs, cameras, background, 0)

    def _decode_step(self, inputs: Sequence[DecoderInputs], step: int) -> Sequence[Tensor]:
        """The base alone while the static warm-up lasts, then frames decoded from noisy textures."""
        training = self.config.training
        if step < training.static_steps:
            return [self.base] * len(inputs)
        noisy = add_texture_noise_to_frames(inputs, training.texture_noise, seed=self.config.seed, step=step)
        return self._decode(noisy)

    def _decode(self, inputs: Sequence[DecoderInputs]) -> Sequence[Tensor]:
        """Frames as one batch, in the precision in which decoders learn."""
        with decoding_in(self._precision, self.device):
            return apart(self.module.decode(inputs).float())

    @property
    def _precision(self) -> str:
        return decoding_precision(self.config.training.precision, self.device, self.config.model.width)

    @torch.no_grad()
    def _residual_spread(self, frames: Sequence[int]) -> float:
        """How far what the decoders add differs between training frames, rms."""
        some = frames[:: -(-len(frames) // SPREAD_FRAMES)]
        added = [self.module.residual([self._inputs_of(frame)])[0] for frame in some]
        mean = torch.stack(added).mean(0)
        return float(torch.stack([(one - mean).square().mean() for one in added]).mean().sqrt())

    def outcome(self) -> TrainingOutcome | None:
        """How training ended; None before it did."""
        if self._outcome is None or self.template.learned is None:
            return self._outcome
        return replace(self._outcome, template=self.template.learned.summary)

    def template_seconds(self) -> float | None:
        """What learning the template took, once for all methods that stand on it; None where it was not learned."""
        return None if self.template.learned is None else self.template.learned.seconds

    def parameter_count(self) -> int:
        """Numbers that training may change."""
        return sum(p.numel() for p in self.module.parameters() if p.requires_grad)

    def save(self, path: Path) -> None:
        """Write the weights."""
        write_atomic(path, safetensors.torch.save(contiguous_state(self.module)))

    def load(self, path: Path) -> None:
        """Read the weights that `save` wrote."""
        load_module(self.module, read_safetensors(path)[0], path)
        self.template.clear_cache()
