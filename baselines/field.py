"""The paper's offline competitors: one volume-rendered avatar, three rows. START with `march`, then the two fields.

A field gives density (per metre) and colour at points of the world. `march` integrates it along rays, but only in the
shell of a posed surface, which a grid of cells holds (`ShellGrid`). Two fields:

- `ForwardField` (row `tava`): in a rest pose, to which the points of a posed frame are brought by searching the root
  of forward skinning. Li et al., "TAVA: Template-free Animatable Volumetric Actors" (ECCV 2022).
- `ShellField` (rows `neural_actor`, `hdhumans`): around a posed mesh, with features of a texture that is predicted from
  the motion. Liu et al., "Neural Actor" (SIGGRAPH Asia 2021); Habermann et al., "HDHumans" (SCA 2023).

Formulas are those of the publications. The docstrings of the rows, at the end, say what differs.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ash.capture.dataset import Camera, Capture, Pose, Skeleton
from ash.capture.formats import read_body
from ash.config import AtlasConfig, TemplateConfig, TrainingConfig, check_device, one_of
from ash.decoders import GLOBAL_FEATURES, GlobalFeatures, UNet, batched_inputs
from ash.devices import MovingModule, moved
from ash.files import InputError
from ash.mesh.drawing import blend, sample_texture
from ash.model import stage
from ash.presets import MethodFactory, named
from ash.protocol import StageClock
from ash.rotations import unitquat_to_rotmat
from ash.template.skinning import blend_transforms, forward_kinematics
from ash.template.template import PosedTemplate, Template, vertex_normals
from ash.template_learning.nearest import NearestPoint, nearest_naive
from ash.template_learning.refining import Refinement
from ash.textures import DecoderInputs, TextureDrawer, build_lattice
from ash.trained_avatar import TrainedAvatar
from ash.training.adam import Adam
from ash.training.batches import Batch, over
from ash.training.images import TrainingImages
from baselines.mlp import encode

BINS = 128  # Along a ray through the grid's box: which of them lie in the shell is looked up, and samples go there.
CELL_M = 0.025  # Of the grid.
PER_METRE = 100.0  # Density of softplus(logit) = 1: a centimetre lets 1/e of the light through.
SOFTNESS_M = 0.005  # A density that starts as a template: a logit of 1 so far inside.
OPAQUE = 1e-3  # Where less light is left, drawing ends.
BLOCK = 8  # Samples of a ray that are drawn at once.
RAYS_AT_ONCE = 4096  # When drawing.
TRIED = 3  # Rays drawn per ray wanted, in training: those that miss the shell teach nothing.
RING = 8  # Triangles around a vertex that are looked at.
FAR_M = 1e3  # Where points are put that do not count.
ROOT_M = 2e-3  # What may be left of a root's error: then a step of Newton's method follows.
BONE_WEIGHT, OFFSET_WEIGHT = 0.1, 0.1  # Of TAVA's terms beside the colour.
SKIN_OCTAVES = 3  # Skinning weights, offset and shading are smooth.
SOLID = 0.05  # A skinning whose Jacobian has a smaller determinant has folded over: no root.

# Points [m, 3] of the world, metres, and unit directions of sight [m, 3] to density [m], per metre, and rgb [m, 3].
Field = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True, kw_only=True, slots=True)
class VolumeConfig:
    """The field, and how it is integrated."""

    kind: str  # "forward": a rest pose, found by root finding; "shell": around a posed mesh
    surface: str  # around which samples lie: "template", or "body", the fitted body without clothes
    shell_m: float  # how far from it, to both sides
    samples: int  # of a ray
    rays: int  # of a step
    width: int  # of the density's MLP
    layers: int  # of it
    octaves: int  # of the position's code, from half a turn per metre up
    side_width: int  # of the other MLPs: skinning weights and offset; residual
    side_layers: int
    channels: int = 16  # of the predicted texture; 0: no texture
    residual_m: float = 0.02  # at most, by which a shell's points are moved
    candidates: int = 3  # nearest bones from which roots are searched
    root_steps: int = 8  # of Broyden's method; 0: no search, a point follows its nearest bone
    warmup_steps: int = 150  # a field starts as its template, skinning weights as those of the nearest bone
    pull_every: int = 0  # steps, of which one pulls the template to the field's surface; 0: it stays

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        one_of("field kind", self.kind, ("forward", "shell"))
        one_of("field surface", self.surface, ("template", "body"))
        sizes = (self.samples, self.rays, self.width, self.layers, self.octaves, self.side_width, self.side_layers)
        if min(*sizes, self.candidates) < 1 or not 0 < self.shell_m < 1:
            raise InputError("field: sizes and counts must be at least 1, shell_m more than 0 and less than 1 m")
        if min(self.channels, self.root_steps, self.warmup_steps, self.pull_every) < 0 or self.pull_every == 1:
            raise InputError("field: nothing may be negative, and pull_every is 0 or at least 2: the field learns, too")


@dataclass(frozen=True, kw_only=True, slots=True)
class FieldConfig:
    """A row. Of `training`, the weights of L1 and SSIM have no part: single rays have no windows."""

    field: VolumeConfig
    model: AtlasConfig  # of the U-Net that predicts the texture
    training: TrainingConfig
    template: TemplateConfig
    seed: int = 0
    device: str = "cpu"  # or "cuda", "cuda:1": where it learns and draws

    def __post_init__(self) -> None:
        check_device(self.device)
        self.training.check_norm(self.model.norm)


# ---- the renderer


@dataclass(frozen=True, kw_only=True, slots=True)
class Rays:
    """Rays of sight in the world; directions are unit, so that lengths along them are metres."""

    origins: Float[Tensor, "r 3"]
    directions: Float[Tensor, "r 3"]

    def __getitem__(self, rows: Tensor | slice) -> "Rays":
        return Rays(origins=self.origins[rows], directions=self.directions[rows])

    def at(self, lengths: Float[Tensor, "r n"]) -> Float[Tensor, "r n 3"]:
        """Points along them."""
        return self.origins[:, None] + lengths[..., None] * self.directions[:, None]


def rays_of(camera: Camera, pixels: Int[Tensor, " r"]) -> Rays:
    """Rays through the centres of pixels, row-major numbers."""
    viewmat = torch.from_numpy(camera.viewmat).float().to(pixels.device)
    inverse = torch.from_numpy(np.linalg.inv(camera.K)).float().to(pixels.device)
    column, row = (pixels % camera.width + 0.5).float(), (pixels // camera.width + 0.5).float()
    seen = torch.stack([column, row, torch.ones_like(row)], -1) @ inverse.T @ viewmat[:3, :3]
    origin = -viewmat[:3, 3] @ viewmat[:3, :3]
    return Rays(origins=origin.expand(len(pixels), 3), directions=nn.functional.normalize(seen, dim=-1))


@dataclass(frozen=True, kw_only=True, slots=True)
class ShellGrid:
    """Cells of a cube of space that are near a surface: the only ones in which a field is asked for anything."""

    low: Float[Tensor, " 3"]  # corner of the cube, metres
    near: Bool[Tensor, "x y z"]
    box: tuple[Tensor, Tensor]  # lowest and highest corner of what is near

    def contains(self, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Whether points lie in a cell that is near the surface."""
        side = len(self.near)
        x, y, z = ((points - self.low) / CELL_M).long().clamp(0, side - 1).unbind(-1)
        return self.near.reshape(-1)[(x * side + y) * side + z]


