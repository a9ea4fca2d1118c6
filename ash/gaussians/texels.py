"""Eq. 4 and 5 at the texels: what a texel takes from its triangle, and from raw parameters to posed Gaussians.

`sample_surface_naive` and `pose_naive` are the definitions in plain torch; `sample_surface` and `pose` compute the same
by native kernels.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

import ash.native.skinning
import ash.native.texels
from ash.config import ModelConfig
from ash.gaussians.gaussians import Gaussians, split_raw
from ash.harmonics import SH_C0, rotate_sh, sh_basis
from ash.rotations import RigidTransforms, quat_multiply
from ash.template.skinning import dual_parts
from ash.template.template import PosedTemplate
from ash.textures import FrameInputs, TexelLattice

LIGHT_COEFFICIENTS = 9


Placed = tuple[Tensor, Tensor, RigidTransforms]


def sample_surface_naive(lattice: TexelLattice, posed: PosedTemplate) -> Placed:
    """The template's surface at the texels: the definition, differentiable.

    Positions `[n, 3]` on the canonical template (metres, Eq. 4), unit normals `[n, 3]` in the world, and the
    transforms T of Eq. 5. Blended transforms leave a texel beside the posed triangle that it belongs to, by a third of
    a millimetre, and by ten where a joint is bent far.
    """
    canonical = lattice.interpolate(posed.canonical)
    normals = nn.functional.normalize(lattice.interpolate(posed.normals), dim=-1)
    return canonical, normals, lattice.interpolate_transforms(posed.transforms)


def sample_surface(lattice: TexelLattice, posed: PosedTemplate, *, threads: int = 1) -> Placed:
    """`sample_surface_naive`, by native kernels where nothing needs a gradient."""
    transforms = posed.transforms
    if not ash.native.skinning.can_use_native(
        posed.canonical, posed.normals, transforms.quats, transforms.translations
    ):
        return sample_surface_naive(lattice, posed)
    dual = dual_parts(transforms)
    blank = dual.new_zeros(len(dual), 2)
    vertices = torch.cat([transforms.quats, dual, posed.canonical, posed.normals, blank], 1)
    quats, translations, canonical, normals = ash.native.texels.place_texels(
        vertices, lattice.corners.int(), lattice.barycentric, threads=threads
    )
    return canonical, normals, RigidTransforms(quats=quats, translations=translations)


def pose_naive(
    raw: Float[Tensor, "n o"], inputs: FrameInputs, config: ModelConfig, light: Float[Tensor, "9 3"] | None
) -> Gaussians:
    """Activate raw parameters and carry them from canonical to posed space (Eq. 5): the definition.

    `light`: coefficients of the exponent by which colours are multiplied, a function of the posed normal.
    """
    offset, log_scales, quats, logits, sh = split_raw(raw)
    transforms = inputs.transforms
    canonical = inputs.canonical + config.offset_unit_m * offset if config.offset else inputs.canonical
    if config.quat_frame == "canonical":
        quats = quat_multiply(transforms.quats, quats)
        sh = rotate_sh(transforms.quats, sh)
    if light is not None:
        sh = _lit(sh, (sh_basis(inputs.normals, 2) @ light).exp())
    return Gaussians(
        means=transforms.apply(canonical),
        quats=quats,
        scales=log_scales.exp(),
        opacities=logits.sigmoid(),
        sh=sh,
    )


def pose(
    raw: Float[Tensor, "n o"],
    inputs: FrameInputs,
    config: ModelConfig,
    light: Float[Tensor, "9 3"] | None,
    *,
    threads: int = 1,
) -> Gaussians:
    """`pose_naive`, by native kernels where only `raw` and `light` need gradients."""
    transforms = inputs.transforms
    constants = (inputs.canonical, inputs.normals, transforms.quats, transforms.translations)
    if raw.dtype != torch.float32 or not ash.native.skinning.can_use_native(*constants):
        return pose_naive(raw, inputs, config, light)
    canonical_frame = config.quat_frame == "canonical"
    options = ash.native.texels.PoseOptions(
        config.offset_unit_m if config.offset else 0.0, int(canonical_frame), threads
    )
    contiguous = tuple(tensor.contiguous() for tensor in constants)
    means, quats, scales, opacities, sh = ash.native.texels.pose(raw.contiguous(), light, contiguous, options)
    if canonical_frame and sh.shape[1] > 1:
        # Lit first: a gain turns nothing, and the constant is the same turned.
        sh = ash.native.texels.turn_sh(contiguous[2], sh, threads=threads)
    return Gaussians(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)


def _lit(sh: Float[Tensor, "n k 3"], gain: Float[Tensor, "n 3"]) -> Float[Tensor, "n k 3"]:
    """Multiply the colour 0.5 + sum_k sh_k Y_k by a gain, in its coefficients."""
    constant = 0.5 / SH_C0 * (gain - 1)
    return torch.cat([sh[:, :1] * gain[:, None] + constant[:, None], sh[:, 1:] * gain[:, None]], 1)
