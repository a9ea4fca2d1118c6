"""ASH as a method of the suite: builds the model from a capture, warms it up, trains it, renders with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from ash.bounded_cache import BoundedCache
from ash.capture.dataset import Camera, Capture, Pose
from ash.checkpoints import contiguous_state, load_module, read_safetensors
from ash.config import AshConfig, ModelConfig
from ash.decoders import Decoders, decoding_in, decoding_precision
from ash.devices import device_named
from ash.files import InputError, write_atomic
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.initialising import blank_gaussians, initial_gaussians, released_gaussians, texel_pitch
from ash.model import AshModel, image_of
from ash.protocol import StageClock, TrainingOutcome
from ash.template_learning.learning import template_of, with_template
from ash.template_learning.refining import refined_template
from ash.textures import FrameInputs, TexelLattice, add_texture_noise_to_frames, build_lattice
from ash.training.adam import Adam
from ash.training.batches import draw_batch, over
from ash.training.images import TrainingImages, load_training_images, training_part
from ash.training.loop import fit, view_loss

RELEASED_OPACITY_WEIGHT = 0.1  # In the release's warm-up.
FITTED_LOOK, FITTED_GAIN = 100, 0.01  # A frame is fitted until so many steps lower its loss by less than this share.

DecodedFrame = tuple[Tensor, FrameInputs]  # raw parameters [n, o], and where they are posed
MakeDecoders = Callable[[ModelConfig, TexelLattice], torch.nn.Module]


class AshAvatar:
    """The Avatar protocol (see `ash.protocol`) for ASH and for every ablation that is a configuration of it."""

    def __init__(
        self,
        config: AshConfig,
        capture: Capture,
        *,
        make_decoders: MakeDecoders | None = None,
    ) -> None:
        capture = training_part(capture, config.training)
        self.device = device_named(config.device)
        self.template = template_of(config.template, capture, seed=config.seed, device=self.device)
        torch.manual_seed(config.seed)
        self.config = config
        if config.model.refine:
            self.template, _ = refined_template(self.template, config.template)
        self.lattice = build_lattice(capture.template, config.model.texels)
        self.analytic = initial_gaussians(config.model, capture, self.template, self.lattice)
        decoders = None
        if config.model.motion:
            decoders = (make_decoders or Decoders)(config.model, self.lattice)
        self.module = AshModel(config.model, self.template, self.lattice, self._start(capture), decoders)
        if self.module.textures is not None:
            self.module.textures.fit_normalization(self.template, capture.motion, capture.splits["train"].frames)
        self.module.to(self.device)
        self.template, self.lattice = self.module.template, self.module.lattice
        self.analytic = self.analytic.to(self.device)
        self._inputs = BoundedCache(self._make_inputs)  # A template that images do not move is frozen.
        self._motion = capture.motion
        self._outcome: TrainingOutcome | None = None

    def _start(self, capture: Capture) -> Tensor:
        if self.config.model.base:
            return self.analytic
        posed = self.template.pose(Pose(capture.motion, capture.splits["train"].frames[0]))
        pitch = float(texel_pitch(self.lattice, posed.canonical).median())
        return blank_gaussians(self.config.model, len(self.lattice.texels), pitch)

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Warm up and train; see `ash.training.loop.fit`."""
        images = load_training_images(training_part(capture, self.config.training), self.device)
        outcome = fit(
            self,
            images,
            self.config.training,
            seed=self.config.seed,
            folder=folder,
            before_start=lambda: self._warm_up(images),
        )
        self._outcome = replace(outcome, precision=self._precision)
        self.template.clear_cache()

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Networks, and what is learned directly: static texels, light, a displacement of the template."""
        training, module = self.config.training, self.module
        nets = list(module.decoders.parameters()) if module.decoders is not None else []
        slow, fast = [], [p for p in (module.base_texels, module.fallback_texels, module.light) if p is not None]
        if module.refinement is not None:
            slow, shared = module.refinement.nets.networks(), module.refinement.shared.parameters()
            fast += shared
        groups = [(nets + slow, training.learning_rate), (fast, training.base_learning_rate)]
        learned = [([p for p in group if p.requires_grad], rate) for group, rate in groups]
        return [{"params": group, "lr": rate} for group, rate in learned if group]

    def draw_training_views(
        self, frame: int, cameras: list[Camera], background: Tensor, step: int, decoded: DecodedFrame
    ) -> Tensor:
        """Stage 4."""
        raw, conditions = decoded
        return self._drawn(raw, conditions, cameras, background)

    def decode_together(self, frames: Sequence[int], step: int) -> list[DecodedFrame]:
        """Stage 3 of a step's frames, on cached conditions; the base alone while the static warm-up lasts."""
        training, conditions = self.config.training, [self._inputs_of(frame) for frame in frames]
        if step < training.static_steps:
            return [(self.module.base_texels, seen) for seen in conditions]
        noisy = add_texture_noise_to_frames(conditions, training.texture_noise, seed=self.config.seed, step=step)
        return list(zip(self._decode(noisy), conditions, strict=True))

    def draw_static_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Tensor | None:
        """Views of the static avatar, which counts far from the training motion."""
        static = self.module.fallback_texels
        if static is None:
            return None
        return self._drawn(static, self._inputs_of(frame), cameras, background)

    @torch.no_grad()
    def end_warmup(self) -> None:
        """Let the static avatar start from what the warm-up made."""
        if self.module.fallback_texels is not None:
            self.module.fallback_texels.copy_(self.module.base_texels)

    def _drawn(self, raw: Tensor, conditions: FrameInputs, cameras: list[Camera], background: Tensor) -> Tensor:
        flat = background.ndim == 1
        try:
            drawn = self.module.draw(self.module.pose(raw, conditions), cameras, background if flat else None)
            return drawn.rgb if flat else over(drawn.rgb, drawn.alpha, background)
        except InputError as error:  # Cameras and background come from the capture: the Gaussians are at fault.
            raise FloatingPointError(f"Gaussians that cannot be drawn ({error})") from error

    def decoder_residual(self, frame: int) -> Tensor | None:
        """What the decoders add to the base in a training frame, raw parameters `[n, o]`."""
        decoders = self.module.decoders
        return None if decoders is None else self.module.mask_offsets(decoders(self._inputs_of(frame)))

    def _decode(self, frames: Sequence[FrameInputs]) -> list[Tensor]:
        """Stage 3 as it learns, in the precision of the configuration."""
        with decoding_in(self._precision, self.device):
            return [raw.float() for raw in self.module.decode_together(frames)]

    @property
    def _precision(self) -> str:
        return decoding_precision(self.config.training.precision, self.device, self.config.model.width)

    def _inputs_of(self, frame: int) -> FrameInputs:
        if self.module.refinement is None:
            return self._inputs[frame]
        self.template.clear_cache()  # It moves with every step: all that is drawn from it is drawn anew.
        return self.module.frame_inputs(Pose(self._motion, frame))

    @torch.no_grad()
    def _make_inputs(self, frame: int) -> FrameInputs:
        return self.module.frame_inputs(Pose(self._motion, frame))

    def _warm_up(self, images: TrainingImages) -> None:
        """ASH Eq. 8: regress the decoders to known Gaussians before anything is rendered through them."""
        training = self.config.training
        if training.warmup == "analytic":
            self._regress(images.frames, self._released_target, opacity=RELEASED_OPACITY_WEIGHT)
        elif training.warmup == "fitted":
            chosen = images.frames[:: training.fitted_every]
            fitted = {frame: self._fit_frame(images, frame) for frame in chosen}
            self._regress(chosen, fitted.__getitem__)

    def _released_target(self, frame: int) -> Tensor:
        return released_gaussians(self.config.model, self.analytic, self._inputs_of(frame))

    def _fit_frame(self, images: TrainingImages, frame: int) -> Tensor:
        """Pseudo ground truth of one frame: positions stay on the template, everything else is fitted to its views."""
        alone = replace(images, split=images.split.only(frames=(frame,)))
        raw = self.analytic.clone().requires_grad_()
        optimiser = Adam([{"params": [raw], "lr": self.config.training.base_learning_rate}])
        with torch.no_grad():
            conditions = self._inputs_of(frame)
        losses: list[float] = []
        while not _is_fitted(losses, self.config.training.fitted_steps):
            step = len(losses)
            batch = draw_batch(alone, self.config.training, self.config.seed, step)
            fixed = torch.cat([torch.zeros_like(raw[:, :3]), raw[:, 3:]], 1)
            drawn = self._drawn(fixed, conditions, batch.cameras, batch.background)
            loss = view_loss([drawn], [batch], self.config.training)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            losses.append(float(loss.detach()))
        return torch.cat([torch.zeros_like(raw[:, :3]), raw[:, 3:]], 1).detach()

    def _regress(self, frames: Sequence[int], target: Callable[[int], Tensor], *, opacity: float = 1.0) -> None:
        assert self.module.decoders is not None
        training = self.config.training
        optimiser = Adam([{"params": list(self.module.decoders.parameters()), "lr": training.learning_rate}])
        weights = self.analytic.new_ones(self.analytic.shape[1])
        weights[10] = opacity
        for step in range(training.warmup_steps):
            frame = frames[step % len(frames)]
            (raw,) = self._decode([self._inputs_of(frame)])
            loss = (weights * (raw - target(frame)) ** 2).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        return image_of(self.module(pose, camera, clock))

    def template_vertices(self, pose: Pose) -> np.ndarray:
        """The posed template, `[v, 3]` metres."""
        return self.template.pose(pose).vertices.cpu().numpy()

    def outcome(self) -> TrainingOutcome | None:
        """How training ended; None before it did."""
        return with_template(self._outcome, self.template)

    def template_seconds(self) -> float | None:
        """What learning the template took, once for all methods that stand on it; None where it was not learned."""
        return None if self.template.learned is None else self.template.learned.seconds

    @torch.no_grad()
    def gaussian_means(self, pose: Pose) -> np.ndarray:
        """Centres of the posed Gaussians, `[n, 3]` metres."""
        return self.gaussians(pose).means.cpu().numpy()

    @torch.no_grad()
    def gaussians(self, pose: Pose) -> Gaussians:
        """The posed Gaussians: world, metres, on its device; of a blend, those with the larger share."""
        return max(self.shared_gaussians(pose), key=lambda found: found[0])[1]

    @torch.no_grad()
    def shared_gaussians(self, pose: Pose, *, clock: StageClock | None = None) -> list[tuple[float, Gaussians]]:
        """All sets of posed Gaussians whose renders are blended, and their weights (`ash.model.blend_renders`)."""
        return self.module.gaussians(pose, clock)

    @property
    def dilation(self) -> float:
        """What its pictures add to both axes of every projected Gaussian, px^2."""
        return self.config.model.dilation

    def parameter_count(self) -> int:
        """Numbers that training may change."""
        return sum(p.numel() for p in self.module.parameters() if p.requires_grad)

    def gaussian_count(self) -> int:
        """One per covered texel."""
        return len(self.lattice.texels)

    def save(self, path: Path) -> None:
        """Write the weights."""
        write_atomic(path, safetensors.torch.save(contiguous_state(self.module)))

    def load(self, path: Path) -> None:
        """Read the weights that `save` wrote."""
        load_module(self.module, read_safetensors(path)[0], path)
        self.template.clear_cache()


def _is_fitted(losses: Sequence[float], steps: int) -> bool:
    """Whether a frame's fit gains nothing more, or has had its steps."""
    if len(losses) >= steps:
        return True
    if len(losses) < 2 * FITTED_LOOK or len(losses) % FITTED_LOOK:
        return False
    before, after = sum(losses[-2 * FITTED_LOOK : -FITTED_LOOK]), sum(losses[-FITTED_LOOK:])
    return before - after < FITTED_GAIN * before
