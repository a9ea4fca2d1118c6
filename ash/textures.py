"""Stg.2: the texel lattice and the motion-aware textures (ASH Sec. 3.2, Eq. 4)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ash.dataset import Motion, TemplateMesh
from ash.files import InputError
from ash.rasterizing import rasterize_mesh
from ash.skinning import (
    RigidTransforms,
    quat_multiply,
    root_yaw,
    rotate,
    rotvec_to_unitquat,
    unitquat_to_rotmat,
    unitquat_to_rotvec,
)
from ash.template import Template

NOISE_GRID = 4
BOUND = 3.0  # Of standardised textures: what lies farther out was hardly ever learned from, or never.


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
        return self._blend(values, self.barycentric)

    def interpolate_transforms(self, transforms: RigidTransforms) -> RigidTransforms:
        """Per-texel transform T of Eq. 5: the dual quaternions of the three corners, blended.

        Signs are aligned with the corner of the largest weight, as in skinning.
        """
        # The dual part of (q, t) is t q / 2; blending it and multiplying by the conjugate of the blend gives the
        # translation.
        dual = torch.cat([transforms.quats, dual_parts(transforms.quats, transforms.translations)], -1)
        blended = self._blend(dual, self._aligned_weights(transforms.quats))
        blended = blended / blended[:, :4].norm(dim=-1, keepdim=True)
        return RigidTransforms(quats=blended[:, :4], translations=_translation(blended[:, :4], blended[:, 4:]))

    def _blend(self, values: Float[Tensor, "v c"], weights: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        # A bag is a gather and a weighted sum in one: ten times as fast as the two in turn.
        return nn.functional.embedding_bag(self.corners, values, per_sample_weights=weights.to(values), mode="sum")

    def _aligned_weights(self, quats: Float[Tensor, "v 4"]) -> Float[Tensor, "n 3"]:
        """Barycentric weights, negative for a corner whose quaternion lies in the other hemisphere."""
        corners = quats[self.corners]
        strongest = self.barycentric.argmax(1)[:, None, None].expand(-1, 1, 4)
        opposite = (corners * corners.gather(1, strongest)).sum(-1) < 0
        return torch.where(opposite, -self.barycentric, self.barycentric)

    def to_texture(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "c r r"]:
        """Scatter per-texel values into a texture that is zero elsewhere."""
        texture = values.new_zeros(self.resolution * self.resolution, values.shape[1])
        texture[self.texels] = values
        return texture.T.reshape(-1, self.resolution, self.resolution)

    def from_texture(self, texture: Float[Tensor, "c r r"]) -> Float[Tensor, "n c"]:
        """Gather the covered texels."""
        return texture.flatten(1).T[self.texels]


def dual_parts(quats: Float[Tensor, "n 4"], translations: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Dual part t q / 2 of each rigid transform as a dual quaternion (q, t q / 2)."""
    w, u = quats[..., :1], quats[..., 1:]
    real = -(translations * u).sum(-1, keepdim=True)
    return 0.5 * torch.cat([real, w * translations + torch.linalg.cross(translations, u)], -1)