def build_shell_grid(points: Float[Tensor, "v 3"], *, reach_m: float, extent_m: float) -> ShellGrid:
    """The cells within `reach_m` of the points along every axis, in a cube of `extent_m` around them.

    Not more than `reach_m` and two cells away; a cell in reach is never left out while the points fit the cube.
    """
    side, steps = math.ceil(extent_m / CELL_M) + 2, math.ceil(reach_m / CELL_M)
    lowest, highest = points.amin(0) - reach_m, points.amax(0) + reach_m
    low = 0.5 * (lowest + highest) - 0.5 * side * CELL_M
    x, y, z = ((points - low) / CELL_M).long().clamp(0, side - 1).unbind(-1)
    hit = torch.zeros(side**3, dtype=torch.bool, device=points.device)
    near = hit.index_fill(0, (x * side + y) * side + z, True).reshape(side, side, side)
    for axis in range(3):  # A box is the same along one axis after the other.
        before = near.clone()
        for far in range(1, min(steps, side - 1) + 1):
            near.narrow(axis, far, side - far).logical_or_(before.narrow(axis, 0, side - far))
            near.narrow(axis, 0, side - far).logical_or_(before.narrow(axis, far, side - far))
    return ShellGrid(low=low, near=near, box=(lowest, highest))


@dataclass(frozen=True, kw_only=True, slots=True)
class Stretches:
    """What of each ray lies in the shell, as equal bins of it."""

    start: Float[Tensor, " r"]  # of the first bin, metres
    step: Float[Tensor, " r"]  # length of a bin
    before: Float[Tensor, "r b"]  # bins in the shell, up to and with each
    length: Float[Tensor, " r"]  # of all that lies in the shell

    def place(self, share: Float[Tensor, "r n"]) -> Float[Tensor, "r n"]:
        """Lengths along the rays at shares (0..1) of what lies in the shell, nearest first."""
        wanted = share * self.before[:, -1:]
        bin_ = torch.searchsorted(self.before, wanted, right=True).clamp(max=self.before.shape[1] - 1)
        rest = wanted - self.before.gather(1, bin_) + 1  # within its bin, in which the count rises by 1
        return self.start[:, None] + (bin_ + rest.clamp(0, 1)) * self.step[:, None]


@torch.no_grad()
def stretches_in(grid: ShellGrid, rays: Rays, bins: int = BINS) -> Stretches:
    """Find what of each ray lies in the shell; of bins that reach across its border, all or nothing."""
    slope = 1 / torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    one, other = ((corner - rays.origins) * slope for corner in grid.box)
    start = torch.minimum(one, other).amax(-1).clamp(min=0)
    step = (torch.maximum(one, other).amin(-1) - start).clamp(min=0) / bins
    middles = start[:, None] + (torch.arange(bins, device=start.device) + 0.5) * step[:, None]
    before = (grid.contains(rays.at(middles)) & (step > 0)[:, None]).float().cumsum(1)
    return Stretches(start=start, step=step, before=before, length=before[:, -1] * step)


@dataclass(frozen=True, kw_only=True, slots=True)
class Marched:
    """What rays see: colour premultiplied by alpha."""

    rgb: Float[Tensor, "r 3"]
    alpha: Float[Tensor, " r"]
    length: Float[Tensor, " r"]  # to what is seen, metres: the mean over what stops the light; 0: nothing is seen


def march(field: Field, rays: Rays, grid: ShellGrid, *, samples: int, jitter: Tensor | None = None) -> Marched:
    """Integrate a field along rays, by as many samples each, evenly over what of the ray lies in the shell.

    alpha_i = 1 - exp(-density_i length / samples), blended from the front (Max 1995). `march_naive` is the definition.
    `jitter`: [r, samples] in 0..1, where in its stratum each sample lies; without, in the middle. Gradients are those
    of the field; the samples are constants.
    """
    stretches = stretches_in(grid, rays)
    share = (torch.arange(samples, device=rays.origins.device) + (0.5 if jitter is None else jitter)) / samples
    lengths = stretches.place(share.expand(len(rays.origins), -1))
    density, rgb = _ask(field, rays, lengths)
    left = _light_left(density, stretches.length / samples)
    weights = left[:, :-1] - left[:, 1:]
    seen = (weights * lengths).sum(1) / weights.sum(1).clamp(min=1e-6)
    return Marched(rgb=(weights[..., None] * rgb).sum(1), alpha=1 - left[:, -1], length=seen)


