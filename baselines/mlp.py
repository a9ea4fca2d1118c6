"""The paper's ablation w/ MLP: Gaussian parameters straight from 3D, without the texture space (ASH appendix B)."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.config import ModelConfig
from ash.dataset import Capture
from ash.decoders import raw_channels
from ash.method import AshAvatar
from ash.presets import named
from ash.textures import Conditions

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
        head = nn.Linear(WIDTH, raw_channels(config))
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, head)

    def forward(self, conditions: Conditions) -> Float[Tensor, "n o"]:
        """One Gaussian per row of the canonical positions."""
        position = encode(conditions.canonical)
        motion = conditions.motion.flatten().expand(len(position), -1)
        return self.layers(torch.cat([position, motion], 1))


def encode(positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n e"]:
    """Positional encoding: metres, with sines and cosines of octaves from half a turn per metre up."""
    angles = (positions[..., None] * torch.pi * 2.0 ** torch.arange(OCTAVES)).flatten(1)
    return torch.cat([positions, angles.sin(), angles.cos()], 1)


def mlp(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """ASH with the MLP in place of its 2D decoders; everything else as the preset says."""
    config = replace(named(preset), seed=seed)
    dofs = capture.motion.dofs.shape[1]
    return AshAvatar(config, capture, make_decoders=lambda model, _: MlpDecoder(model, dofs=dofs))
