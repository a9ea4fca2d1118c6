"""The paper's ablation w/ MLP: Gaussian parameters straight from 3D, without the texture space (ASH appendix B)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.avatar import AshAvatar
from ash.config import ModelConfig
from ash.decoders import as_batch, decoding_precision
from ash.gaussians.gaussians import raw_channels
from ash.presets import ADDITIONS, MethodFactory, named
from ash.textures import FrameInputs, TexelLattice

LAYERS, WIDTH = 8, 256
OCTAVES = 6


class MlpDecoder(nn.Module):
    """Eight layers of width 256: the motion window and the encoded canonical position to one Gaussian's parameters."""

    def __init__(self, config: ModelConfig, *, dofs: int) -> None:
        super().__init__()
        inputs = 3 + 6 * OCTAVES + config.window * dofs
        layers: list[nn.Module] = [nn.Linear(inputs, WIDTH), nn.ReLU()]
        for _ in range(LAYERS - 2):
            layers += [nn.Linear(WIDTH, WIDTH), nn.ReLU()]
        for layer in layers:
            if isinstance(layer, nn.Linear):  # As the U-Nets start, or nothing of the input is left at the head.
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        head = nn.Linear(WIDTH, raw_channels(config))
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, head)

    def forward(self, inputs: Sequence[FrameInputs]) -> Float[Tensor, "b n o"]:
        """One Gaussian per row of the canonical positions."""
        return as_batch([self._decode(of_frame) for of_frame in inputs])

    def _decode(self, inputs: FrameInputs) -> Float[Tensor, "n o"]:
        position = encode(inputs.canonical)
        motion = inputs.motion.flatten().expand(len(position), -1)
        return self.layers(torch.cat([position, motion], 1))


def encode(positions: Float[Tensor, "n 3"], octaves: int = OCTAVES) -> Float[Tensor, "n e"]:
    """Positional encoding: metres, with sines and cosines of octaves from half a turn per metre up."""
    angles = (positions[..., None] * torch.pi * 2.0 ** torch.arange(octaves, device=positions.device)).flatten(1)
    return torch.cat([positions, angles.sin(), angles.cos()], 1)


class MlpAvatar(AshAvatar):
    """ASH with `MlpDecoder`."""

    @property
    def _precision(self) -> str:
        return decoding_precision(self.config.training.precision, self.device, WIDTH)

    def make_decoders(self, lattice: TexelLattice) -> nn.Module:
        """Stg. 3 without the texture space."""
        return MlpDecoder(self.config.model, dofs=self._motion.dofs.shape[1])


# The paper's row. In float32 it would take four times as long.
mlp = MethodFactory(config=named, build=MlpAvatar.from_capture).with_overrides({"training.precision": "bfloat16"})
mlp_base = mlp.with_overrides(ADDITIONS["base"])  # In place of the 2D decoders, on learned texels.