def march_naive(field: Field, rays: Rays, grid: ShellGrid, *, steps: int) -> Marched:
    """`march` by its definition: small steps through the whole box, and a density of zero outside of the shell."""
    whole = stretches_in(grid, rays, bins=1)
    step = (whole.step / steps)[:, None]
    left, rgb, seen = torch.ones_like(step), torch.zeros_like(rays.origins), torch.zeros_like(step)
    for index in range(steps):
        length = whole.start[:, None] + (index + 0.5) * step
        density, colour = _ask(field, rays, length)
        inside = grid.contains(rays.at(length))
        stopped = left * (1 - torch.exp(-density * inside * step))
        rgb, seen, left = rgb + stopped * colour[:, 0], seen + stopped * length, left - stopped
    alpha = 1 - left[:, 0]
    return Marched(rgb=rgb, alpha=alpha, length=seen[:, 0] / alpha.clamp(min=1e-6))


def _ask(field: Field, rays: Rays, at: Float[Tensor, "r n"]) -> tuple[Float[Tensor, "r n"], Float[Tensor, "r n 3"]]:
    count, samples = at.shape
    directions = rays.directions[:, None].expand(-1, samples, -1).reshape(-1, 3)
    density, rgb = field(rays.at(at).reshape(-1, 3), directions)
    return density.reshape(count, samples), rgb.reshape(count, samples, 3)


def _light_left(density: Float[Tensor, "r n"], step: Float[Tensor, " r"]) -> Float[Tensor, "r n+1"]:
    """The share of light that comes through to each sample of a ray, and through the last."""
    through = torch.exp(-density * step[:, None])
    return torch.cat([torch.ones_like(through[:, :1]), through.cumprod(1)], 1)


@torch.no_grad()
def draw_rays(field: Field, rays: Rays, grid: ShellGrid, *, samples: int) -> Float[Tensor, "r 4"]:
    """`march` without gradients: rays that miss the shell, or through which no more light comes, ask nothing."""
    image = rays.origins.new_zeros(len(rays.origins), 4)
    stretches = stretches_in(grid, rays)
    places = stretches.place(((torch.arange(samples, device=image.device) + 0.5) / samples).expand(len(image), -1))
    left, step = torch.ones_like(stretches.length), stretches.length / samples
    for first in range(0, samples, BLOCK):
        rows = ((stretches.length > 0) & (left > OPAQUE)).nonzero().squeeze(1)
        if len(rows) == 0:
            break
        density, rgb = _ask(field, rays[rows], places[rows, first : first + BLOCK])
        lights = left[rows, None] * _light_left(density, step[rows])
        weights = lights[:, :-1] - lights[:, 1:]
        image[rows] += torch.cat([(weights[..., None] * rgb).sum(1), weights.sum(1, keepdim=True)], 1)
        left[rows] = lights[:, -1]
    return image


@torch.no_grad()
def draw_view(field: Field, camera: Camera, grid: ShellGrid, *, samples: int) -> Float[Tensor, "h w 4"]:
    """A whole image of any size, premultiplied, some rays at a time."""
    pixels = torch.arange(camera.width * camera.height, device=grid.low.device)
    parts = [draw_rays(field, rays_of(camera, some), grid, samples=samples) for some in pixels.split(RAYS_AT_ONCE)]
    return torch.cat(parts).reshape(camera.height, camera.width, 4)


# ---- the fields


class Mlp(nn.Sequential):
    """Layers of one width with ReLU, and a linear head."""

    def __init__(self, inputs: int, outputs: int, *, width: int, layers: int, head: float = 1.0) -> None:
        """`head`: by what its first weights are multiplied; 0: the result starts at nothing."""
        linear = [nn.Linear(inputs if layer == 0 else width, width) for layer in range(layers)]
        last = nn.Linear(width if layers else inputs, outputs)
        for layer in (*linear, last):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu" if layer is not last else "linear")
            nn.init.zeros_(layer.bias)
        last.weight.data.mul_(head)
        super().__init__(*(part for layer in linear for part in (layer, nn.ReLU(inplace=True))), last)

    def beside(self, inputs: Float[Tensor, "m i"], shared: Float[Tensor, " s"]) -> Float[Tensor, "m o"]:
        """`forward` of `inputs`, each with the same numbers after it."""
        first, *others = list[Any](self)
        inner, outer = first.weight.split([inputs.shape[1], len(shared)], 1)
        hidden = nn.functional.linear(inputs, inner, torch.addmv(first.bias, outer, shared))
        return reduce(lambda before, part: part(before), others, hidden)


