"""A DDC-style mesh avatar: the animatable template with a dynamic texture, rasterised.

Habermann et al., "Real-time Deep Dynamic Characters" (SIGGRAPH 2021), as ASH describes its competitor: the same learned
template as ASH, and a texture predicted from the motion-aware textures and the root translation. The mesh decides which
surface point a pixel sees; texture and light are learned through perspective-correct bilinear sampling and antialiased
coverage, and so is where its vertices lie: one displacement for all frames, and their deformation networks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

import ash.native.shading
from ash.capture.dataset import Camera, Capture, Pose, TemplateMesh
from ash.config import AshConfig, AtlasConfig, TemplateConfig, TrainingConfig, check_device, one_of
from ash.decoders import GLOBAL_FEATURES, GlobalFeatures, UNet, apart, as_batch, batched_inputs
from ash.devices import CPU, MovingModule, moved
from ash.files import InputError
from ash.gaussians.initialising import initial_texture
from ash.gaussians.texels import LIGHT_COEFFICIENTS
from ash.mesh.drawing import MeshView, draw_seen, see_mesh, textured, topology_of
from ash.model import stage
from ash.presets import MethodFactory, named, plus
from ash.protocol import Display, DressedMesh, StageClock
from ash.rotations import RigidTransforms
from ash.template.template import PosedTemplate, Template
from ash.template_learning.refining import MotionRefinement, Refinement
from ash.textures import DecoderInputs, TextureDrawer, build_lattice
from ash.trained_avatar import TrainedAvatar
from ash.training.batches import over
from ash.training.images import TrainingImages
from baselines.display import MeshDisplay, texture_gain

# Texture pixels per texel of ASH's lattice, per side: the mesh must not be starved. At 256x256 a body's pixel is 9 mm
# wide; 512 texture pixels are 3 mm apart, and more shows nothing.
TEXTURE_FACTOR = 4
GREY = 0.5  # Of a texture that starts from nothing.


@dataclass(frozen=True, kw_only=True, slots=True)
class DdcConfig:
    """The texture network sees what ASH's decoders see, at the same resolution and width."""

    texture: int  # pixels per side
    model: AtlasConfig
    training: TrainingConfig
    template: TemplateConfig
    refine: str  # images move the vertices: "static", alike in all frames; "motion", as a frame moves, too; "none"
    vertices_every: int = 4  # steps, of which one has a gradient in the vertices: its pictures take thrice as long
    seed: int
    device: str = "cpu"  # or "cuda", "cuda:1": where it learns and draws

    def __post_init__(self) -> None:
        """Refuse a texture that what is decoded cannot be shuffled up to."""
        if self.texture < 1 or self.texture % self.model.decoded_texels:
            raise InputError(f"texture: expected a multiple of {self.model.decoded_texels}, got {self.texture}")
        check_device(self.device)
        self.training.check_norm(self.model.norm)
        one_of("refine", self.refine, ("none", "static", "motion"))
        if self.vertices_every < 1:
            raise InputError(f"vertices_every: expected at least 1, got {self.vertices_every}")

    @property
    def shuffle(self) -> int:
        """Texture pixels per decoded one, per side."""
        return self.texture // self.model.decoded_texels


