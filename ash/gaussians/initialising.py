"""Where the Gaussians start: texel-sized discs on the template, coloured by the training pixels that see them."""

import math

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ash.capture.dataset import Camera, Capture, Pose
from ash.config import ModelConfig
from ash.gaussians.gaussians import raw_channels
from ash.harmonics import SH_C0
from ash.mesh.rasterizing import project_vertices, rasterize_mesh
from ash.rotations import quat_conjugate, rotate, rotmat_to_unitquat
from ash.template.template import PosedTemplate, Template, vertex_normals
from ash.textures import FrameInputs, TexelLattice

DISC_SCALE = 0.6  # Standard deviation in texel pitches: neighbours overlap without blurring each other.
DISC_THICKNESS = 0.2
INITIAL_OPACITY = 0.9
COLOUR_FRAMES = 6
VISIBLE_WITHIN_M = 0.02


def blank_gaussians(config: ModelConfig, count: int, pitch: float) -> Float[Tensor, "n o"]:
    """Equal raw parameters for every texel: what a decoder without a base starts from.

    Grey, round, of one texel pitch (metres), opacity 0.1 (Kerbl et al.), no offset.
    """
    raw = torch.zeros(count, raw_channels(config))
    raw[:, 3:6] = math.log(DISC_SCALE * pitch)
    raw[:, 6] = 1.0
    raw[:, 10] = _logit(0.1)
    return raw


def initial_gaussians(
    config: ModelConfig, capture: Capture, template: Template, lattice: TexelLattice
) -> Float[Tensor, "n o"]:
    """Raw parameters of discs that lie on the canonical template, coloured from training images."""
    first = template.pose(Pose(capture.motion, capture.splits["train"].frames[0]))
    raw = blank_gaussians(config, len(lattice.texels), 1.0)
    pitch = texel_pitch(lattice, first.canonical)
    raw[:, 3:5] = (DISC_SCALE * pitch).log()[:, None]
    raw[:, 5] = (DISC_THICKNESS * DISC_SCALE * pitch).log()
    normals = vertex_normals(first.canonical, template.faces)
    raw[:, 6:10] = _quats_with_third_axis(torch.nn.functional.normalize(lattice.interpolate(normals), dim=-1))
    raw[:, 10] = _logit(INITIAL_OPACITY)
    raw[:, 11:14] = (mean_colours(capture, template, lattice) - 0.5) / SH_C0
    return raw


def released_gaussians(
    config: ModelConfig, analytic: Float[Tensor, "n o"], inputs: FrameInputs
) -> Float[Tensor, "n o"]:
    """What the release regresses its decoders to in a frame, before it renders: no fit, but a guess from the mesh.

    Colours as in `analytic`; round, as large as the three nearest posed texels are far (root mean square); turned from
    +x to the normal; opacity 0.1; no offset.
    """
    raw = torch.zeros_like(analytic)
    raw[:, 11:14] = analytic[:, 11:14]
    points = inputs.transforms.apply(inputs.canonical).cpu().numpy()
    near = torch.from_numpy(cKDTree(points).query(points, k=4)[0][:, 1:]).to(raw)
    raw[:, 3:6] = near.square().mean(1).sqrt().clamp(min=1e-4).log()[:, None]
    normals = inputs.normals
    if config.quat_frame == "canonical":
        normals = rotate(quat_conjugate(inputs.transforms.quats), normals)
    x, y, z = normals.unbind(1)
    turn = torch.stack([1 + x, torch.zeros_like(x), -z, y], 1)
    half_turn = raw.new_tensor([0.0, 0.0, 0.0, 1.0])
    raw[:, 6:10] = torch.nn.functional.normalize(torch.where(turn.norm(dim=1, keepdim=True) < 1e-3, half_turn, turn))
    raw[:, 10] = _logit(0.1)
    return raw


def texel_pitch(lattice: TexelLattice, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, " n"]:
    """Distance between neighbouring texels on the surface, metres: the root of a texel's share of its triangle."""
    a, b, c = vertices[lattice.corners].unbind(1)
    area = 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1)
    _, triangle, count = torch.unique(lattice.corners, dim=0, return_inverse=True, return_counts=True)
    per_texel = area / count[triangle]
    # Triangles smaller than a texel own one texel by chance; the median keeps the others from becoming dust.
    return per_texel.sqrt().clamp(min=0.5 * per_texel.sqrt().median(), max=2.0 * per_texel.sqrt().median())


def initial_texture(capture: Capture, template: Template, lattice: TexelLattice) -> Float[Tensor, "3 r r"]:
    """Mean training pixels as a texture; where no triangle lies, their mean."""
    colours = mean_colours(capture, template, lattice)
    return lattice.to_texture(colours - colours.mean(0)) + colours.mean(0)[:, None, None]


def mean_colours(capture: Capture, template: Template, lattice: TexelLattice) -> Float[Tensor, "n 3"]:
    """Mean training pixel of every texel, over a few frames and all training cameras that saw them.

    Views count by how squarely they see the texel. Texels that no camera sees take the mean colour of the others.
    """
    train = capture.splits["train"]
    frames = train.frames
    chosen = frames[:: max(1, len(frames) // COLOUR_FRAMES)]
    total = torch.zeros(len(lattice.texels), 3)
    weight = torch.zeros(len(lattice.texels), 1)
    for frame in chosen:
        posed = template.pose(Pose(capture.motion, frame))
        positions = lattice.interpolate(posed.vertices)
        normals = lattice.interpolate(posed.normals)
        for name in train.seeing(frame):
            camera = capture.cameras[name]
            image = torch.from_numpy(capture.image(name, frame)).float() / 255
            pixels, facing = visible_pixels(camera, posed, template, positions, normals)
            weights = facing[:, None] * image[pixels[:, 1], pixels[:, 0], 3:]
            total += weights * image[pixels[:, 1], pixels[:, 0], :3]
            weight += weights
    fallback = total.sum(0) / weight.sum().clamp(min=1e-6)
    return torch.where(weight > 0.05, total / weight.clamp(min=1e-6), fallback)


def visible_pixels(
    camera: Camera, posed: PosedTemplate, template: Template, positions: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixel (x, y) `[n, 2]` of each surface point, and the cosine at which it is seen `[n]`, 0 where it is hidden."""
    viewmat, K = torch.from_numpy(camera.viewmat).float(), torch.from_numpy(camera.K).float()
    drawn = rasterize_mesh(
        project_vertices(posed.vertices, viewmat, K), template.faces, width=camera.width, height=camera.height
    )
    projected = project_vertices(positions, viewmat, K)
    pixels = (projected[:, :2] / projected[:, 2:]).floor().long()
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    pixels = pixels.clamp(min=torch.zeros(2, dtype=torch.long), max=size - 1)
    surface = drawn.depth[pixels[:, 1], pixels[:, 0]]
    visible = (
        inside & (drawn.triangle[pixels[:, 1], pixels[:, 0]] >= 0) & (projected[:, 2] < surface + VISIBLE_WITHIN_M)
    )
    towards = torch.nn.functional.normalize(torch.from_numpy(camera.position).float() - positions, dim=-1)
    return pixels, (towards * normals).sum(-1).clamp(min=0) * visible


def _quats_with_third_axis(axis: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    helper = torch.eye(3)[axis.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, axis), dim=-1)
    return rotmat_to_unitquat(torch.stack([first, torch.linalg.cross(axis, first), axis], dim=-1))


def _logit(p: float) -> float:
    return math.log(p / (1 - p))
