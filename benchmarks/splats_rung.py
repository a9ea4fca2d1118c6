"""The first rung, `splats`: images of known texel Gaussians, so that no model error is left. ASH must recover them.

It is drawn here and not in `synth`, which makes the truth that the splatter is judged by and so must not know it.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ash.avatar import AshModel
from ash.config import ModelConfig
from ash.dataset import (
    SCHEMA,
    Camera,
    Motion,
    image_path,
    surface_path,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.files import hash_of, sha256_of, write_arrays, write_image, write_json
from ash.initialising import DISC_SCALE, DISC_THICKNESS, blank_gaussians, texel_pitch
from ash.skinning import rotmat_to_unitquat
from ash.template import RestDeformation, Template, vertex_normals
from ash.textures import TexelLattice, build_lattice

SCENE = "splats"
CI_TEXELS, TEXELS = 64, 256  # As the presets have at these sizes: the very Gaussians can be recovered.
VERSION = 1


def draw_capture(folder: Path, *, size: str, seed: int) -> None:
    """Write the capture, unless it is there: the mannequin of `skinned`, its cameras and motions, made of Gaussians.

    Frames are posed by skinning the rest template, which is therefore exact; what every Gaussian looks like depends on
    nothing. A killed run leaves no manifest and is done again.
    """
    from synth.capture import make_body, splits
    from synth.motion import make_motion
    from synth.presets import skinned
    from synth.rig import make_cameras
    from synth.scene import stream

    scene = replace(skinned(size=size, seed=seed), name=SCENE, body="mannequin")
    identity = hash_of([VERSION, scene.parameters])
    if (folder / "manifest.json").is_file():
        return
    body = make_body(scene)
    motion = make_motion(body.skeleton, scene.train + scene.test, fps=scene.fps, seed=stream(scene, "motion"))
    model = known_avatar(
        Template(body.template(), body.skeleton, RestDeformation(body.template())),
        texels=CI_TEXELS if size == "ci" else TEXELS,
        seed=seed,
    )
    posed = np.stack([model.template.pose(motion, frame).vertices.numpy() for frame in range(len(motion.dofs))])
    cameras = make_cameras(scene.rig, posed.reshape(-1, 3).astype(np.float64))
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_motion(folder / "motion.npz", motion)
    write_template(folder / "template.npz", body.template())
    write_arrays(folder / "truth" / "template.npz", vertices=posed.astype(np.float64))
    write_arrays(folder / "truth" / "surface.npz", faces=body.template().faces.astype(np.int32))
    for frame, vertices in enumerate(posed):
        write_arrays(surface_path(folder, frame), vertices=vertices)
    write_cameras(folder / "cameras.json", cameras)
    parts = splits(scene)
    by_name = {camera.name: camera for camera in cameras}
    for name, frame in sorted({view for split in parts.values() for view in split.views}):
        write_image(image_path(folder, name, frame), draw_view(model, motion, frame, by_name[name]))
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    manifest = {
        "schema": SCHEMA,
        "scene": SCENE,
        "size": size,
        "seed": seed,
        "identity": identity,
        "splits": {n: {"cameras": list(s.cameras), "frames": list(s.frames)} for n, s in parts.items()},
        "files": {name: sha256_of(folder / name) for name in names},
        "complete": True,
    }
    write_json(folder / "manifest.json", manifest)


def known_avatar(template: Template, *, texels: int, seed: int) -> AshModel:
    """Texel Gaussians that no training has touched, on a template: discs of many sizes, colours, opacities, offsets."""
    config = ModelConfig(
        texels=texels, window=1, yaw_normalise=True, levels=0, motion=False, base=True, sh_degree=0, dilation=0.05
    )
    lattice = build_lattice(template.mesh, texels)
    return AshModel(config, template, lattice, _known_gaussians(config, template, lattice, seed), None)


def _known_gaussians(config: ModelConfig, template: Template, lattice: TexelLattice, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    rest = torch.from_numpy(template.mesh.vertices).float()
    count = len(lattice.texels)
    places, pitch = lattice.interpolate(rest), texel_pitch(lattice, rest)
    normals = torch.nn.functional.normalize(lattice.interpolate(vertex_normals(rest, template.faces)), dim=-1)
    raw = blank_gaussians(config, count, 1.0)
    raw[:, :3] = 0.2 * _waves(places, 3, 0.1, generator)  # centimetres
    raw[:, 3:6] = (DISC_SCALE * pitch).log()[:, None] + 0.1 * torch.randn(count, 3, generator=generator)
    raw[:, 5] += math.log(DISC_THICKNESS)
    helper = torch.eye(3)[normals.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=-1)
    raw[:, 6:10] = rotmat_to_unitquat(torch.stack([first, torch.linalg.cross(normals, first), normals], -1))
    raw[:, 10] = 2 + _waves(places, 1, 0.2, generator)[:, 0]
    # Colours that change from texel to texel and along the body; 0.5 plus 0.28 times them stays within 0 and 1.
    raw[:, 11:14] = 0.5 * _waves(places, 3, 0.06, generator) + 0.15 * torch.randn(count, 3, generator=generator)
    return raw


def _waves(places: Tensor, channels: int, length_m: float, generator: torch.Generator) -> Tensor:
    """Smooth random functions over space, of variance one: a sum of waves."""
    count = 32
    directions = torch.randn(3, count, generator=generator) / length_m
    phases = 2 * math.pi * torch.rand(count, generator=generator)
    return (
        torch.cos(places @ directions + phases) @ torch.randn(count, channels, generator=generator) / (count / 2) ** 0.5
    )


@torch.no_grad()
def draw_view(model: AshModel, motion: Motion, frame: int, camera: Camera) -> np.ndarray:
    """RGBA of a view, uint8 `[h, w, 4]`, straight alpha."""
    drawn = model(motion, frame, camera)
    colour = drawn.rgb[0] / drawn.alpha[0].clamp(min=1e-3)[..., None]
    return (torch.cat([colour, drawn.alpha[0, ..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
