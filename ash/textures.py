"""Stg.2: the texel lattice and the motion-aware textures (ASH Sec. 3.2, Eq. 4)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ash.capture.dataset import Motion, Pose, TemplateMesh
from ash.config import AtlasConfig
from ash.devices import MovingModule
from ash.files import InputError
from ash.mesh.rasterizing import rasterize_mesh
from ash.rotations import (
    RigidTransforms,
    root_yaw,
    unitquat_to_rotmat,
)
from ash.template.motion import about_y
from ash.template.skinning import blend_transforms
from ash.template.template import Template

NOISE_GRID = 4
BOUND = 3.0  # Spreads at which standardised textures are cut off: what lies farther out was hardly ever learned from.


@dataclass(frozen=True, kw_only=True, slots=True)
class TexelLattice:
    """The texels that a triangle covers, in row-major order; each is one Gaussian.

    Texel (row, column) samples the atlas at u = (column + 0.5) / resolution, v = 1 - (row + 0.5) / resolution, like
    an image whose first row is the top. (The release samples texel corners of the transposed array.)
    """

    resolution: int
    texels: Int[Tensor, " n"]  # row * resolution + column
    corners: Int[Tensor, "n 3"]  # vertices of the covering triangle
    barycentric: Float[Tensor, "n 3"]  # weights (w_a, w_b, w_c) of Eq. 4

    def interpolate(self, values: Float[Tensor, "v c"]) -> Float[Tensor, "n c"]:
        """Eq. 4 for any per-vertex quantity."""
        weights = self.barycentric.to(values)
        return nn.functional.embedding_bag(self.corners, values, per_sample_weights=weights, mode="sum")

    def interpolate_transforms(self, transforms: RigidTransforms) -> RigidTransforms:
        """Per-texel transform T of Eq. 5: the transforms of the three corners, blended."""
        return blend_transforms(transforms, self.corners, self.barycentric.to(transforms.quats))

    def to_texture(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "c r r"]:
        """Scatter per-texel values into a texture that is zero elsewhere."""
        texture = values.new_zeros(self.resolution * self.resolution, values.shape[1])
        texture[self.texels] = values
        return texture.T.reshape(-1, self.resolution, self.resolution)


def build_lattice(mesh: TemplateMesh, resolution: int) -> TexelLattice:
    """Find the triangle and barycentric weights of every covered texel.

    Raises:
        InputError: the atlas covers no texel at this resolution.
    """
    uvs = torch.from_numpy(mesh.uvs)
    pixels = torch.stack([uvs[:, 0] * resolution, (1 - uvs[:, 1]) * resolution, torch.ones_like(uvs[:, 0])], -1)
    drawn = rasterize_mesh(pixels, torch.from_numpy(mesh.uv_faces), width=resolution, height=resolution)
    texels = (drawn.triangle.reshape(-1) >= 0).nonzero().squeeze(1)
    if len(texels) == 0:
        raise InputError(f"the template's atlas covers no texel at resolution {resolution}")
    triangles = drawn.triangle.reshape(-1)[texels].long()
    return TexelLattice(
        resolution=resolution,
        texels=texels,
        corners=torch.from_numpy(mesh.faces)[triangles],
        barycentric=drawn.barycentric.reshape(-1, 3)[texels].float(),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class DecoderInputs:
    """What U-Nets see of one frame; nothing in it is learned with the avatar."""

    textures: Float[Tensor, "c r r"]  # motion-aware textures
    root_translation: Float[Tensor, " 3"]  # metres


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameInputs(DecoderInputs):
    """What Stg.1 and Stg.2 hand to the decoders for one frame."""

    motion: Float[Tensor, "k d"]  # the normalised motion window, newest frame first
    canonical: Float[Tensor, "n 3"]  # texel positions on the canonical template, Eq. 4
    normals: Float[Tensor, "n 3"]  # unit, world
    transforms: RigidTransforms  # texel-wise T of Eq. 5


Inputs = TypeVar("Inputs", bound=DecoderInputs)


@torch.no_grad()
def motion_aware_textures(
    template: Template, lattice: TexelLattice, pose: Pose, *, window: int, yaw_normalise: bool
) -> Float[Tensor, "c r r"]:
    """Normal and position textures of a window of frames, newest first: `c = 6 window` channels.

    Positions (metres) are relative to the root of the newest frame, so the textures do not change when the whole
    motion is moved; with `yaw_normalise` they do not change either when it is turned about the vertical axis.
    """
    dofs = torch.from_numpy(pose.dofs).float().to(template.device)
    root = dofs[:3] + torch.from_numpy(template.skeleton.heads[0]).float().to(template.device)
    posed = [template.pose(Pose(pose.motion, int(past))) for past in pose.window(window)]
    vectors = torch.stack([v for p in posed for v in (p.normals, p.vertices - root)], 1)
    # Interpolated first and turned then: a texture has fewer texels than the mesh has vertices.
    texels = lattice.interpolate(vectors.flatten(1)).unflatten(1, (-1, 3))
    if yaw_normalise:
        texels = texels @ unitquat_to_rotmat(about_y(root_yaw(dofs)))  # x R = R^T x: turned back
    return lattice.to_texture(texels.flatten(1))


@torch.no_grad()
def texture_statistics(
    textures: Iterable[Float[Tensor, "c r r"]],
) -> tuple[Float[Tensor, "c r r"], Float[Tensor, "c 1 1"]]:
    """Mean texture over frames, and per channel the standard deviation from it over frames and covered texels.

    A body's positions differ by a metre between texels and by centimetres between frames; only the latter is motion.
    Frames are taken one by one: memory does not grow with them.
    """
    count, total, squares = 0, torch.zeros(()), torch.zeros(())
    for texture in textures:
        exact = texture.double()
        count, total, squares = count + 1, total + exact, squares + exact.square()
    mean = total / count
    covered = (mean != 0).any(0)
    variance = (squares / count - mean.square())[:, covered].mean(1).clamp(min=0)
    return mean.float(), variance.sqrt().float().clamp(min=1e-3)[:, None, None]


def add_texture_noise(
    textures: Float[Tensor, "c r r"], sigma: float, *, seed: int, step: int
) -> Float[Tensor, "c r r"]:
    """Standardised textures with other noise in every step that learns: who sees it relies less on exact poses."""
    if sigma == 0 or not torch.is_grad_enabled():
        return textures
    return textures + sigma * smooth_noise(textures.shape, (seed, 3, step)).to(textures.device)


def add_texture_noise_to_frames(frames: Sequence[Inputs], sigma: float, *, seed: int, step: int) -> list[Inputs]:
    """`add_texture_noise` for the frames of a step, each with the noise that it would have in a step of its own."""
    own_steps = range(step * len(frames), (step + 1) * len(frames))
    return [
        replace(frame, textures=add_texture_noise(frame.textures, sigma, seed=seed, step=own))
        for frame, own in zip(frames, own_steps, strict=True)
    ]


def smooth_noise(shape: torch.Size, seed: tuple[int, ...]) -> Float[Tensor, "c h w"]:
    """Normal numbers on a coarse grid, linear between them: what varies over a body, not over its texels."""
    coarse = np.random.default_rng(seed).standard_normal((1, shape[0], NOISE_GRID, NOISE_GRID), np.float32)
    grid = torch.from_numpy(coarse)
    return nn.functional.interpolate(grid, size=shape[1:], mode="bilinear", align_corners=True)[0]


class TextureDrawer(MovingModule):
    """Stg.2 as a network sees it: the motion-aware textures of a frame, standardised if asked.

    What is standardised is a deviation from the mean training texture, in units of its channel's spread, cut
    off at `BOUND` of them (not in the paper). Mean and spread are part of a checkpoint.
    """

    def __init__(
        self,
        lattice: TexelLattice,
        *,
        window: int,
        yaw_normalise: bool,
        standardise: bool,
    ) -> None:
        super().__init__()
        self.lattice, self.window, self.yaw_normalise, self.standardise = lattice, window, yaw_normalise, standardise
        self.mean: Tensor
        self.spread: Tensor
        if standardise:
            self.register_buffer("mean", torch.zeros(6 * window, lattice.resolution, lattice.resolution))
            self.register_buffer("spread", torch.ones(6 * window, 1, 1))

    @classmethod
    def of(cls, config: AtlasConfig, lattice: TexelLattice) -> "TextureDrawer":
        """As a configuration has them, on the lattice that is decoded."""
        seen = {"yaw_normalise": config.yaw_normalise, "standardise": config.standardise}
        return cls(lattice, window=config.window, **seen)

    def fit_normalization(self, template: Template, motion: Motion, frames: tuple[int, ...]) -> None:
        """Take mean and spread from the frames of a training motion."""
        if self.standardise:
            self.mean, self.spread = texture_statistics(self._draw(template, Pose(motion, frame)) for frame in frames)

    def forward(self, template: Template, pose: Pose) -> Float[Tensor, "c r r"]:
        """The textures of a frame, `c = 6 window` channels."""
        textures = self._draw(template, pose)
        if not self.standardise:
            return textures
        return ((textures - self.mean) / self.spread).clamp(-BOUND, BOUND)

    def _draw(self, template: Template, pose: Pose) -> Float[Tensor, "c r r"]:
        return motion_aware_textures(template, self.lattice, pose, window=self.window, yaw_normalise=self.yaw_normalise)
