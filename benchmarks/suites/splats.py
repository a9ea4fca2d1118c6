"""The first rung, `splats`: images of known texel Gaussians, so that no model error is left. ASH must recover them.

It is drawn here and not in `synth`, which makes the truth that the splatter is judged by and so must not know it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ash.capture.dataset import Camera, Motion, Pose, Skeleton, TemplateMesh, image_path, surface_path
from ash.capture.formats import write_cameras, write_motion, write_skeleton, write_template
from ash.capture.manifest import Manifest, hash_files, is_capture
from ash.config import ModelConfig
from ash.files import hash_of, write_arrays, write_image
from ash.gaussians.initialising import DISC_SCALE, DISC_THICKNESS, blank_gaussians, texel_pitch
from ash.model import AshModel
from ash.rotations import rotmat_to_unitquat
from ash.template.template import RestDeformation, Template, vertex_normals
from ash.textures import TexelLattice, build_lattice
from synth.capture import WantedView, make_body, splits
from synth.scene import Scene

CI_TEXELS, TEXELS = 64, 256  # As the presets have at these sizes: the very Gaussians can be recovered.
VERSION = 1


def identity(scene: Scene) -> str:
    """Hash of everything that decides what is drawn."""
    return hash_of([VERSION, scene.parameters])


def draw_capture(scene: Scene, folder: Path) -> None:
    """Write the capture, unless it is there: the scene's body, made of Gaussians.

    Frames are posed by skinning the rest template, which is therefore exact; what every Gaussian looks like depends on
    nothing. A killed run leaves no manifest and is done again.
    """
    if is_capture(folder):
        return
    made = _person(scene)
    write_skeleton(folder / "skeleton.json", made.skeleton)
    write_motion(folder / "motion.npz", made.motion)
    write_template(folder / "template.npz", made.mesh)
    write_arrays(folder / "truth" / "template.npz", vertices=made.posed.astype(np.float64))
    write_arrays(folder / "truth" / "surface.npz", faces=made.mesh.faces.astype(np.int32))
    for frame, vertices in enumerate(made.posed):
        write_arrays(surface_path(folder, frame), vertices=vertices)
    write_cameras(folder / "cameras.json", list(made.cameras.values()))
    parts = splits(scene)
    for name, frame in sorted({view for split in parts.values() for view in split.views}):
        image = draw_view(made.model, Pose(made.motion, frame), made.cameras[name])
        write_image(image_path(folder, name, frame), image)
    Manifest(
        scene=scene.name,
        size=scene.size,
        seed=scene.seed,
        parameters=scene.parameters,
        identity=identity(scene),
        splits=parts,
        files=hash_files(folder),
    ).write(folder)


def draw_views(scene: Scene, views: Sequence[WantedView]) -> list[np.ndarray]:
    """RGBA of views of the scene, uint8 `[h, w, 4]`, straight alpha."""
    made = _person(scene)
    return [draw_view(made.model, Pose(made.motion, view.frame), made.cameras[view.camera]) for view in views]


@dataclass(frozen=True, kw_only=True, slots=True)
class Person:
    """The scene's body made of Gaussians, and what it does."""

    skeleton: Skeleton
    mesh: TemplateMesh
    motion: Motion
    model: AshModel
    posed: np.ndarray  # [t, v, 3] metres
    cameras: dict[str, Camera]


def _person(scene: Scene) -> Person:
    from synth.camera.rig import make_cameras
    from synth.motion.clips import make_motion
    from synth.scene import stream

    body = make_body(scene)
    mesh = body.template()
    motion = make_motion(body.skeleton, scene.train + scene.test, fps=scene.fps, seed=stream(scene, "motion"))
    template = Template(mesh, body.skeleton, RestDeformation(mesh))
    model = known_avatar(template, texels=CI_TEXELS if scene.size == "ci" else TEXELS, seed=scene.seed)
    posed = np.stack([template.pose(Pose(motion, frame)).vertices.numpy() for frame in range(len(motion.dofs))])
    cameras = make_cameras(scene.rig, posed.reshape(-1, 3).astype(np.float64))
    return Person(
        skeleton=body.skeleton,
        mesh=mesh,
        motion=motion,
        model=model,
        posed=posed,
        cameras={camera.name: camera for camera in cameras},
    )


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
def draw_view(model: AshModel, pose: Pose, camera: Camera) -> np.ndarray:
    """RGBA of a view, uint8 `[h, w, 4]`, straight alpha."""
    drawn = model(pose, camera)
    colour = drawn.rgb[0] / drawn.alpha[0].clamp(min=1e-3)[..., None]
    return (torch.cat([colour, drawn.alpha[0, ..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