class Radiance(nn.Module):
    """Density from a position's code, colour from the density's features and what else is told. As in NeRF."""

    def __init__(self, config: VolumeConfig, told: int) -> None:
        super().__init__()
        self.octaves = config.octaves
        inputs, width = 3 + 6 * config.octaves, config.width
        self.trunk = Mlp(inputs, 1 + width, width=width, layers=config.layers)
        self.colour = Mlp(width + told, 3, width=width // 2, layers=1, head=0.1)

    def logits(self, points: Float[Tensor, "m 3"]) -> tuple[Float[Tensor, " m"], Float[Tensor, "m w"]]:
        """Before the softplus, and features."""
        out = self.trunk(encode(points, self.octaves))
        return out[:, 0], out[:, 1:].relu()

    def forward(self, points: Float[Tensor, "m 3"], told: Float[Tensor, "m t"]) -> tuple[Tensor, Tensor]:
        """Density per metre `[m]` and rgb `[m, 3]`."""
        logits, features = self.logits(points)
        return PER_METRE * nn.functional.softplus(logits), self.colour(torch.cat([features, told], 1)).sigmoid()


@dataclass(frozen=True, kw_only=True, slots=True)
class Bones:
    """Segments from each joint to its children, in rest; a joint without children is a point."""

    joints: Int[Tensor, " b"]  # which joint moves a bone
    starts: Float[Tensor, "b 3"]
    ends: Float[Tensor, "b 3"]

    def along(self, share: Float[Tensor, "b n 1"]) -> Float[Tensor, "b n 3"]:
        """Points on them, at shares of their lengths."""
        return self.starts[:, None] + share * (self.ends - self.starts)[:, None]

    def distances(self, points: Float[Tensor, "m 3"], matrices: Float[Tensor, "j 12"] | None) -> Float[Tensor, "m b"]:
        """From points to the bones, which may be posed."""
        starts, ends = self.starts, self.ends
        if matrices is not None:
            turns, shifts = matrices[self.joints].unflatten(1, (3, 4)).split([3, 1], 2)
            starts, ends = ((turns @ side[..., None] + shifts)[..., 0] for side in (starts, ends))
        along = ends - starts
        length = along.square().sum(-1).clamp(min=1e-9)
        reach = torch.addmm(-(starts * along).sum(-1), points, along.T)  # (point - start) . along
        away = torch.addmm(starts.square().sum(-1), points, starts.T, alpha=-2) + points.square().sum(-1, keepdim=True)
        share = (reach / length).clamp(0, 1)
        return (away - share * (2 * reach - share * length)).clamp(min=0).sqrt()


def bones_of(skeleton: Skeleton) -> Bones:
    """One bone per joint and child."""
    parents = skeleton.parents
    leaves = [joint for joint in range(len(parents)) if joint not in parents]
    pairs = [(int(parents[j]), j) for j in range(len(parents)) if parents[j] >= 0] + [(j, j) for j in leaves]
    heads = torch.from_numpy(skeleton.heads).float()
    joints, ends = (torch.tensor(side) for side in zip(*pairs, strict=True))
    return Bones(joints=joints, starts=heads[joints], ends=heads[ends])


@dataclass(frozen=True, kw_only=True, slots=True)
class JointFrame:
    """A frame as the forward field takes it."""

    matrices: Float[Tensor, "b 12"]  # rest -> world, 3x4, of every joint; and the identity, for the background
    code: Float[Tensor, " p"]  # the pose: rotation vectors of all joints but the root


def joint_frame(skeleton: Skeleton, dofs: Float[Tensor, " d"]) -> JointFrame:
    """The frame of some degrees of freedom, in their precision."""
    joints = forward_kinematics(skeleton, dofs)
    matrices = torch.cat([unitquat_to_rotmat(joints.quats), joints.translations[..., None]], -1)
    still = torch.eye(3, 4, dtype=dofs.dtype, device=dofs.device)
    return JointFrame(matrices=torch.cat([matrices, still[None]]).flatten(1), code=dofs[6:])


class ForwardField(MovingModule):
    """A field in a rest pose that forward skinning carries to any pose, offset included.

    x_posed = sum_b w_b(x) T_b x + offset(x, pose), with a bone more that stays where it is: the background. A point of
    a frame is brought to rest by solving for x, from its nearest bones; of several roots the densest counts.
    """

    def __init__(self, config: VolumeConfig, skeleton: Skeleton) -> None:
        super().__init__()
        self.config, self.bones = config, bones_of(skeleton)
        joints, side = len(skeleton.names), {"width": config.side_width, "layers": config.side_layers}
        pose = 3 * (joints - 1)
        self.offsets: Tensor = torch.zeros(0, 3)
        self.skin = Mlp(3 + 6 * SKIN_OCTAVES, joints + 1, head=0.1, **side)
        self.offset = Mlp(3 + 6 * SKIN_OCTAVES + pose, 3, head=0.0, **side)
        self.radiance = Radiance(config, told=0)
        self.shade = Mlp(3 + 6 * SKIN_OCTAVES + pose, 1, width=config.side_width, layers=1, head=0.0)

    def pose(self, rest: Float[Tensor, "m 3"], frame: JointFrame) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
        """Forward skinning, and the offset that is part of it."""
        code = encode(rest, SKIN_OCTAVES)
        blended = (self.skin(code).softmax(-1) @ frame.matrices).unflatten(1, (3, 4))
        offset = self.offset.beside(code, frame.code)
        turned = (blended[..., :3] * rest[:, None]).sum(-1)
        return turned + blended[..., 3] + 0.1 * offset, offset

    @torch.no_grad()
    def search(self, points: Float[Tensor, "m 3"], frame: JointFrame) -> tuple[Tensor, Tensor]:
        """Roots of `pose`, `[m, c, 3]`, from as many nearest bones, by Broyden's method; which are roots, `[m, c]`."""
        config = self.config
        count = min(config.candidates, len(self.bones.joints)) if config.root_steps else 1
        nearest = self.bones.distances(points, frame.matrices).topk(count, 1, largest=False).indices
        joints = self.bones.joints[nearest].reshape(-1)
        wanted = points[:, None].expand(-1, count, -1).reshape(-1, 3)
        turns, shifts = frame.matrices[joints].unflatten(1, (3, 4)).split([3, 1], 2)
        inverse = turns.transpose(1, 2)
        rest = (inverse @ (wanted[..., None] - shifts))[..., 0]
        error = self.pose(rest, frame)[0] - wanted
        for _ in range(config.root_steps):
            rows = (error.norm(dim=-1) > ROOT_M).nonzero().squeeze(1)
            at, turn = rest[rows], inverse[rows]
            step = -(turn @ error[rows][..., None])[..., 0]
            at = at + step
            after = self.pose(at, frame)[0] - wanted[rows]
            gained = (turn @ (after - error[rows])[..., None])[..., 0]
            scale = (step * gained).sum(-1, keepdim=True)
            row = (step[:, None] @ turn)[:, 0] / torch.where(scale.abs() < 1e-12, torch.inf, scale)
            turn = turn + (step - gained)[..., None] * row[:, None]
            changed = (rest, at), (inverse, turn), (error, after)
            rest, inverse, error = (whole.index_copy(0, rows, part) for whole, part in changed)
        are_roots = (error.norm(dim=-1) <= ROOT_M) | (config.root_steps == 0)
        return rest.reshape(-1, count, 3), are_roots.reshape(-1, count)

    def implicit(
        self, root: Float[Tensor, "m 3"], points: Float[Tensor, "m 3"], frame: JointFrame
    ) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"], Bool[Tensor, " m"]]:
        """The root as a function of the networks' weights: x - J^-1 (pose(x) - points), where J is a constant.

        Its value is the root, or a step of Newton's method nearer to it; its gradient is that of the implicit function.
        Also the offset at the root, and whether skinning is one to one there.
        """
        with torch.enable_grad():
            at = root.detach().requires_grad_()
            posed, offset = self.pose(at, frame)
            rows = [torch.autograd.grad(posed[:, axis].sum(), at, retain_graph=True)[0] for axis in range(3)]
        a, b, c = torch.stack(rows, 1).unbind(2)  # columns of J
        inverse = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
        determinant = (a * inverse[:, 0]).sum(-1)
        solid = determinant > SOLID
        inverse = inverse / torch.where(solid, determinant, torch.inf)[:, None, None]
        return root.detach() - (inverse @ (posed - points)[..., None])[..., 0], offset, solid

    def at(self, frame: JointFrame) -> Field:
        """The field in a frame. Where no root is found nothing is; `offsets` are those of what was asked for last."""

        def ask(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
            roots, are_roots = self.search(points, frame)
            with torch.no_grad():
                logits = self.radiance.logits(roots.reshape(-1, 3))[0].reshape(are_roots.shape)
                best = logits.masked_fill(~are_roots, -torch.inf).argmax(1)[:, None]
            root = roots.gather(1, best[..., None].expand(-1, -1, 3))[:, 0]
            valid = are_roots.gather(1, best)[:, 0]
            if self.config.root_steps:
                root, offsets, solid = self.implicit(root, points, frame)
                self.offsets = offsets if torch.is_grad_enabled() else offsets.detach()
                valid = valid & solid
            density, rgb = self.radiance(root, root.new_zeros(len(root), 0))
            return density * valid, rgb * (2 * self.shade.beside(encode(root, SKIN_OCTAVES), frame.code).sigmoid())

        return ask

    def bone_loss(self, share: Float[Tensor, "b n 1"]) -> Float[Tensor, ""]:
        """Points on a bone move with its joint: cross-entropy of the skinning weights. `share`: where on the bones."""
        logits = self.skin(encode(self.bones.along(share).flatten(0, 1), SKIN_OCTAVES))
        return nn.functional.cross_entropy(logits, self.bones.joints.repeat_interleave(share.shape[1]))


class SurfaceLookup:
    """The nearest point of a posed mesh, found among the triangles around the nearest vertex."""

    def __init__(self, posed: PosedTemplate, faces: Int[Tensor, "f 3"], ring: Int[Tensor, "v k"]) -> None:
        self.posed, self.faces, self.ring = posed, faces, ring

    @cached_property
    def nearest(self) -> NearestPoint:
        """Of the vertices. A field that asks for no surface point needs no tree."""
        return NearestPoint(self.posed.vertices)

    @torch.no_grad()
    def of(self, points: Float[Tensor, "m 3"]) -> "SurfacePoints":
        """A point beside all triangles takes the weights that are positive: on an edge, up to a skew triangle."""
        around = self.ring[self.nearest.of(points)[1]]
        a, b, c = self.posed.vertices[self.faces[around]].unbind(2)
        u, v, w = b - a, c - a, points[:, None] - a
        normal = torch.linalg.cross(u, v)
        area = normal.square().sum(-1).clamp(min=1e-16)
        second = (torch.linalg.cross(w, v) * normal).sum(-1) / area
        third = (torch.linalg.cross(u, w) * normal).sum(-1) / area
        weights = torch.stack([1 - second - third, second, third], -1).clamp(min=0)
        weights = weights / weights.sum(-1, keepdim=True)
        away = w - weights[..., 1:2] * u - weights[..., 2:] * v
        best = away.square().sum(-1).argmin(1)[:, None]
        pick = best[..., None].expand(-1, -1, 3)
        away, weights, normal = (values.gather(1, pick)[:, 0] for values in (away, weights, normal))
        outside = torch.where((away * normal).sum(-1) < 0, -1.0, 1.0)
        return SurfacePoints(faces=around.gather(1, best)[:, 0], weights=weights, distance=outside * away.norm(dim=-1))


@dataclass(frozen=True, kw_only=True, slots=True)
class SurfacePoints:
    """Points of a mesh, each nearest to some other point."""

    faces: Int[Tensor, " m"]
    weights: Float[Tensor, "m 3"]  # of the face's corners
    distance: Float[Tensor, " m"]  # to the other point, metres, negative inside


def ring_of(faces: np.ndarray, vertices: int) -> Int[Tensor, "v k"]:
    """Up to `RING` triangles at each vertex; the first is repeated where there are fewer."""
    order = np.argsort(faces.ravel(), kind="stable")
    first, last = (np.searchsorted(faces.ravel()[order], np.arange(vertices), side=side) for side in ("left", "right"))
    places = np.minimum(first[:, None] + np.arange(RING), np.maximum(last - 1, first)[:, None])
    return torch.from_numpy(order[np.minimum(places, len(order) - 1)] // 3)


class ShellField(MovingModule):
    """A field around a posed mesh: points are brought to rest with the nearest point of the mesh.

    There a residual moves them, which sees the texture's features at that point; so does the colour, besides the
    direction of sight. Beyond `shell_m` of the mesh there is nothing.
    """

    def __init__(self, config: VolumeConfig, uvs: Float[Tensor, "u 2"], uv_faces: Int[Tensor, "f 3"]) -> None:
        super().__init__()
        self.config, self.uvs, self.uv_faces = config, uvs, uv_faces
        self.radiance = Radiance(config, told=config.channels + 3)
        side, inputs = {"width": config.side_width, "layers": config.side_layers}, 3 + 6 * config.octaves
        self.residual = Mlp(inputs + config.channels, 3, head=0.0, **side)

    def at(self, surface: SurfaceLookup, texture: Float[Tensor, "c t t"]) -> Field:
        """The field in a frame."""

        def ask(points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
            near = surface.of(points)
            transforms = blend_transforms(surface.posed.transforms, surface.faces[near.faces], near.weights)
            rest, features = transforms.apply_inverse(points), points.new_zeros(len(points), 0)
            if self.config.channels:
                features = sample_texture(texture, blend(self.uvs, self.uv_faces[near.faces], near.weights))
            change = self.residual(torch.cat([encode(rest, self.config.octaves), features], 1)).tanh()
            density, rgb = self.radiance(rest + self.config.residual_m * change, torch.cat([features, directions], 1))
            return density * (near.distance.abs() < self.config.shell_m), rgb

        return ask


# ---- the avatar


@dataclass(frozen=True, kw_only=True, slots=True)
class FieldInputs(DecoderInputs):
    """What is known of a frame before any network."""

    posed: PosedTemplate  # as the template has it, before it is pulled
    frame: JointFrame


class FieldModel(MovingModule):
    """A field, the network that predicts its texture, and a displacement of the mesh, as far as a row has them."""

    def __init__(self, config: FieldConfig, template: Template, textures: TextureDrawer) -> None:
        super().__init__()
        self.config, self.template = config, template
        mesh, field, model = template.mesh, config.field, config.model
        self.ring = ring_of(mesh.faces, len(mesh.vertices))
        # A cube that holds the body in most poses; what reaches out of it counts as its border.
        self.extent_m = 1.2 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) + 2 * field.shell_m
        self.has_texture = field.kind == "shell" and field.channels > 0
        self.textures = textures if self.has_texture else None
        self.refinement = Refinement(mesh) if field.pull_every else None
        if field.kind == "forward":
            self.field: ForwardField | ShellField = ForwardField(field, template.skeleton)
        else:
            uvs, uv_faces = torch.from_numpy(mesh.uvs).float(), torch.from_numpy(mesh.uv_faces)
            self.field = ShellField(field, uvs, uv_faces)
        self.phi, self.network = None, None
        if self.has_texture:
            self.phi = GlobalFeatures(model.global_mlp) if model.global_features else None
            bottleneck = GLOBAL_FEATURES if model.global_features else 0
            sizes: dict[str, Any] = {"width": model.width, "levels": model.levels, "norm": model.norm}
            self.network = UNet(6 * model.window, field.channels, bottleneck_features=bottleneck, **sizes)
        start = torch.zeros(field.channels, *2 * [model.decoded_texels]) if self.has_texture else torch.zeros(0, 1, 1)
        self.base_texture = nn.Parameter(start, requires_grad=model.base and self.has_texture)

    @torch.no_grad()
    def frame_inputs(self, pose: Pose, clock: StageClock | None = None) -> FieldInputs:
        """Stg. 1 and 2: pose skeleton and template, and draw what the network takes."""
        device = self.base_texture.device
        with stage(clock, "stg1", device):
            posed = self.template.pose(pose)
            frame = joint_frame(self.template.skeleton, torch.from_numpy(pose.dofs).float())
        with stage(clock, "stg2", device):
            drawn = self.textures(self.template, pose) if self.textures else posed.vertices.new_zeros(0, 1, 1)
            return FieldInputs(
                textures=drawn,
                root_translation=torch.from_numpy(pose.dofs[:3]).float().to(device),
                posed=posed,
                frame=moved(frame, device),
            )

    def decode(self, inputs: Sequence[FieldInputs]) -> Float[Tensor, "b c t t"]:
        """Stg. 3: the feature textures of several frames; empty where there is no network."""
        if self.network is None:
            return self.base_texture[None].expand(len(inputs), -1, -1, -1)
        return self.base_texture[None] + self.residual(inputs)

    def residual(self, inputs: Sequence[FieldInputs]) -> Float[Tensor, "b c t t"]:
        """What the network predicts."""
        assert self.network is not None
        decoded: Tensor = self.network(*batched_inputs(inputs, self.phi))
        return decoded

    def refined(self, inputs: FieldInputs) -> PosedTemplate:
        """The posed mesh where the field has pulled it."""
        posed = inputs.posed
        if self.refinement is None:
            return posed
        canonical = posed.canonical + self.refinement()
        vertices = posed.transforms.apply(canonical)
        normals = vertex_normals(vertices.detach(), self.template.faces)
        return replace(posed, canonical=canonical, vertices=vertices, normals=normals)

    @torch.no_grad()
    def surface(self, inputs: FieldInputs) -> tuple[SurfaceLookup, ShellGrid]:
        """The mesh that the shell of a frame is around, and the shell's cells."""
        posed = self.refined(inputs)
        points = torch.cat([posed.vertices, posed.vertices[self.template.faces].mean(1)])
        grid = build_shell_grid(points, reach_m=self.config.field.shell_m, extent_m=self.extent_m)
        return SurfaceLookup(posed, self.template.faces, self.ring), grid

    def at(self, inputs: FieldInputs, surface: SurfaceLookup, texture: Tensor) -> Field:
        """The field in a frame."""
        if isinstance(self.field, ForwardField):
            return self.field.at(inputs.frame)
        return self.field.at(surface, texture)


class FieldAvatar(TrainedAvatar):
    """The Avatar protocol (see `ash.protocol`) for all three rows."""

    config: FieldConfig
    module: FieldModel

    @classmethod
    def from_capture(cls, config: FieldConfig, capture: Capture) -> "FieldAvatar":
        """The avatar, untrained, on the surface of its configuration."""
        if config.field.surface == "body":
            capture = replace(capture, template=read_body(capture))
        return super().from_capture(config, capture)

    def __init__(self, config: FieldConfig, capture: Capture, template: Template) -> None:
        super().__init__(config, capture, template)
        torch.manual_seed(config.seed)
        textures = TextureDrawer.of(config.model, build_lattice(capture.template, config.model.decoded_texels))
        if config.field.kind == "shell":
            textures.fit_normalization(template, capture.motion, capture.splits["train"].frames)
        self.module = FieldModel(config, template, textures).to(self.device)
        self.template = self.module.template

    @property
    def base(self) -> nn.Parameter:
        """Static features of the texture, `[c, t, t]`; empty where there is no texture."""
        return self.module.base_texture

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Networks; static features and the mesh's displacement."""
        training, module = self.config.training, self.module
        direct = [self.base] if self.base.requires_grad else []
        if module.refinement is not None:
            direct.append(module.refinement.rough)
        nets = [p for p in module.parameters() if not any(p is other for other in (self.base, *direct))]
        groups = (nets, training.learning_rate), (direct, training.base_learning_rate)
        return [{"params": group, "lr": rate} for group, rate in groups if group]

    def _has_decoders(self) -> bool:
        return self.module.has_texture

    def _uniform(self, random: np.random.Generator, *shape: int) -> Tensor:
        return torch.from_numpy(random.random(shape, np.float32)).to(self.device)

    def _warm_up(self, images: TrainingImages) -> None:
        """Start from what is known: density as inside of the rest mesh, or skinning weights of the nearest bone."""
        field, random = self.module.field, np.random.default_rng([self.config.seed, 4])
        learned = list((field.skin if isinstance(field, ForwardField) else field.radiance.trunk).parameters())
        optimiser = Adam([{"params": learned, "lr": self.config.training.learning_rate}])
        for _ in range(self.config.field.warmup_steps):
            optimiser.zero_grad()
            start: Any = self._nearest_bone_loss if isinstance(field, ForwardField) else self._template_loss
            start(field, random).backward()
            optimiser.step()

    def _template_loss(self, field: ShellField, random: np.random.Generator) -> Tensor:
        mesh, reach = self.template.mesh, self.config.field.shell_m
        vertices = torch.from_numpy(mesh.vertices).float().to(self.device)
        rows = torch.from_numpy(random.integers(len(vertices), size=2048)).to(self.device)
        distance = reach * (2 * self._uniform(random, len(rows)) - 1)
        points = vertices[rows] + distance[:, None] * vertex_normals(vertices, self.template.faces)[rows]
        return (field.radiance.logits(points)[0] + distance / SOFTNESS_M).square().mean()

    def _nearest_bone_loss(self, field: ForwardField, random: np.random.Generator) -> Tensor:
        bones = field.bones
        rest = bones.along(self._uniform(random, len(bones.joints), 32, 1)).flatten(0, 1)
        points = rest + 0.2 * (2 * self._uniform(random, len(rest), 3) - 1)
        nearest = bones.joints[bones.distances(points, None).argmin(1)]
        return nn.functional.cross_entropy(field.skin(encode(points, SKIN_OCTAVES)), nearest)

    def loss(self, batches: Sequence[Batch], step: int) -> Tensor:
        """Mean squared error of rays of the batches' views; in some steps the template's distance to the field."""
        inputs = [self._inputs_of(batch.frame) for batch in batches]
        pulls = self.config.field.pull_every and step % self.config.field.pull_every == self.config.field.pull_every - 1
        loss_of = self._pull_loss if pulls else self._ray_loss
        with torch.set_grad_enabled(not pulls):
            textures = self._decode_step(inputs, step)
        random = np.random.default_rng([self.config.seed, 5, step])
        rows = zip(textures, inputs, batches, strict=True)
        return torch.stack([loss_of(*row, random) for row in rows]).mean()

    def _ray_loss(self, texture: Tensor, inputs: FieldInputs, batch: Batch, random: np.random.Generator) -> Tensor:
        surface, grid = self.module.surface(inputs)
        rays, target, behind = self._rays_of(batch, grid, random)
        samples, field = self.config.field.samples, self.module.at(inputs, surface, texture)
        jitter = self._uniform(random, len(rays.origins), samples)
        marched = march(field, rays, grid, samples=samples, jitter=jitter)
        loss = (marched.rgb + (1 - marched.alpha)[:, None] * behind - target).square().mean()
        if isinstance(net := self.module.field, ForwardField):
            loss = loss + BONE_WEIGHT * net.bone_loss(self._uniform(random, len(net.bones.joints), 8, 1))
            loss = loss + OFFSET_WEIGHT * net.offsets.square().sum() / max(1, len(net.offsets))
        return loss

    def _rays_of(self, batch: Batch, grid: ShellGrid, random: np.random.Generator) -> tuple[Rays, Tensor, Tensor]:
        """Rays of a batch's views, those first that meet the shell; their colours, and what is behind them."""
        count = max(1, self.config.field.rays // len(batch.cameras))
        chosen, targets, behinds = [], [], []
        for view, camera in enumerate(batch.cameras):
            size = camera.width * camera.height
            pixels = torch.from_numpy(random.integers(size, size=TRIED * count)).to(self.device)
            tried = rays_of(camera, pixels)
            first = torch.argsort((stretches_in(grid, tried, bins=BINS // 4).length == 0).int(), stable=True)[:count]
            behind = batch.background if batch.background.ndim == 1 else batch.background[view]
            chosen.append(tried[first])
            targets.append(batch.targets[view].reshape(size, 3)[pixels[first]])
            behinds.append(behind.expand(camera.height, camera.width, 3).reshape(size, 3)[pixels[first]])
        origins, directions = torch.cat([r.origins for r in chosen]), torch.cat([r.directions for r in chosen])
        return Rays(origins=origins, directions=directions), torch.cat(targets), torch.cat(behinds)

    def _pull_loss(self, texture: Tensor, inputs: FieldInputs, batch: Batch, random: np.random.Generator) -> Tensor:
        """Chamfer distance between the template and what the views see of the field.

        Along the template's normals, both ways: where along the surface a vertex belongs, points do not say.
        """
        with torch.no_grad():
            surface, grid = self.module.surface(inputs)
            rays, _, _ = self._rays_of(batch, grid, random)
            marched = march(self.module.at(inputs, surface, texture), rays, grid, samples=2 * self.config.field.samples)
            seen = marched.alpha > 0.5
            points = rays.at(marched.length[:, None])[:, 0].masked_fill(~seen[:, None], FAR_M)
            near = surface.of(points)
        posed = self.module.refined(inputs)
        return chamfer_along_normals(posed, self.template.faces, points, seen, near, self.config.field.shell_m)

    @torch.no_grad()
    def _draw(
        self, decoded: Tensor, inputs: FieldInputs, cameras: list[Camera], background: Tensor, step: int
    ) -> Tensor:
        surface, grid = self.module.surface(inputs)
        field, samples = self.module.at(inputs, surface, decoded), self.config.field.samples
        drawn = torch.stack([draw_view(field, camera, grid, samples=samples) for camera in cameras])
        return over(drawn[..., :3], drawn[..., 3], background)

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        inputs = self.module.frame_inputs(pose, clock)
        with stage(clock, "stg3", self.device):
            (texture,) = self.module.decode([inputs])
        with stage(clock, "stg4", self.device):
            surface, grid = self.module.surface(inputs)
            field = self.module.at(inputs, surface, texture)
            drawn = draw_view(field, camera, grid, samples=self.config.field.samples)
            return drawn.clamp(0, 1).cpu().numpy()

    @torch.no_grad()
    def template_vertices(self, pose: Pose) -> np.ndarray:
        """The posed template, `[v, 3]` metres; `[0, 3]` for a row whose geometry is not the capture's template."""
        if self.config.field.kind == "forward" or self.config.field.surface == "body":
            return np.zeros((0, 3))
        return self.module.refined(self.module.frame_inputs(pose)).vertices.cpu().numpy()

    def gaussian_means(self, pose: Pose) -> np.ndarray:
        """A field has none."""
        return np.zeros((0, 3))

    def gaussian_count(self) -> int:
        """A field has none."""
        return 0


def chamfer_along_normals(
    posed: PosedTemplate,
    faces: Int[Tensor, "f 3"],
    points: Float[Tensor, "m 3"],
    counts: Bool[Tensor, " m"],
    near: SurfacePoints,
    reach_m: float,
) -> Float[Tensor, ""]:
    """Mean squared distances, cm^2, from points to their nearest ones of the mesh and from vertices to points.

    Differentiable in the vertices. Points that do not count lie far away, and nothing counts beyond `reach_m`.
    """
    corners = faces[near.faces]
    there, normals = (blend(values, corners, near.weights) for values in (posed.vertices, posed.normals))
    to_mesh = ((points - there) * nn.functional.normalize(normals, dim=-1)).sum(-1)
    in_reach = counts & (near.distance.abs() < reach_m)
    distance, row = nearest_naive(points, posed.vertices.detach())
    to_points = ((points[row] - posed.vertices) * posed.normals).sum(-1)
    beside = distance.square() - to_points.detach().square()  # Farther beside a vertex a curved surface has turned.
    both = [(to_mesh, in_reach), (to_points, (distance < reach_m) & (beside < (reach_m / 4) ** 2))]
    return torch.stack([(100 * d).square().mul(c).sum() / c.sum().clamp(min=1) for d, c in both]).sum()


# ---- the rows


def _volume(name: str, preset: str) -> VolumeConfig:
    """A row's field at the size of a preset; `paper` has the published one."""
    published = {
        "tava": VolumeConfig(
            kind="forward", surface="template", shell_m=0.06, samples=128, rays=1024, width=256, layers=8, octaves=10,
            side_width=128, side_layers=4, channels=0, candidates=5, root_steps=50,
        ),
        "neural_actor": VolumeConfig(
            kind="shell", surface="body", shell_m=0.06, samples=64, rays=1024, width=256, layers=6, octaves=10,
            side_width=256, side_layers=4, channels=512,
        ),
    }  # fmt: skip
    published["hdhumans"] = replace(published["neural_actor"], surface="template", shell_m=0.03, pull_every=4)
    config = published[name]
    if preset in ("paper", "official"):
        return config
    rays, samples = (256, 16) if preset == "ci" else (512, 24)
    small = replace(config, samples=samples, rays=rays, width=64, layers=4, octaves=8, side_width=64, side_layers=2)
    if name != "tava":
        return replace(small, channels=16)
    return replace(small, shell_m=0.04, samples=16, rays=rays // 2, channels=0, candidates=3, root_steps=8)


def _row(name: str) -> MethodFactory[FieldConfig]:
    def config(preset: str) -> FieldConfig:
        ash = named(preset)
        training = replace(ash.training, warmup="none", warmup_steps=0, background="random", score_from=3000)
        if preset in ("paper", "official"):
            training = replace(training, steps=300_000, learning_rate=5e-4 if name == "tava" else 2e-4)
        return FieldConfig(
            field=_volume(name, preset),
            model=AtlasConfig(**{field.name: getattr(ash.model, field.name) for field in fields(AtlasConfig)}),
            training=training,
            template=ash.template if name == "hdhumans" else TemplateConfig(),
        )

    return MethodFactory(config=config, build=FieldAvatar.from_capture)


tava = _row("tava")
"""TAVA: a field in a rest pose, forward skinning with a background bone, root finding, offset and shading by the pose.

Differs from the publication: no mip encoding and no second, fine pass (all samples of a ray lie evenly in the shell, at
the preset `paper` as many as both passes have); the posed template, skinned, tells where samples lie and nothing else,
where TAVA has a box; skinning weights start as those of the nearest bone; shading is a factor of 0 to 2 by position and
pose; roots that skinning folds over do not count. Smaller, but for `paper`: MLPs of 4x64 and 2x64 (8x256, 4x128), 16
samples in 4 cm (64 + 64), 256 rays, of `ci` 128 (1,024), 3 roots of 8 steps (5 of 50), the preset's steps (300,000).
"""

neural_actor = _row("neural_actor")
"""Neural Actor: a field in the shell of the posed body without clothes, a residual, features of a predicted texture.

Differs from the publication: the texture is predicted by ASH's motion U-Net, end to end, where Neural Actor translates
normal maps into images with a GAN and takes a ResNet's features of them; the loss has no term that draws alpha to 0 or
1; the density starts as the inside of the body. Smaller, but for `paper`: MLPs of 4x64 (6x256), 16 channels (512), 24
samples in the 6 cm shell (64), 512 rays (1,024), of `ci` 16 and 256; the steps of the preset (300,000).
"""

hdhumans = _row("hdhumans")
"""HDHumans: the field of `neural_actor` in a thinner shell of the learned template, which is pulled to the field.

There is no public code. Differs from the publication: the template is the one that all rows get, learned from videos in
a job of its own; every fourth step moves its vertices alike in all frames (the published one refines its networks) by
the Chamfer distance to points that the step's rays see, along normals; the texture is as in `neural_actor`, where
HDHumans takes its mesh's. Sizes are those of `neural_actor`, the shell 3 cm.
"""
