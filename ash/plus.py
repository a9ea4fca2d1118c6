"""ASH with what the paper does not have, each a switch: learned base texels and light."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.gaussians.gaussians import Gaussians
from ash.gaussians.texels import LIGHT_COEFFICIENTS, pose
from ash.model import AshModel
from ash.textures import FrameInputs


class AshPlusModel(AshModel):
    """`AshModel` with `ModelConfig.base` and `light`.

    `base`: what the decoders add to is learned. `light`: colours are multiplied by a function of the posed normal.
    """

    def _add_texels(self, initial: Float[Tensor, "n o"]) -> None:
        super()._add_texels(initial)
        self.base_texels.requires_grad_(self.config.base)
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if self.config.light else None

    def gaussians(self, raw: Float[Tensor, "n o"], inputs: FrameInputs, threads: int = 1) -> Gaussians:
        """Eq. 5, lit."""
        return pose(raw, inputs, self.config, self.light, threads=threads)

    def direct_parameters(self) -> list[nn.Parameter]:
        """Texels and light."""
        return super().direct_parameters() + ([] if self.light is None else [self.light])
