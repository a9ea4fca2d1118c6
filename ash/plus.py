"""ASH with what the paper does not have, each a switch: learned base texels, light, a static avatar to fall back on."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.gaussians.gaussians import Gaussians
from ash.gaussians.texels import LIGHT_COEFFICIENTS, pose
from ash.model import AshModel
from ash.textures import FrameInputs


class AshPlusModel(AshModel):
    """`AshModel` with `ModelConfig.base`, `light` and `novelty_scale`.

    `base`: what the decoders add to is learned. `light`: colours are multiplied by a function of the posed normal.
    `novelty_scale`: far from the training poses the render is blended with that of `fallback_texels`, a static avatar.
    """

    def _add_texels(self, initial: Float[Tensor, "n o"]) -> None:
        super()._add_texels(initial)
        self.base_texels.requires_grad_(self.config.base)
        blends = self.config.novelty_scale > 0 and self.decoders is not None
        self.fallback_texels = nn.Parameter(initial.clone()) if blends else None
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if self.config.light else None

    def gaussians(self, raw: Float[Tensor, "n o"], inputs: FrameInputs, threads: int = 1) -> Gaussians:
        """Eq. 5, lit."""
        return pose(raw, inputs, self.config, self.light, threads=threads)

    def components(
        self, decoded: Float[Tensor, "n o"], inputs: FrameInputs
    ) -> list[tuple[float, Float[Tensor, "n o"]]]:
        """The decoded avatar, and the static one where `TextureDrawer.decoder_weight` is below 1."""
        if self.fallback_texels is None or inputs.decoder_weight == 1:
            return [(1.0, decoded)]
        return [(inputs.decoder_weight, decoded), (1 - inputs.decoder_weight, self.fallback_texels)]

    def direct_parameters(self) -> list[nn.Parameter]:
        """Texels and light."""
        more = (self.fallback_texels, self.light)
        return super().direct_parameters() + [parameter for parameter in more if parameter is not None]
