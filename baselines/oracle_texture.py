"""A reference: the exact surface with the best static texture, which is what geometry alone would give."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.capture.dataset import Capture, Pose
from ash.config import TemplateConfig
from ash.model import stage
from ash.presets import MethodFactory, plus
from ash.protocol import StageClock
from ash.template.template import PosedTemplate, Template
from ash.textures import DecoderInputs
from baselines.ddc import DdcAvatar, DdcConfig, ddc_config


class OracleTexture(DdcAvatar):
    """The mesh baseline without its network: one texture, and the light, for all frames."""

    def __init__(self, config: DdcConfig, capture: Capture, template: Template) -> None:
        super().__init__(config, capture, template)
        self.module.add_module("network", nn.Identity())

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The texture and the light."""
        return [{"params": list(self.module.parameters()), "lr": self.config.training.base_learning_rate}]

    def _has_decoders(self) -> bool:
        return False

    def _decode(self, inputs: Sequence[DecoderInputs]) -> list[Tensor]:
        return [self.base] * len(inputs)

    @torch.no_grad()
    def dress(self, pose: Pose, clock: StageClock) -> tuple[PosedTemplate, Float[Tensor, "3 t t"]]:
        """The posed surface and the texture."""
        with stage(clock, "stg1", self.device):
            return self.template.pose(pose), self.base.clamp(min=0)


def _on_exact(preset: str) -> DdcConfig:
    mesh = ddc_config(plus(preset), seed=0, template=TemplateConfig(kind="exact"))
    return replace(mesh, model=replace(mesh.model, global_features=False))


# One texture, at the preset's budget.
oracle_texture = MethodFactory(config=_on_exact, build=OracleTexture.from_capture)
