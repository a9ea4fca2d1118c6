"""A head without images: local low-rank blendshapes in place of Stg.3's U-Nets. Not in the paper.

After SqueezeMe (Iandola et al. 2025) and Pruned Local Blendshapes (2026): each body region owns a few linear
correctives of its Gaussians, weighted by a linear map of the motion nearby.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.config import ModelConfig
from ash.gaussians.gaussians import raw_channels
from ash.template.skinning import near_joints, sparse_skin_weights
from ash.template.template import Template
from ash.textures import Conditions, TexelLattice


class LocalBlendshapes(nn.Module):
    """Raw parameters = sum over correctives of (weight by region and motion) times (a learned texel map)."""

    def __init__(self, config: ModelConfig, lattice: TexelLattice, template: Template) -> None:
        super().__init__()
        skin = sparse_skin_weights(lattice.interpolate(torch.from_numpy(template.mesh.skin_weights).float()))
        joints = len(template.skeleton.names)
        self.regions: Tensor
        self.shares: Tensor
        self.near: Tensor
        self.mean: Tensor
        self.spread: Tensor
        self.register_buffer("regions", skin.joints, persistent=False)
        self.register_buffer("shares", skin.weights, persistent=False)
        self.register_buffer("near", near_joints(template.skeleton), persistent=False)
        self.register_buffer("mean", torch.zeros(joints, config.window * 3))
        self.register_buffer("spread", torch.ones(joints, config.window * 3))
        features = config.window * 3
        self.weights = nn.Parameter(torch.randn(joints, joints, features, config.rank) / features**0.5)
        self.shapes = nn.Parameter(torch.zeros(len(lattice.texels), config.rank, raw_channels(config)))

    def observe(self, motions: list[Float[Tensor, "k d"]]) -> None:
        """Take the mean and spread of every joint's angles from training frames."""
        seen = torch.stack([self._angles(motion) for motion in motions])
        self.mean, self.spread = seen.mean(0), seen.std(0, correction=0).clamp(min=0.02)

    def forward(self, conditions: Conditions) -> Float[Tensor, "n o"]:
        """Decode one frame."""
        return (self.shapes * self.coefficients(conditions.motion)[..., None]).sum(1)

    def coefficients(self, motion: Float[Tensor, "k d"]) -> Float[Tensor, "n p"]:
        """Weights of every texel's correctives: those of the joints that move it, in the proportions of its skin."""
        standardised = (self._angles(motion) - self.mean) / self.spread
        linear = torch.einsum("ij,ijfp,jf->ip", self.near.to(standardised), self.weights, standardised)
        # Bounded: beyond the training motion, correctives stop where they last were seen.
        bounded = torch.tanh(linear)
        return nn.functional.embedding_bag(self.regions, bounded, per_sample_weights=self.shares, mode="sum")

    def _angles(self, motion: Float[Tensor, "k d"]) -> Float[Tensor, "j f"]:
        return motion[:, 3:].unflatten(1, (-1, 3)).transpose(0, 1).flatten(1)