def _translation(real: Float[Tensor, "n 4"], dual: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    w, u = real[..., :1], real[..., 1:]
    dw, du = dual[..., :1], dual[..., 1:]
    return 2 * (w * du - dw * u - torch.linalg.cross(du, u))


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
class Conditions:
    """What Stg.1 and Stg.2 hand to the decoders for one frame; nothing in it is learned with the avatar."""

    textures: Float[Tensor, "c r r"]  # motion-aware textures
    motion: Float[Tensor, "k d"]  # the normalised motion window, newest frame first
    root_translation: Float[Tensor, " 3"]  # metres
    canonical: Float[Tensor, "n 3"]  # texel positions on the canonical template, Eq. 4
    normals: Float[Tensor, "n 3"]  # unit, world
    transforms: RigidTransforms  # texel-wise T of Eq. 5


@torch.no_grad()
def normalised_motion(motion: Motion, frame: int, *, window: int) -> Float[Tensor, "k d"]:
    """Degrees of freedom of a window of frames, newest first, without where the newest stands and faces (ASH Sec. 3.1).

    Root translations become R_y(-yaw) (t_k - t_f), and root rotations are turned by -yaw, as in the release.
    """
    dofs = torch.from_numpy(motion.dofs[motion.window(frame, window)])
    yaw = root_yaw(dofs[0])
    unturn = _about_y(-yaw).expand(len(dofs), 4)
    translation = rotate(unturn, dofs[:, :3] - dofs[0, :3])
    root = quat_multiply(unturn, rotvec_to_unitquat(dofs[:, 3:6]))
    return torch.cat([translation, unitquat_to_rotvec(root), dofs[:, 6:]], dim=1).float()


@torch.no_grad()
def motion_aware_textures(
    template: Template, lattice: TexelLattice, motion: Motion, frame: int, *, window: int, yaw_normalise: bool
) -> Float[Tensor, "c r r"]:
    """Normal and position textures of a window of frames, newest first: `c = 6 window` channels.

    Positions (metres) are relative to the root of the newest frame, so the textures do not change when the whole
    motion is moved; with `yaw_normalise` they do not change either when it is turned about the vertical axis.
    """
    dofs = torch.from_numpy(motion.dofs[frame]).float()
    root = dofs[:3] + torch.from_numpy(template.skeleton.heads[0]).float()
    posed = [template.pose(motion, int(past)) for past in motion.window(frame, window)]
    vectors = torch.stack([v for p in posed for v in (p.normals, p.vertices - root)], 1)
    # Interpolated first and turned then: a texture has fewer texels than the mesh has vertices.
    texels = lattice.interpolate(vectors.flatten(1)).unflatten(1, (-1, 3))
    if yaw_normalise:
        texels = texels @ unitquat_to_rotmat(_about_y(root_yaw(dofs)))  # x R = R^T x: turned back
    return lattice.to_texture(texels.flatten(1))


@torch.no_grad()
def texture_statistics(textures: list[Float[Tensor, "c r r"]]) -> tuple[Float[Tensor, "c r r"], Float[Tensor, "c 1 1"]]:
    """Mean texture over frames, and per channel the standard deviation from it over frames and covered texels.

    A body's positions differ by a metre between texels and by centimetres between frames; only the latter is motion.
    """
    mean = torch.stack(textures).mean(0)
    covered = (mean != 0).any(0)
    deviations = torch.stack([(texture - mean)[:, covered] for texture in textures])
    return mean, deviations.square().mean((0, 2)).sqrt().clamp(min=1e-3)[:, None, None]


def unsettled(textures: Float[Tensor, "c r r"], sigma: float, *, seed: int, step: int) -> Float[Tensor, "c r r"]:
    """Standardised textures with other noise in every step that learns: who sees it relies less on exact poses."""
    if sigma == 0 or not torch.is_grad_enabled():
        return textures
    return textures + sigma * smooth_noise(textures.shape, (seed, 3, step))


def smooth_noise(shape: torch.Size, seed: tuple[int, ...]) -> Float[Tensor, "c h w"]:
    """Normal numbers on a coarse grid, linear between them: what varies over a body, not over its texels."""
    coarse = np.random.default_rng(seed).standard_normal((1, shape[0], NOISE_GRID, NOISE_GRID), np.float32)
    grid = torch.from_numpy(coarse)
    return nn.functional.interpolate(grid, size=shape[1:], mode="bilinear", align_corners=True)[0]


class TextureDrawer(nn.Module):
    """Stg.2 as a network sees it: the motion-aware textures of a frame, standardised if asked.

    What is standardised is a deviation from the mean training texture, in units of its channel's spread, at most three
    of them (not in the paper). Mean and spread are part of a checkpoint.
    """

    def __init__(self, lattice: TexelLattice, *, window: int, yaw_normalise: bool, standardise: bool) -> None:
        super().__init__()
        self.lattice, self.window, self.yaw_normalise, self.standardise = lattice, window, yaw_normalise, standardise
        self.mean: Tensor
        self.spread: Tensor
        if standardise:
            self.register_buffer("mean", torch.zeros(6 * window, lattice.resolution, lattice.resolution))
            self.register_buffer("spread", torch.ones(6 * window, 1, 1))

    def observe(self, template: Template, motion: Motion, frames: tuple[int, ...]) -> None:
        """Take mean and spread from the frames of a training motion."""
        if self.standardise:
            self.mean, self.spread = texture_statistics([self._draw(template, motion, frame) for frame in frames])

    def forward(self, template: Template, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        """The textures of a frame, `c = 6 window` channels."""
        textures = self._draw(template, motion, frame)
        return ((textures - self.mean) / self.spread).clamp(-BOUND, BOUND) if self.standardise else textures

    def _draw(self, template: Template, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        return motion_aware_textures(
            template, self.lattice, motion, frame, window=self.window, yaw_normalise=self.yaw_normalise
        )


def _about_y(angle: Float[Tensor, ""]) -> Float[Tensor, " 4"]:
    zero = torch.zeros_like(angle)
    return rotvec_to_unitquat(torch.stack([zero, angle, zero]))
