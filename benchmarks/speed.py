"""How fast the kernels are beside their definitions, in one run: `ash-bench speed kernels`."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ash.gaussians import Gaussians
from ash.skinning import rotmat_to_unitquat

# Capsules of a standing person with spread arms, metres, y up: ends and radius.
BODY = (
    ((0.0, 0.85, 0.0), (0.0, 1.35, 0.0), 0.20),
    ((0.0, 1.58, 0.0), (0.0, 1.66, 0.0), 0.12),
    ((0.20, 1.38, 0.0), (0.62, 1.15, 0.05), 0.07),
    ((-0.20, 1.38, 0.0), (-0.62, 1.15, 0.05), 0.07),
    ((0.10, 0.80, 0.0), (0.17, 0.08, 0.0), 0.10),
    ((-0.10, 0.80, 0.0), (-0.17, 0.08, 0.0), 0.10),
)


@dataclass(frozen=True, kw_only=True)
class SplatScene:
    """Gaussians on the surface of a person who fills the image's height."""

    name: str
    gaussians: Gaussians
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int


def splat_scene(name: str, *, count: int, width: int, height: int, spread: float, fill: float) -> SplatScene:
    """`count` flat Gaussians of standard deviation `spread` (metres), the body `fill` image heights tall, SH of degree 3."""
    generator = torch.Generator().manual_seed(0)
    points, normals = _surface(count, generator)
    tangents = torch.linalg.cross(normals, torch.tensor([0.3, 0.5, 0.8]).expand_as(normals))
    frame = torch.stack([tangents / tangents.norm(dim=1, keepdim=True), torch.zeros_like(normals), normals], -1)
    frame[..., 1] = torch.linalg.cross(frame[..., 2], frame[..., 0])
    scales = spread * torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    scales[:, 2] *= 0.2
    sh = 0.2 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 1:] *= 0.3
    distance, tall = 3.0, 1.75
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = torch.tensor([0.0, 0.5 * tall, distance])
    focal = fill * height * distance / tall
    K = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    gaussians = Gaussians(
        means=points,
        quats=rotmat_to_unitquat(frame),
        scales=scales,
        opacities=0.05 + 0.45 * torch.rand(count, generator=generator),
        sh=sh,
    )
    return SplatScene(name=name, gaussians=gaussians, viewmats=viewmat[None], Ks=K[None], width=width, height=height)


def _surface(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points and outward normals, evenly over the body's surface."""
    starts, ends, radii = (torch.tensor([capsule[i] for capsule in BODY]) for i in range(3))
    lengths = (ends - starts).norm(dim=1)
    areas = 2 * math.pi * radii * (lengths + 2 * radii)
    part = torch.multinomial(areas, count, replacement=True, generator=generator)
    normals = torch.randn(count, 3, generator=generator)
    normals /= normals.norm(dim=1, keepdim=True)
    axis = (ends - starts)[part] / lengths[part, None]
    along = (torch.rand(count, generator=generator) * (lengths + 2 * radii)[part] - radii[part]).clamp_min(0)
    along = torch.minimum(along, lengths[part])
    on_side = (along > 0) & (along < lengths[part])
    side = normals - (normals * axis).sum(1, keepdim=True) * axis
    normals = torch.where(on_side[:, None], side / side.norm(dim=1, keepdim=True), normals)
    return starts[part] + along[:, None] * axis + radii[part, None] * normals, normals
