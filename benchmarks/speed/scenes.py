"""What the kernels are timed on: a person made of capsules, as Gaussians on its surface and as a mesh."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ash.gaussians.gaussians import Gaussians
from ash.mesh.rasterizing import project_vertices
from ash.rotations import rotmat_to_unitquat

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

    @property
    def cameras(self) -> dict[str, Any]:
        """As the splatter takes them."""
        return {"viewmats": self.viewmats, "Ks": self.Ks, "width": self.width, "height": self.height}


# Gaussians, width, height, their standard deviation in metres, and how many image heights the body is tall. P covers
# 20 % of its pixels with 50 contributing splats each, S 23 % with 43.
SIZES = {"S": (3_000, 256, 256, 0.034, 0.68), "P": (40_000, 1285, 940, 0.0080, 0.98)}


def splat_scene(name: str) -> SplatScene:
    """Flat Gaussians of many opacities on the body, spherical harmonics of degree 3, seen from 3 m."""
    count, width, height, spread, fill = SIZES[name]
    generator = torch.Generator().manual_seed(0)
    points, normals = _surface(count, generator)
    tangents = torch.linalg.cross(normals, torch.tensor([0.3, 0.5, 0.8]).expand_as(normals))
    frame = torch.stack([tangents / tangents.norm(dim=1, keepdim=True), torch.zeros_like(normals), normals], -1)
    frame[..., 1] = torch.linalg.cross(frame[..., 2], frame[..., 0])
    scales = spread * torch.exp(0.3 * torch.randn(count, 3, generator=generator))
    scales[:, 2] *= 0.2
    sh = 0.2 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 1:] *= 0.3
    viewmat, K = _camera(width, height, fill)
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


def _camera(width: int, height: int, fill: float) -> tuple[Tensor, Tensor]:
    distance, tall = 3.0, 1.75
    viewmat = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    viewmat[:3, 3] = torch.tensor([0.0, 0.5 * tall, distance])
    focal = fill * height * distance / tall
    return viewmat, torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])


def body_mesh(pixels: int) -> tuple[Tensor, Tensor]:
    """The body as triangles, 1,344 of them, projected into a square image: homogeneous pixels and faces."""
    rings, sectors = 8, 14
    angle = torch.linspace(0, 2 * math.pi, sectors + 1)[:-1]
    vertices: list[Tensor] = []
    faces: list[list[int]] = []
    for start, end, radius in BODY:
        a, b = torch.tensor(start), torch.tensor(end)
        axis = (b - a) / (b - a).norm()
        side = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0]))
        side = side / side.norm()
        around = torch.cos(angle)[:, None] * side + torch.sin(angle)[:, None] * torch.linalg.cross(axis, side)
        base = sum(len(part) for part in vertices)
        for i in range(rings + 1):
            vertices.append(a + (i / rings) * (b - a) + radius * around)
        for i in range(rings):
            for j in range(sectors):
                p, q = base + i * sectors + j, base + i * sectors + (j + 1) % sectors
                faces += [[p, q, p + sectors], [q, q + sectors, p + sectors]]
    viewmat, K = _camera(pixels, pixels, 0.9)
    return project_vertices(torch.cat(vertices), viewmat, K), torch.tensor(faces)
