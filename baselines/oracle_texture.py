"""A reference: the exact surface with the best static texture, which is what geometry alone would give."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Camera, Capture, Pose
from ash.config import TemplateConfig
from ash.model import stage
from ash.presets import MethodFactory, named
from ash.protocol import StageClock
from ash.template.template import PosedTemplate
from baselines.ddc import DdcAvatar, DdcConfig, ddc_config

# Texture pixels per Gaussian of ASH's lattice, per side. On the mannequin, 4 in place of 2 bring 4.5 dB on training
# views and 0.1 dB on held-out ones.
TEXTURE_FACTOR = 4


class OracleTexture(DdcAvatar):
    """The mesh baseline without its network: one texture, and the light, for all frames."""

    def __init__(self, config: DdcConfig, capture: Capture) -> None:
        super().__init__(config, capture)
        self.module.add_module("network", nn.Identity())
        self._surfaces: dict[int, PosedTemplate] = {}

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The texture and the light."""
        return [{"params": list(self.module.parameters()), "lr": self.config.training.base_learning_rate}]

    def decode_together(self, frames: Sequence[int], step: int) -> list[Float[Tensor, "3 t t"]]:
        """There is nothing to decode."""
        return [self.module.texture] * len(frames)

    def draw_training_views(
        self, frame: int, cameras: list[Camera], background: Tensor, step: int, decoded: Tensor
    ) -> Tensor:
        """The texture, drawn into each camera."""
        if frame not in self._surfaces:
            self._surfaces[frame] = self.template.pose(Pose(self._motion, frame))
        posed = self._surfaces[frame]
        return self._drawn(decoded, posed, self.module.see(posed, cameras), background)

    def decoder_residual(self, frame: int) -> None:
        """There is nothing that could differ between frames."""

    @torch.no_grad()
    def dress(self, pose: Pose, clock: StageClock) -> tuple[PosedTemplate, Float[Tensor, "3 t t"]]:
        """The posed surface and the texture."""
        with stage(clock, "stg1", self.device):
            return self.template.pose(pose), self.module.texture.clamp(min=0)


def _on_exact(preset: str) -> DdcConfig:
    config = named(preset)
    mesh = ddc_config(config, seed=0, template=TemplateConfig(kind="exact"))
    model = replace(mesh.model, novelty_scale=0.0, global_features=False)
    return replace(mesh, texture=TEXTURE_FACTOR * config.model.texels, model=model)


oracle_texture = MethodFactory(config=_on_exact, build=OracleTexture)  # One texture, at the preset's budget.
