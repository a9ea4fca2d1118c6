"""A DDC-style mesh avatar: the animatable template with a dynamic texture, rasterised.

Habermann et al., "Real-time Deep Dynamic Characters" (SIGGRAPH 2021), as ASH describes its competitor: the same learned
template as ASH, and a texture predicted from the motion-aware textures and the root translation. The mesh decides which
surface point a pixel sees; texture and light are learned through perspective-correct bilinear sampling and antialiased
coverage, and so is where its vertices lie: one displacement for all frames, and their deformation networks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor, nn

import ash.native.shading
from ash.bounded_cache import BoundedCache
from ash.capture.dataset import Camera, Capture, Pose, TemplateMesh
from ash.checkpoints import contiguous_state, load_module, read_safetensors
from ash.config import AshConfig, AtlasConfig, TemplateConfig, TrainingConfig, check_device, one_of
from ash.decoders import GLOBAL_FEATURES, GlobalFeatures, UNet, apart, decoding_in, decoding_precision, seen_together
from ash.devices import CPU, MovingModule, device_named, moved
from ash.files import InputError, write_atomic
from ash.gaussians.initialising import initial_texture
from ash.gaussians.texels import LIGHT_COEFFICIENTS
from ash.mesh.drawing import MeshView, draw_seen, see_mesh, textured, topology_of
from ash.model import stage
from ash.presets import MethodFactory, named
from ash.protocol import Display, DressedMesh, StageClock, TrainingOutcome
from ash.rotations import RigidTransforms
from ash.template.template import PosedTemplate, Template
from ash.template_learning.learning import template_of, with_template
from ash.template_learning.refining import MotionRefinement, Refinement
from ash.textures import DecoderInputs, TextureDrawer, add_texture_noise_to_frames, build_lattice
from ash.training.batches import over
from ash.training.images import load_training_images, training_part
from ash.training.loop import fit
from baselines.display import MeshDisplay, texture_gain

# Texture pixels per Gaussian of ASH's lattice, per side: the mesh must not be starved. At 256x256 a body's pixel is
# 9 mm wide, twice 256 texels are 3 mm apart and more shows nothing; at full size pixels of 2.5 mm ask for four times.
TEXTURE_FACTOR = 2
GREY = 0.5  # Of a texture that starts from nothing.
TEXTURE_FACTORS = {"paper": 4, "official": 4}


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
    """DDC with the budget and the conditions of an ASH preset."""
    return DdcConfig(
        texture=TEXTURE_FACTOR * ash.model.texels,
        model=AtlasConfig(**{field.name: getattr(ash.model, field.name) for field in fields(AtlasConfig)}),
        training=ash.training,
        template=template,
        refine="static" if template.kind != "exact" or template.error_mm > 0 else "none",
        seed=seed,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class MeshInputs(DecoderInputs):
    """What the networks see of a frame."""

    window: list[RigidTransforms]  # for the vertices' networks


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
        self.texture = nn.Parameter(initial.clone(), requires_grad=config.model.base)
        self.static_texture = (
            nn.Parameter(initial.clone()) if config.model.novelty_scale else None
        )  # far from training motion
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
    def frame_inputs(self, pose: Pose) -> MeshInputs:
        """Stg.2: draw what the networks see."""
        textures = self.textures(self.template, pose)
        return MeshInputs(
            textures=textures,
            decoder_weight=self.textures.decoder_weight(textures),
            root_translation=torch.from_numpy(pose.dofs[:3]).float().to(self.texture.device),
            window=self.refinement.window(pose) if isinstance(self.refinement, MotionRefinement) else [],
        )

    def dynamic_texture(self, conditions: MeshInputs) -> Float[Tensor, "3 t t"]:
        """The texture of a frame, blended with a static one by `TextureDrawer.decoder_weight`."""
        (texture,) = self.corrected_textures([conditions])
        return texture if self.static_texture is None else self.static_texture.lerp(texture, conditions.decoder_weight)

    def corrected_textures(self, frames: Sequence[MeshInputs]) -> list[Float[Tensor, "3 t t"]]:
        """The texture with what the network adds in each frame; frames are decoded together."""
        factor, decoded = self.config.shuffle, self._decoded(frames)
        if self.texture.dtype == torch.float32 and self.texture.device.type == "cpu":
            return [ash.native.shading.add_shuffled(self.texture, added, factor) for added in decoded]
        return [self.texture + nn.functional.pixel_shuffle(added, factor) for added in decoded]

    def correction(self, conditions: MeshInputs) -> Float[Tensor, "3 t t"]:
        """What the network adds: decoded at the resolution of the motion-aware textures and shuffled up."""
        return nn.functional.pixel_shuffle(self._decoded([conditions])[0], self.config.shuffle)

    def _decoded(self, frames: Sequence[MeshInputs]) -> Sequence[Float[Tensor, "o r r"]]:
        return apart(self.network(*seen_together(frames, self.phi)))

    def see(self, posed: PosedTemplate, cameras: list[Camera]) -> list[MeshView]:
        """What cameras of one size see of the posed mesh, whatever its texture."""
        return see_mesh(posed.vertices, self.topology, cameras)

    def draw(
        self, texture: Float[Tensor, "3 t t"], posed: PosedTemplate, views: list[MeshView], background: Tensor
    ) -> Float[Tensor, "c h w 4"]:
        """Rgb over `background`, and coverage. Differentiable in the texture, the light and the posed vertices.

        Outlines are blended while vertices learn, for the gradient's sake; what is shown counts samples.
        """
        shade = textured(texture, self.uvs, self.uv_faces, posed.normals, self.template.faces, self.light)
        return draw_seen(views, self.topology, shade, background, outlines=any(v.corners.requires_grad for v in views))

    def refined(self, posed: PosedTemplate, conditions: MeshInputs) -> PosedTemplate:
        """The template with its vertices where the images moved them. The light keeps the normals that it had."""
        if self.refinement is None:
            return posed
        seen = (conditions.window, conditions.decoder_weight) if isinstance(self.refinement, MotionRefinement) else ()
        canonical = posed.canonical + self.refinement(*seen)
        return replace(posed, canonical=canonical, vertices=posed.transforms.apply(canonical))


class DdcAvatar:
    """The Avatar protocol (see `ash.protocol`) for the mesh baseline."""

    def __init__(self, config: DdcConfig, capture: Capture) -> None:
        capture = training_part(capture, config.training)
        self.device = device_named(config.device)
        self.template = template_of(config.template, capture, seed=config.seed, device=self.device)
        torch.manual_seed(config.seed)
        self.config = config
        initial = torch.full((3, config.texture, config.texture), GREY)
        if config.model.base:
            initial = initial_texture(capture, self.template, build_lattice(capture.template, config.texture))
        textures = TextureDrawer(
            build_lattice(capture.template, config.model.decoded_texels),
            window=config.model.window,
            yaw_normalise=config.model.yaw_normalise,
            standardise=config.model.standardise,
            bound=config.model.bound,
            novelty_scale=config.model.novelty_scale,
        )
        textures.fit_normalization(self.template, capture.motion, capture.splits["train"].frames)
        self.module = DdcModel(config, capture.template, self.template, textures, initial).to(self.device)
        self.template = self.module.template
        self._motion = capture.motion
        self._outcome: TrainingOutcome | None = None
        self._seen: tuple[Tensor, list[Camera], list[MeshView]] = (torch.empty(0), [], [])  # vertices drawn last
        # The template is frozen: each training frame is posed once, as far as there is room.
        self._inputs: BoundedCache[int, MeshInputs] = BoundedCache(
            lambda frame: self.module.frame_inputs(Pose(capture.motion, frame))
        )
        self._posed: BoundedCache[int, PosedTemplate] = BoundedCache(
            lambda frame: self.template.pose(Pose(capture.motion, frame))
        )

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Train texture and network on the training images; see `ash.training.loop.fit`."""
        images = load_training_images(training_part(capture, self.config.training), self.device)
        outcome = fit(self, images, self.config.training, seed=self.config.seed, folder=folder)
        self._outcome = replace(outcome, precision=self._precision)

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Networks, and what is learned directly: texture, light, a displacement of the vertices; as ASH has it."""
        training, module = self.config.training, self.module
        nets = [*module.network.parameters(), *(module.phi.parameters() if module.phi is not None else ())]
        static = [p for p in (module.texture, module.static_texture, module.light) if p is not None and p.requires_grad]
        if isinstance(module.refinement, MotionRefinement):
            nets += module.refinement.nets.networks()
            static.append(module.refinement.shared.rough)
        elif module.refinement is not None:
            static.append(module.refinement.rough)
        groups = (nets, training.learning_rate), (static, training.base_learning_rate)
        return [{"params": group, "lr": rate} for group, rate in groups]

    def draw_training_views(
        self, frame: int, cameras: list[Camera], background: Tensor, step: int, decoded: Tensor
    ) -> Tensor:
        """The texture of the frame, drawn into each camera."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and step % self.config.vertices_every == 0):
            posed = self._refined(frame)
        views = self.module.see(posed, cameras)
        self._seen = posed.vertices.detach(), cameras, [replace(v, corners=v.corners.detach()) for v in views]
        return self._drawn(decoded, posed, views, background)

    def draw_static_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Tensor | None:
        """Views with the texture that counts far from the training motion; its vertices are not its own."""
        if (static := self.module.static_texture) is None:
            return None
        with torch.no_grad():
            posed = self._refined(frame)
        vertices, by, views = self._seen
        if by is not cameras or not torch.equal(vertices, posed.vertices):
            views = self.module.see(posed, cameras)
        return self._drawn(static, posed, views, background)

    @torch.no_grad()
    def end_warmup(self) -> None:
        """Let the static texture start from what the warm-up made."""
        if self.module.static_texture is not None:
            self.module.static_texture.copy_(self.module.texture)

    def _drawn(self, texture: Tensor, posed: PosedTemplate, views: list[MeshView], background: Tensor) -> Tensor:
        drawn = self.module.draw(texture, posed, views, background if background.ndim == 1 else background.new_zeros(3))
        return drawn[..., :3] if background.ndim == 1 else over(drawn[..., :3], drawn[..., 3], background)

    def decoder_residual(self, frame: int) -> Tensor | None:
        """What the network adds to the static texture in a training frame, `[3, t, t]`."""
        return self.module.correction(self._inputs[frame])

    def _refined(self, frame: int) -> PosedTemplate:
        return self.module.refined(self._posed[frame], self._inputs[frame])

    def decode_together(self, frames: Sequence[int], step: int) -> list[Float[Tensor, "3 t t"]]:
        """The textures of a step's frames; the static texture alone while the warm-up lasts."""
        training = self.config.training
        if step < training.static_steps:
            return [self.module.texture] * len(frames)
        seen = [self._inputs[frame] for frame in frames]
        noisy = add_texture_noise_to_frames(seen, training.texture_noise, seed=self.config.seed, step=step)
        with decoding_in(self._precision, self.device):
            return [texture.float() for texture in self.module.corrected_textures(noisy)]

    @property
    def _precision(self) -> str:
        return decoding_precision(self.config.training.precision, self.device, self.config.model.width)

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        posed, texture = self.dress(pose, clock)
        with stage(clock, "stg4", self.device):
            drawn = self.module.draw(texture, posed, self.module.see(posed, [camera]), texture.new_zeros(3))
            return drawn[0].clamp(0, 1).cpu().numpy()

    @torch.no_grad()
    def dress(self, pose: Pose, clock: StageClock) -> tuple[PosedTemplate, Float[Tensor, "3 t t"]]:
        """The posed template of a frame and its texture: everything but the picture.

        Training may leave negative colours between texels; no display knows those, and held-out views are better
        without them.
        """
        with stage(clock, "stg1", self.device):
            posed = self.template.pose(pose)
        with stage(clock, "stg2", self.device):
            conditions = self.module.frame_inputs(pose)
        with stage(clock, "stg3", self.device):
            return self.module.refined(posed, conditions), self.module.dynamic_texture(conditions).clamp(min=0)

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
        posed = self.template.pose(pose)
        if self.module.refinement is None:
            return posed.vertices.cpu().numpy()
        return self.module.refined(posed, self.module.frame_inputs(pose)).vertices.detach().cpu().numpy()

    def outcome(self) -> TrainingOutcome | None:
        """How training ended; None before it did."""
        return with_template(self._outcome, self.template)

    def template_seconds(self) -> float | None:
        """What learning the template took, once for all methods that stand on it; None where it was not learned."""
        return None if self.template.learned is None else self.template.learned.seconds

    def gaussian_means(self, pose: Pose) -> np.ndarray:
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
        write_atomic(path, safetensors.torch.save(contiguous_state(self.module)))

    def load(self, path: Path) -> None:
        """Read the weights that `save` wrote."""
        load_module(self.module, read_safetensors(path)[0], path)


def _of_preset(preset: str) -> DdcConfig:
    config = named(preset)
    texture = TEXTURE_FACTORS.get(preset, TEXTURE_FACTOR) * config.model.texels
    return replace(ddc_config(config, seed=0, template=config.template), texture=texture)


def _on_exact(preset: str) -> DdcConfig:
    return ddc_config(named(preset), seed=0, template=TemplateConfig(kind="exact"))


ddc = MethodFactory(config=_of_preset, build=DdcAvatar)  # On the template that ASH gets.
ddc_truth = MethodFactory(config=_on_exact, build=DdcAvatar)  # An oracle on the exact surface, to see when a mesh wins.
