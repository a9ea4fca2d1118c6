"""A DDC-style mesh avatar: the animatable template with a dynamic texture, rasterised.

Habermann et al., "Real-time Deep Dynamic Characters" (SIGGRAPH 2021), as ASH describes its competitor: the same learned
template as ASH, and a texture predicted from the motion-aware normal texture. The mesh decides which surface point a
pixel sees; only the texture (and the light) is learned here, through perspective-correct bilinear sampling and
antialiased coverage.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.avatar import LIGHT_COEFFICIENTS
from ash.config import AshConfig, ModelConfig, TrainingConfig
from ash.dataset import Camera, Capture, Motion, TemplateMesh
from ash.decoders import UNet
from ash.files import write_atomic
from ash.harmonics import sh_basis
from ash.initialising import mean_colours
from ash.method import template_of
from ash.presets import named
from ash.protocol import StageClock
from ash.rasterizing import project_vertices, rasterize_mesh
from ash.template import PosedTemplate, Template
from ash.textures import TexelLattice, build_lattice, motion_aware_textures, texture_statistics
from ash.training import fit, load_module, load_training_images, read_safetensors

TEXTURE_FACTOR = 2  # Texture pixels per Gaussian of ASH's lattice, per side: the mesh must not be starved.
SUPERSAMPLING = 2  # Rays per pixel side: antialiased coverage and texture.


@dataclass(frozen=True, kw_only=True, slots=True)
class DdcConfig:
    """The texture network sees what ASH's decoders see, at the same resolution and width."""

    texture: int  # pixels per side
    texels: int  # resolution of the motion-aware textures, which the network sees
    window: int
    yaw_normalise: bool
    width: int
    levels: int
    norm: str
    standardise: bool
    light: bool
    training: TrainingConfig
    template: str
    seed: int


def ddc_config(ash: AshConfig, *, seed: int, template: str) -> DdcConfig:
    """DDC with the budget and the conditions of an ASH preset."""
    model: ModelConfig = ash.model
    return DdcConfig(
        texture=TEXTURE_FACTOR * model.texels,
        texels=model.decoded_texels,
        window=model.window,
        yaw_normalise=model.yaw_normalise,
        width=model.width,
        levels=model.levels,
        norm=model.norm,
        standardise=model.standardise,
        light=model.light,
        training=ash.training,
        template=template,
        seed=seed,
    )