def ddc_config(ash: AshConfig, *, seed: int, template: TemplateConfig) -> DdcConfig:
    """DDC with the budget and the conditions of an ASH configuration.

    Where ASH learns static texels, it learns a static texture; it has no Gaussians that could be fitted to frames.
    """
    static = ash.training.warmup == "static"
    return DdcConfig(
        texture=TEXTURE_FACTOR * ash.model.texels,
        model=AtlasConfig(**{field.name: getattr(ash.model, field.name) for field in fields(AtlasConfig)}),
        training=ash.training if static else replace(ash.training, warmup="none", warmup_steps=0),
        template=template,
        refine="static" if template.kind != "exact" or template.error_mm > 0 else "none",
        seed=seed,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshInputs(DecoderInputs):
    """What Stg. 1 and 2 hand to the networks for one frame."""

    window: list[RigidTransforms]  # for the vertices' networks
    posed: PosedTemplate  # as the template has it, before images move its vertices


class DdcModel(MovingModule):
    """A static texture plus a residual that is predicted from the motion-aware textures; moved vertices."""

    def __init__(
        self, config: DdcConfig, mesh: TemplateMesh, template: Template, textures: TextureDrawer, initial: Tensor
    ) -> None:
        """`initial`: texture to start from, `[3, R, R]`."""
        super().__init__()
        self.config, self.template, self.textures = config, template, textures
        self.uv_faces = torch.from_numpy(mesh.uv_faces)
        self.uvs = torch.from_numpy(mesh.uvs).float()
        self.topology = topology_of(template.faces)
        self.base_texture = nn.Parameter(initial.clone(), requires_grad=config.model.base)
        self.refinement: Refinement | MotionRefinement | None = None
        if config.refine == "motion":
            self.refinement = MotionRefinement(config.template, mesh, template.skeleton)
        elif config.refine == "static":
            self.refinement = Refinement(mesh)
        self.phi = GlobalFeatures(config.model.global_mlp) if config.model.global_features else None
        self.network = UNet(
            6 * config.model.window,
            3 * config.shuffle**2,
            width=config.model.width,
            levels=config.model.levels,
            norm=config.model.norm,
            bottleneck_features=GLOBAL_FEATURES if config.model.global_features else 0,
        )
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if config.model.light else None

    @torch.no_grad()
    def frame_inputs(self, pose: Pose, clock: StageClock | None = None) -> MeshInputs:
        """Stg. 1 and 2: pose the template, and draw what the networks take."""
        device = self.base_texture.device
        with stage(clock, "stg1", device):
            posed = self.template.pose(pose)
        with stage(clock, "stg2", device):
            return MeshInputs(
                textures=self.textures(self.template, pose),
                root_translation=torch.from_numpy(pose.dofs[:3]).float().to(device),
                window=self.refinement.window(pose) if isinstance(self.refinement, MotionRefinement) else [],
                posed=posed,
            )

    def decode(self, inputs: Sequence[MeshInputs]) -> Float[Tensor, "b 3 t t"]:
        """Stg. 3: the textures of several frames, decoded as one batch at 1/shuffle of the resolution."""
        factor, decoded = self.config.shuffle, self.network(*batched_inputs(inputs, self.phi))
        if self.base_texture.dtype == torch.float32 and self.base_texture.device.type == "cpu":
            add = ash.native.shading.add_shuffled
            return as_batch([add(self.base_texture, added, factor) for added in apart(decoded)])
        return self.base_texture[None] + nn.functional.pixel_shuffle(decoded, factor)

    def residual(self, inputs: Sequence[MeshInputs]) -> Float[Tensor, "b 3 t t"]:
        """What the network adds to the base."""
        return nn.functional.pixel_shuffle(self.network(*batched_inputs(inputs, self.phi)), self.config.shuffle)

    def see(self, posed: PosedTemplate, cameras: list[Camera]) -> list[MeshView]:
        """What cameras of one size see of the posed mesh, whatever its texture."""
        return see_mesh(posed.vertices, self.topology, cameras)

    def rasterize(
        self, texture: Float[Tensor, "3 t t"], posed: PosedTemplate, views: list[MeshView], background: Tensor
    ) -> Float[Tensor, "c h w 4"]:
        """Rgb over `background`, and coverage. Differentiable in the texture, the light and the posed vertices.

        Outlines are blended while vertices learn, for the gradient's sake; what is shown counts samples.
        """
        shade = textured(texture, self.uvs, self.uv_faces, posed.normals, self.template.faces, self.light)
        return draw_seen(views, self.topology, shade, background, outlines=any(v.corners.requires_grad for v in views))

    def refined(self, inputs: MeshInputs) -> PosedTemplate:
        """The template with its vertices where the images moved them. The light keeps the normals that it had."""
        posed = inputs.posed
        if self.refinement is None:
            return posed
        follows = isinstance(self.refinement, MotionRefinement)
        canonical = posed.canonical + (self.refinement(inputs.window) if follows else self.refinement())
        return replace(posed, canonical=canonical, vertices=posed.transforms.apply(canonical))


class DdcAvatar(TrainedAvatar):
    """The Avatar protocol (see `ash.protocol`) for the mesh baseline."""

    config: DdcConfig
    module: DdcModel

    def __init__(self, config: DdcConfig, capture: Capture, template: Template) -> None:
        super().__init__(config, capture, template)
        torch.manual_seed(config.seed)
        initial = torch.full((3, config.texture, config.texture), GREY)
        if config.model.base:
            initial = initial_texture(capture, template, build_lattice(capture.template, config.texture))
        textures = TextureDrawer.of(config.model, build_lattice(capture.template, config.model.decoded_texels))
        textures.fit_normalization(template, capture.motion, capture.splits["train"].frames)
        self.module = DdcModel(config, capture.template, template, textures, initial).to(self.device)
        self.template = self.module.template

    @property
    def base(self) -> nn.Parameter:
        """A texture, `[3, t, t]`."""
        return self.module.base_texture

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Networks, and what is learned directly: texture, light, a displacement of the vertices; as ASH has it."""
        training, module = self.config.training, self.module
        nets = [*module.network.parameters(), *(module.phi.parameters() if module.phi is not None else ())]
        static = [p for p in (module.base_texture, module.light) if p is not None and p.requires_grad]
        if isinstance(module.refinement, MotionRefinement):
            nets += module.refinement.nets.networks()
            static.append(module.refinement.shared.rough)
        elif module.refinement is not None:
            static.append(module.refinement.rough)
        groups = (nets, training.learning_rate), (static, training.base_learning_rate)
        return [{"params": group, "lr": rate} for group, rate in groups]

    def _warm_up(self, images: TrainingImages) -> None:
        """Nothing: the texture starts from the training images."""

    def _draw(
        self, decoded: Tensor, inputs: MeshInputs, cameras: list[Camera], background: Tensor, step: int
    ) -> Tensor:
        with torch.set_grad_enabled(torch.is_grad_enabled() and step % self.config.vertices_every == 0):
            posed = self.module.refined(inputs)
        views = self.module.see(posed, cameras)
        return self._rasterize(decoded, posed, views, background)

    def _rasterize(self, texture: Tensor, posed: PosedTemplate, views: list[MeshView], background: Tensor) -> Tensor:
        behind = background if background.ndim == 1 else background.new_zeros(3)
        drawn = self.module.rasterize(texture, posed, views, behind)
        return drawn[..., :3] if background.ndim == 1 else over(drawn[..., :3], drawn[..., 3], background)

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        posed, texture = self.dress(pose, clock)
        with stage(clock, "stg4", self.device):
            drawn = self.module.rasterize(texture, posed, self.module.see(posed, [camera]), texture.new_zeros(3))
            return drawn[0].clamp(0, 1).cpu().numpy()

    @torch.no_grad()
    def dress(self, pose: Pose, clock: StageClock) -> tuple[PosedTemplate, Float[Tensor, "3 t t"]]:
        """The posed template of a frame and its texture: everything but the picture.

        Training may leave negative colours between texels; no display knows those, and held-out views are better
        without them.
        """
        inputs = self.module.frame_inputs(pose, clock)
        with stage(clock, "stg3", self.device):
            (texture,) = self.module.decode([inputs])
            return self.module.refined(inputs), texture.clamp(min=0)

    @torch.no_grad()
    def dressed_mesh(self, pose: Pose) -> DressedMesh:
        """The posed mesh with the texture of the frame, lit as at the texels' normals."""
        posed, texture = moved(self.dress(pose, StageClock()), CPU)
        mesh, light = self.template.mesh, moved(self.module.light, CPU)
        lit = texture * texture_gain(light, posed.normals, mesh, self.config.texture)
        return DressedMesh(
            vertices=posed.vertices.numpy(),
            normals=posed.normals.numpy(),
            faces=mesh.faces,
            uvs=mesh.uvs.astype(np.float32),
            uv_faces=mesh.uv_faces,
            texture=(255 * lit.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy(),
        )

    def open_display(self) -> Display:
        """OpenGL's picture of the avatar, as it would be shown."""
        m = self.module
        return MeshDisplay(self.dress, faces=m.template.faces, uvs=m.uvs, uv_faces=m.uv_faces, light=m.light)

    def template_vertices(self, pose: Pose) -> np.ndarray:
        """The posed template, `[v, 3]` metres."""
        if self.module.refinement is None:
            return self.template.pose(pose).vertices.cpu().numpy()
        return self.module.refined(self.module.frame_inputs(pose)).vertices.detach().cpu().numpy()

    def gaussian_means(self, pose: Pose) -> np.ndarray:
        """A mesh has none."""
        return np.zeros((0, 3))

    def gaussian_count(self) -> int:
        """A mesh has none."""
        return 0


def _of_preset(preset: str) -> DdcConfig:
    return ddc_config(named(preset), seed=0, template=named(preset).template)


def _plus(preset: str) -> DdcConfig:
    ash = plus(preset, without="narrow")
    return ddc_config(ash, seed=0, template=ash.template)


def _on_exact(preset: str) -> DdcConfig:
    return ddc_config(named(preset), seed=0, template=TemplateConfig(kind="exact"))


ddc = MethodFactory(config=_of_preset, build=DdcAvatar.from_capture)  # On the template that `ash` gets.
# With what `ash_plus` adds, as far as a mesh can have it: static texture, light, and how textures are seen.
ddc_plus = MethodFactory(config=_plus, build=DdcAvatar.from_capture)
# An oracle on the exact surface, to see when a mesh wins.
ddc_truth = MethodFactory(config=_on_exact, build=DdcAvatar.from_capture)
