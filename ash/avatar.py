"""ASH as a method of the suite: builds the model from a capture, warms it up, trains it, renders with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ash.capture.dataset import Camera, Capture, Pose
from ash.config import AshConfig
from ash.decoders import Decoders
from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.initialising import blank_gaussians, initial_gaussians, released_gaussians, texel_pitch
from ash.model import AshModel, image_of
from ash.plus import AshPlusModel
from ash.protocol import StageClock
from ash.template.template import Template
from ash.template_learning.refining import refined_template
from ash.textures import FrameInputs, TexelLattice, build_lattice
from ash.trained_avatar import TrainedAvatar
from ash.training.adam import Adam
from ash.training.batches import draw_batch, over
from ash.training.images import TrainingImages
from ash.training.losses import view_loss

RELEASED_OPACITY_WEIGHT = 0.1  # In the release's warm-up.
FITTED_EVERY = 10  # Frames, of which the first is fitted alone in the paper's warm-up.
FITTED_LOOK, FITTED_GAIN = 100, 0.01  # A frame is fitted until so many steps lower its loss by less than this share.


class AshAvatar(TrainedAvatar):
    """The Avatar protocol (see `ash.protocol`) for ASH and for every ablation that is a configuration of it."""

    config: AshConfig
    module: AshModel

    def __init__(self, config: AshConfig, capture: Capture, template: Template) -> None:
        super().__init__(config, capture, template)
        torch.manual_seed(config.seed)
        if config.model.refine:
            template, _ = refined_template(template, config.template)
        lattice = build_lattice(capture.template, config.model.texels)
        analytic = initial_gaussians(config.model, capture, template, lattice)
        initial = analytic if config.model.base else self._blank(capture, template, lattice)
        decoders = self.make_decoders(lattice) if config.model.motion else None
        model = AshPlusModel if config.model.base or config.model.light else AshModel
        self.module = model(config.model, template, lattice, initial, decoders)
        if self.module.textures is not None:
            self.module.textures.fit_normalization(template, capture.motion, capture.splits["train"].frames)
        self.module.to(self.device)
        self.template, self.lattice = self.module.template, self.module.lattice
        self.analytic = analytic.to(self.device)

    def make_decoders(self, lattice: TexelLattice) -> nn.Module:
        """Stg. 3; see `AshModel`."""
        return Decoders(self.config.model, lattice)

    def _blank(self, capture: Capture, template: Template, lattice: TexelLattice) -> Tensor:
        posed = template.pose(Pose(capture.motion, capture.splits["train"].frames[0]))
        pitch = float(texel_pitch(lattice, posed.canonical).median())
        return blank_gaussians(self.config.model, len(lattice.texels), pitch)

    @property
    def base(self) -> nn.Parameter:
        """Raw parameters per texel, `[n, o]`."""
        return self.module.base_texels

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Networks, and what is learned directly: static texels, light, a displacement of the template."""
        training, module = self.config.training, self.module
        nets = list(module.decoders.parameters()) if module.decoders is not None else []
        slow, fast = [], module.direct_parameters()
        if module.refinement is not None:
            slow = module.refinement.nets.networks()
            fast += module.refinement.shared.parameters()
        groups = [(nets + slow, training.learning_rate), (fast, training.base_learning_rate)]
        return [{"params": group, "lr": rate} for group, rate in groups if group]

    def _has_decoders(self) -> bool:
        return self.module.decoders is not None

    def _draw(self, decoded: Tensor, inputs: FrameInputs, cameras: list[Camera], background: Tensor, _: int) -> Tensor:
        flat = background.ndim == 1
        try:
            gaussians = self.module.gaussians(decoded, inputs)
            drawn = self.module.rasterize(gaussians, cameras, background if flat else None)
            return drawn.rgb if flat else over(drawn.rgb, drawn.alpha, background)
        except InputError as error:  # Cameras and background come from the capture: the Gaussians are at fault.
            raise FloatingPointError(f"Gaussians that cannot be drawn ({error})") from error

    def _inputs_of(self, frame: int) -> FrameInputs:
        if self.module.refinement is None:
            return super()._inputs_of(frame)
        self.template.clear_cache()  # It moves with every step: all that is drawn from it is drawn anew.
        return self.module.frame_inputs(Pose(self._motion, frame))

    def _warm_up(self, images: TrainingImages) -> None:
        """ASH Eq. 8: regress the decoders to known Gaussians before anything is rendered through them."""
        training = self.config.training
        if training.warmup == "analytic":
            self._regress(images.frames, self._released_target, opacity=RELEASED_OPACITY_WEIGHT)
        elif training.warmup == "fitted":
            chosen = images.frames[::FITTED_EVERY]
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
            inputs = self._inputs_of(frame)
        losses: list[float] = []
        while not _is_fitted(losses, self.config.training.fitted_steps):
            step = len(losses)
            batch = draw_batch(alone, self.config.training, self.config.seed, step)
            fixed = torch.cat([torch.zeros_like(raw[:, :3]), raw[:, 3:]], 1)
            drawn = self._draw(fixed, inputs, batch.cameras, batch.background, step)
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

    @torch.no_grad()
    def gaussian_means(self, pose: Pose) -> np.ndarray:
        """Centres of the posed Gaussians, `[n, 3]` metres."""
        return self.gaussians(pose).means.cpu().numpy()

    @torch.no_grad()
    def gaussians(self, pose: Pose, *, clock: StageClock | None = None) -> Gaussians:
        """The posed Gaussians: world, metres, on its device."""
        return self.module.posed_gaussians(pose, clock)

    @property
    def dilation(self) -> float:
        """What its pictures add to both axes of every projected Gaussian, px^2."""
        return self.config.model.dilation

    def gaussian_count(self) -> int:
        """One per covered texel."""
        return len(self.lattice.texels)


def _is_fitted(losses: Sequence[float], steps: int) -> bool:
    """Whether a frame's fit gains nothing more, or has had its steps."""
    if len(losses) >= steps:
        return True
    if len(losses) < 2 * FITTED_LOOK or len(losses) % FITTED_LOOK:
        return False
    before, after = sum(losses[-2 * FITTED_LOOK : -FITTED_LOOK]), sum(losses[-FITTED_LOOK:])
    return before - after < FITTED_GAIN * before