class DdcModel(nn.Module):
    """A static texture plus a residual that is predicted from the motion-aware textures."""

    def __init__(
        self, config: DdcConfig, mesh: TemplateMesh, template: Template, lattice: TexelLattice, initial: Tensor
    ) -> None:
        """`initial`: texture to start from, `[3, R, R]`."""
        super().__init__()
        self.config, self.template, self.lattice = config, template, lattice
        self.uv_faces = torch.from_numpy(mesh.uv_faces)
        self.uvs = torch.from_numpy(mesh.uvs).float()
        self.texture = nn.Parameter(initial.clone())
        self.network = UNet(
            6 * config.window,
            3 * (config.texture // config.texels) ** 2,
            width=config.width,
            levels=config.levels,
            norm=config.norm,
        )
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if config.light else None
        self.register_buffer("texture_mean", torch.zeros(6 * config.window, config.texels, config.texels))
        self.register_buffer("texture_deviation", torch.ones(6 * config.window, 1, 1))

    def observe(self, motion: Motion, frames: tuple[int, ...]) -> None:
        """Take the statistics of the textures that `standardise` refers to, from training frames."""
        if self.config.standardise:
            drawn = [self._raw_conditions(motion, frame) for frame in frames]
            self.texture_mean, self.texture_deviation = texture_statistics(drawn)

    def conditions(self, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        """The motion-aware textures of a frame, as the network sees them."""
        textures = self._raw_conditions(motion, frame)
        return (textures - self.texture_mean) / self.texture_deviation

    def _raw_conditions(self, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        return motion_aware_textures(
            self.template,
            self.lattice,
            motion,
            frame,
            window=self.config.window,
            yaw_normalise=self.config.yaw_normalise,
        )

    def dynamic_texture(self, conditions: Float[Tensor, "c r r"]) -> Float[Tensor, "3 t t"]:
        """The texture of a frame: decoded at the resolution of the motion-aware textures and shuffled up."""
        seen = conditions[None].contiguous(memory_format=torch.channels_last)
        factor = self.config.texture // self.config.texels
        return self.texture + nn.functional.pixel_shuffle(self.network(seen), factor)[0]

    def draw(
        self, texture: Float[Tensor, "3 t t"], posed: PosedTemplate, camera: Camera, background: Tensor
    ) -> Float[Tensor, "h w 4"]:
        """Rasterise: rgb over `background`, and coverage. Differentiable in the texture and the light."""
        width, height = camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING
        viewmat, K = torch.from_numpy(camera.viewmat).float(), torch.from_numpy(camera.K).float()
        K = torch.diag(torch.tensor([float(SUPERSAMPLING), float(SUPERSAMPLING), 1.0])) @ K
        drawn = rasterize_mesh(
            project_vertices(posed.vertices, viewmat, K), self.template.faces, width=width, height=height
        )
        covered = (drawn.triangle.reshape(-1) >= 0).nonzero().squeeze(1)
        triangles = drawn.triangle.reshape(-1)[covered].long()
        barycentric = drawn.barycentric.reshape(-1, 3)[covered][..., None]
        uvs = (self.uvs[self.uv_faces[triangles]] * barycentric).sum(1)
        colours = sample_texture(texture, uvs)
        if self.light is not None:
            normals = (posed.normals[self.template.faces[triangles]] * barycentric).sum(1)
            colours = colours * (sh_basis(nn.functional.normalize(normals, dim=-1), 2) @ self.light).exp()
        over = torch.cat([background, background.new_zeros(1)]).expand(height * width, 4)
        image = over.index_put((covered,), torch.cat([colours, torch.ones_like(colours[:, :1])], 1))
        image = image.reshape(camera.height, SUPERSAMPLING, camera.width, SUPERSAMPLING, 4)
        return image.mean((1, 3))


def sample_texture(texture: Float[Tensor, "c t s"], uvs: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Bilinear samples at UVs in [0, 1], v up; differentiable in the texture and the UVs."""
    grid = torch.stack([2 * uvs[:, 0] - 1, 1 - 2 * uvs[:, 1]], -1)[None, None]
    sampled = nn.functional.grid_sample(texture[None], grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T


class DdcAvatar:
    """The Avatar protocol (see `ash.protocol`) for the mesh baseline."""

    def __init__(self, config: DdcConfig, capture: Capture) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.template = template_of(config.template, capture)
        fine = build_lattice(capture.template, config.texture)
        colours = mean_colours(capture, self.template, fine)
        initial = fine.to_texture(colours - colours.mean(0)) + colours.mean(0)[:, None, None]
        lattice = build_lattice(capture.template, config.texels)
        self.module = DdcModel(config, capture.template, self.template, lattice, initial)
        self.module.observe(capture.motion, capture.splits["train"].frames)
        self._motion = capture.motion
        self._conditions: dict[int, Tensor] = {}  # The template is frozen: each training frame is posed once.
        self._posed: dict[int, PosedTemplate] = {}

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Train texture and network on the training images; see `ash.training.fit`."""
        images = load_training_images(capture)
        fit(self, images, self.config.training, seed=self.config.seed, folder=folder)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """The network, and the texture with the light, as ASH's decoders and base."""
        training = self.config.training
        static = [self.module.texture] + ([self.module.light] if self.module.light is not None else [])
        return [
            {"params": list(self.module.network.parameters()), "lr": training.learning_rate},
            {"params": static, "lr": training.base_learning_rate},
        ]

    def draw_training_views(self, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
        """The texture of the frame, drawn into each camera; the static texture alone while the warm-up lasts."""
        if frame not in self._posed:
            self._posed[frame] = self.template.pose(self._motion, frame)
            self._conditions[frame] = self.module.conditions(self._motion, frame)
        static = self.config.training.warmup == "static" and step < self.config.training.warmup_steps
        texture = self.module.texture if static else self.module.dynamic_texture(self._conditions[frame])
        return torch.stack([self.module.draw(texture, self._posed[frame], c, background)[..., :3] for c in cameras])

    @torch.no_grad()
    def render(self, motion: Motion, frame: int, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        with clock.stage("stg1"):
            posed = self.template.pose(motion, frame)
        with clock.stage("stg2"):
            conditions = self.module.conditions(motion, frame)
        with clock.stage("stg3"):
            texture = self.module.dynamic_texture(conditions)
        with clock.stage("stg4"):
            return self.module.draw(texture, posed, camera, torch.zeros(3)).clamp(0, 1).numpy()

    def template_vertices(self, motion: Motion, frame: int) -> np.ndarray:
        """The posed template, `[v, 3]` metres."""
        return self.template.pose(motion, frame).vertices.numpy()

    def gaussian_means(self, motion: Motion, frame: int) -> np.ndarray:
        """A mesh has none."""
        return np.zeros((0, 3))

    def parameter_count(self) -> int:
        """Numbers that training may change."""
        return sum(p.numel() for p in self.module.parameters() if p.requires_grad)

    def gaussian_count(self) -> int:
        """A mesh has none."""
        return 0

    def save(self, path: Path) -> None:
        """Write the weights."""
        write_atomic(path, safetensors.torch.save({n: t.contiguous() for n, t in self.module.state_dict().items()}))

    def load(self, path: Path) -> None:
        """Read the weights that `save` wrote."""
        load_module(self.module, read_safetensors(path)[0], path)


def ddc(capture: Capture, *, seed: int, preset: str) -> DdcAvatar:
    """The mesh baseline on the template that ASH gets."""
    return DdcAvatar(ddc_config(named(preset), seed=seed, template="skinned"), capture)


def ddc_truth(capture: Capture, *, seed: int, preset: str) -> DdcAvatar:
    """The mesh baseline on the exact surface: an oracle, to see when a mesh wins."""
    return DdcAvatar(ddc_config(named(preset), seed=seed, template="exact"), capture)
