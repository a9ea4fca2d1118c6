"""A DDC-style mesh avatar: the animatable template with a dynamic texture, rasterised.

Habermann et al., "Real-time Deep Dynamic Characters" (SIGGRAPH 2021), as ASH describes its competitor: the same learned
template as ASH, and a texture predicted from the motion-aware normal texture. The mesh decides which surface point a
pixel sees; texture and light are learned through perspective-correct bilinear sampling and antialiased coverage, and
so is a displacement of the template's vertices.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.config import AshConfig, ModelConfig, TemplateConfig, TrainingConfig
from ash.dataset import Camera, Capture, Motion, TemplateMesh
from ash.decoders import UNet
from ash.drawing import draw_mesh, textured, topology_of
from ash.files import write_atomic
from ash.initialising import initial_texture
from ash.presets import named
from ash.protocol import Display, StageClock
from ash.refining import Refinement
from ash.template import PosedTemplate, Template
from ash.templates import template_of
from ash.texels import LIGHT_COEFFICIENTS
from ash.textures import TextureDrawer, build_lattice, unsettled
from ash.training import fit, load_module, load_training_images, read_safetensors

# Texture pixels per Gaussian of ASH's lattice, per side: the mesh must not be starved. At 256x256 a body's pixel is
# 9 mm wide, twice 256 texels are 3 mm apart and more shows nothing; at full size pixels of 2.5 mm ask for four times.
TEXTURE_FACTOR = 2
TEXTURE_FACTORS = {"paper": 4, "official": 4}
VERTICES_EVERY = 4  # Steps: with a gradient in the vertices a picture takes three times as long.


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
    template: TemplateConfig
    refine: bool  # let images move the vertices; an exact surface has nothing to gain
    seed: int


def ddc_config(ash: AshConfig, *, seed: int, template: TemplateConfig) -> DdcConfig:
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
        refine=template.kind != "exact" or template.error_mm > 0,
        seed=seed,
    )


class DdcModel(nn.Module):
    """A static texture plus a residual that is predicted from the motion-aware textures."""

    def __init__(
        self, config: DdcConfig, mesh: TemplateMesh, template: Template, textures: TextureDrawer, initial: Tensor
    ) -> None:
        """`initial`: texture to start from, `[3, R, R]`."""
        super().__init__()
        self.config, self.template, self.textures = config, template, textures
        self.uv_faces = torch.from_numpy(mesh.uv_faces)
        self.uvs = torch.from_numpy(mesh.uvs).float()
        self.topology = topology_of(template.faces)
        self.texture = nn.Parameter(initial.clone())
        self.refinement = Refinement(mesh) if config.refine else None
        self.network = UNet(
            6 * config.window,
            3 * (config.texture // config.texels) ** 2,
            width=config.width,
            levels=config.levels,
            norm=config.norm,
        )
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if config.light else None

    def dynamic_texture(self, conditions: Float[Tensor, "c r r"]) -> Float[Tensor, "3 t t"]:
        """The texture of a frame: decoded at the resolution of the motion-aware textures and shuffled up."""
        seen = conditions[None].contiguous(memory_format=torch.channels_last)
        factor = self.config.texture // self.config.texels
        return self.texture + nn.functional.pixel_shuffle(self.network(seen), factor)[0]

    def draw(
        self, texture: Float[Tensor, "3 t t"], posed: PosedTemplate, camera: Camera, background: Tensor
    ) -> Float[Tensor, "h w 4"]:
        """Rgb over `background`, and coverage. Differentiable in the texture, the light and the posed vertices.

        Outlines are blended while vertices learn, for the gradient's sake; what is shown counts samples.
        """
        shade = textured(texture, self.uvs, self.uv_faces, posed.normals, self.template.faces, self.light)
        learns = posed.vertices.requires_grad
        return draw_mesh(posed.vertices, self.topology, camera, shade, background, outlines=learns)

    def refined(self, posed: PosedTemplate) -> PosedTemplate:
        """The template with its vertices where the images moved them. The light keeps the normals that it had."""
        if self.refinement is None:
            return posed
        canonical = posed.canonical + self.refinement()
        return replace(posed, canonical=canonical, vertices=posed.transforms.apply(canonical))


class DdcAvatar:
    """The Avatar protocol (see `ash.protocol`) for the mesh baseline."""

    def __init__(self, config: DdcConfig, capture: Capture) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        self.template = template_of(config.template, capture, seed=config.seed)
        initial = initial_texture(capture, self.template, build_lattice(capture.template, config.texture))
        textures = TextureDrawer(
            build_lattice(capture.template, config.texels),
            window=config.window,
            yaw_normalise=config.yaw_normalise,
            standardise=config.standardise,
        )
        textures.observe(self.template, capture.motion, capture.splits["train"].frames)
        self.module = DdcModel(config, capture.template, self.template, textures, initial)
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
        moves = list(self.module.refinement.parameters()) if self.module.refinement is not None else []
        return [
            {"params": list(self.module.network.parameters()), "lr": training.learning_rate},
            {"params": static + moves, "lr": training.base_learning_rate},
        ]

    def draw_training_views(self, frame: int, cameras: list[Camera], background: Tensor, step: int) -> Tensor:
        """The texture of the frame, drawn into each camera; the static texture alone while the warm-up lasts."""
        if frame not in self._posed:
            self._posed[frame] = self.template.pose(self._motion, frame)
            self._conditions[frame] = self.module.textures(self.template, self._motion, frame)
        texture = self._training_texture(frame, step)
        with torch.set_grad_enabled(step % VERTICES_EVERY == 0):
            posed = self.module.refined(self._posed[frame])
        return torch.stack([self.module.draw(texture, posed, c, background)[..., :3] for c in cameras])

    def _training_texture(self, frame: int, step: int) -> Float[Tensor, "3 t t"]:
        training = self.config.training
        if training.warmup == "static" and step < training.warmup_steps:
            return self.module.texture
        seen = unsettled(self._conditions[frame], training.texture_noise, seed=self.config.seed, step=step)
        return self.module.dynamic_texture(seen)

    @torch.no_grad()
    def render(self, motion: Motion, frame: int, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        posed, texture = self.dress(motion, frame, clock)
        with clock.stage("stg4"):
            return self.module.draw(texture, posed, camera, torch.zeros(3)).clamp(0, 1).numpy()

    @torch.no_grad()
    def dress(self, motion: Motion, frame: int, clock: StageClock) -> tuple[PosedTemplate, Float[Tensor, "3 t t"]]:
        """The posed template of a frame and its texture: everything but the picture.

        Training may leave negative colours between texels; no display knows those, and held-out views are better
        without them.
        """
        with clock.stage("stg1"):
            posed = self.module.refined(self.template.pose(motion, frame))
        with clock.stage("stg2"):
            conditions = self.module.textures(self.template, motion, frame)
        with clock.stage("stg3"):
            return posed, self.module.dynamic_texture(conditions).clamp(min=0)

    def open_display(self) -> Display:
        """OpenGL's picture of the avatar, as it would be shown."""
        from baselines.display import DdcDisplay

        return DdcDisplay(self)

    def template_vertices(self, motion: Motion, frame: int) -> np.ndarray:
        """The posed template, `[v, 3]` metres."""
        return self.module.refined(self.template.pose(motion, frame)).vertices.detach().numpy()

    def template_seconds(self) -> float | None:
        """What learning the template took, once for all methods that stand on it; None where it was not learned."""
        return None if self.template.learned is None else self.template.learned.seconds

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
    config = named(preset)
    mesh = ddc_config(config, seed=seed, template=config.template)
    texture = TEXTURE_FACTORS.get(preset, TEXTURE_FACTOR) * config.model.texels
    return DdcAvatar(replace(mesh, texture=texture), capture)


def ddc_truth(capture: Capture, *, seed: int, preset: str) -> DdcAvatar:
    """The mesh baseline on the exact surface: an oracle, to see when a mesh wins."""
    return DdcAvatar(ddc_config(named(preset), seed=seed, template=TemplateConfig(kind="exact")), capture)
