"""The ASH avatar, in the paper's order: template, textures, decoders, skinning, splatting. START READING HERE."""

from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.config import ModelConfig
from ash.dataset import Camera, Motion
from ash.decoders import GEOMETRY_CHANNELS
from ash.gaussians import Gaussians
from ash.harmonics import SH_C0, rotate_sh, sh_basis
from ash.protocol import StageClock
from ash.skinning import quat_multiply
from ash.splatting import Splatted, splat
from ash.template import Template
from ash.textures import (
    Conditions,
    TexelLattice,
    build_lattice,
    motion_aware_textures,
    normalised_motion,
    texture_statistics,
)

# Metres per unit of a decoder's output: offsets are centimetres, so that all outputs are of order one.
OFFSET_UNIT = 0.01
LIGHT_COEFFICIENTS = 9


class AshModel(nn.Module):
    """The learned part of ASH, and how the stages are joined. `base` and `light` are not in the paper."""

    def __init__(
        self,
        config: ModelConfig,
        template: Template,
        lattice: TexelLattice,
        initial: Float[Tensor, "n o"],
        decoders: nn.Module | None,
    ) -> None:
        """`initial`: raw parameters per texel, to which the decoders add theirs; no decoders: they are all there is.

        Decoders map `Conditions` to `[n, o]`; those of the paper are `ash.decoders.Decoders`.
        """
        super().__init__()
        self.config = config
        self.template = template
        self.lattice = lattice
        self.decoder_lattice = lattice if config.shuffle == 1 else build_lattice(template.mesh, config.decoded_texels)
        if decoders is not None and config.standardise:
            blank = torch.zeros(6 * config.window, config.decoded_texels, config.decoded_texels)
            self.register_buffer("texture_mean", blank)
            self.register_buffer("texture_deviation", torch.ones(6 * config.window, 1, 1))
        self.base = nn.Parameter(initial.clone(), requires_grad=config.base)
        self.decoders = decoders
        self.light = nn.Parameter(torch.zeros(LIGHT_COEFFICIENTS, 3)) if config.light else None

    def conditions(self, motion: Motion, frame: int, clock: StageClock | None = None) -> Conditions:
        """Stg.1 and Stg.2: pose the template, and draw what the decoders see."""
        with _stage(clock, "stg1"):
            posed = self.template.pose(motion, frame)
        with _stage(clock, "stg2"):
            return Conditions(
                textures=self._textures(motion, frame),
                motion=normalised_motion(motion, frame, window=self.config.window),
                root_translation=torch.from_numpy(motion.dofs[frame, :3]).float(),
                canonical=self.lattice.interpolate(posed.canonical),
                normals=nn.functional.normalize(self.lattice.interpolate(posed.normals), dim=-1),
                transforms=self.lattice.interpolate_transforms(posed.transforms),
            )

    def observe(self, motion: Motion, frames: tuple[int, ...]) -> None:
        """Take the statistics of the textures that `standardise` refers to, from training frames."""
        if self.decoders is not None and self.config.standardise:
            drawn = [self._raw_textures(motion, frame) for frame in frames]
            self.texture_mean, self.texture_deviation = texture_statistics(drawn)

    def _textures(self, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        if self.decoders is None:
            return torch.zeros(0, 1, 1)
        textures = self._raw_textures(motion, frame)
        return (textures - self.texture_mean) / self.texture_deviation if self.config.standardise else textures

    def _raw_textures(self, motion: Motion, frame: int) -> Float[Tensor, "c r r"]:
        return motion_aware_textures(
            self.template,
            self.decoder_lattice,
            motion,
            frame,
            window=self.config.window,
            yaw_normalise=self.config.yaw_normalise,
        )

    def decode(self, conditions: Conditions, *, static: bool = False) -> Float[Tensor, "n o"]:
        """Stg.3: raw Gaussian parameters per texel. `static` leaves the decoders out (the warm-up of the base)."""
        if self.decoders is None or static:
            return self.base
        return self.base + self.decoders(conditions)

    def pose(self, raw: Float[Tensor, "n o"], conditions: Conditions) -> Gaussians:
        """Activate the raw parameters and carry them from canonical to posed space (Eq. 5)."""
        offset, log_scales, quats, logits, sh = split_raw(raw)
        transforms = conditions.transforms
        canonical = conditions.canonical + OFFSET_UNIT * offset if self.config.offset else conditions.canonical
        if self.config.quat_frame == "canonical":
            quats = quat_multiply(transforms.quats, quats)
            sh = rotate_sh(transforms.quats, sh)
        if self.light is not None:
            sh = _lit(sh, (sh_basis(conditions.normals, 2) @ self.light).exp())
        return Gaussians(
            means=transforms.apply(canonical),
            quats=quats,
            scales=log_scales.exp(),
            opacities=logits.sigmoid(),
            sh=sh,
        )

    def draw(
        self, gaussians: Gaussians, cameras: list[Camera], background: Tensor | None, threads: int = 1
    ) -> Splatted:
        """Stg.4: splat into cameras of one size."""
        return splat(
            gaussians,
            viewmats=torch.stack([torch.from_numpy(c.viewmat).float() for c in cameras]),
            Ks=torch.stack([torch.from_numpy(c.K).float() for c in cameras]),
            width=cameras[0].width,
            height=cameras[0].height,
            background=background,
            dilation=self.config.dilation,
            threads=threads,
        )

    def forward(self, motion: Motion, frame: int, camera: Camera, clock: StageClock | None = None) -> Splatted:
        """Motion and camera to image: the whole of ASH, over black."""
        conditions = self.conditions(motion, frame, clock)  # Stg.1, Stg.2
        with _stage(clock, "stg3"):
            raw = self.decode(conditions)
        with _stage(clock, "stg4"):
            gaussians = self.pose(raw, conditions)
            return self.draw(gaussians, [camera], None)


def split_raw(raw: Float[Tensor, "n o"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Raw parameters as offset `[n, 3]` (cm), log-scale `[n, 3]`, quaternion `[n, 4]`, logit `[n]`, SH `[n, k, 3]`."""
    offset, log_scales, quats, logits = raw[:, :GEOMETRY_CHANNELS].split([3, 3, 4, 1], dim=1)
    return offset, log_scales, quats, logits.squeeze(1), raw[:, GEOMETRY_CHANNELS:].unflatten(1, (-1, 3))


def _lit(sh: Float[Tensor, "n k 3"], gain: Float[Tensor, "n 3"]) -> Float[Tensor, "n k 3"]:
    """Multiply the colour 0.5 + sum_k sh_k Y_k by a gain, in its coefficients."""
    constant = 0.5 / SH_C0 * (gain - 1)
    return torch.cat([sh[:, :1] * gain[:, None] + constant[:, None], sh[:, 1:] * gain[:, None]], 1)


def _stage(clock: StageClock | None, name: str) -> AbstractContextManager[None]:
    return clock.stage(name) if clock is not None else nullcontext()
