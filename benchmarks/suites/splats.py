"""The factor scene `splats`: images of known Gaussians, without light, cloth or articulation.

They are none of ASH's: more than it has texels, at other places, of other shapes. Training must approximate them.
It is drawn here and not in `synth`, which makes the truth that the splatter is judged by and so must not know it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ash.capture.dataset import Camera, Pose, TemplateMesh, image_path, surface_path
from ash.capture.formats import write_cameras, write_motion, write_skeleton, write_template
from ash.capture.manifest import Manifest, hash_files, is_capture
from ash.config import ModelConfig
from ash.files import hash_of, write_arrays, write_image
from ash.model import AshModel
from ash.template.template import RestDeformation, Template
from ash.textures import TexelLattice
from synth.camera.rig import make_cameras
from synth.capture import make_body
from synth.motion.clips import make_motion
from synth.scene import Scene, stream
from synth.views import splits

CI_COUNT, COUNT = 5_000, 60_000  # About twice as many as the presets' lattices have texels at these sizes.
VERSION = 2


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
    body = make_body(scene)
    mesh = body.template()
    motion = make_motion(body.skeleton, scene.clips, fps=scene.fps, seed=stream(scene, "motion"))
    template = Template(mesh, body.skeleton, RestDeformation(mesh))
    seed = stream(scene, "splats") if scene.subject else scene.seed
    model = known_avatar(template, count=CI_COUNT if scene.size == "ci" else COUNT, seed=seed)
    posed = np.stack([template.pose(Pose(motion, frame)).vertices.numpy() for frame in range(len(motion.dofs))])
    cameras = {camera.name: camera for camera in make_cameras(scene.rig, posed.reshape(-1, 3).astype(np.float64))}
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_motion(folder / "motion.npz", motion)
    write_template(folder / "template.npz", mesh)
    write_arrays(folder / "truth" / "template.npz", vertices=posed.astype(np.float64))
    write_arrays(folder / "truth" / "surface.npz", faces=mesh.faces.astype(np.int32))
    for frame, vertices in enumerate(posed):
        write_arrays(surface_path(folder, frame), vertices=vertices)
    write_cameras(folder / "cameras.json", list(cameras.values()))
    parts = splits(scene)
    for name, frame in sorted({view for split in parts.values() for view in split.views}):
        write_image(image_path(folder, name, frame), draw_view(model, Pose(motion, frame), cameras[name]))
    Manifest(
        scene=scene.name,
        size=scene.size,
        seed=scene.seed,
        parameters=scene.parameters,
        identity=identity(scene),
        splits=parts,
        files=hash_files(folder),
    ).write(folder)


def known_avatar(template: Template, *, count: int, seed: int) -> AshModel:
    """`count` Gaussians at random places of a template, of random sizes, shapes, directions, opacities and colours.

    No texel lattice and no initialiser of the method has a part in it: what is trained must approximate them.
    """
    size: dict[str, Any] = {"texels": 4, "window": 1, "levels": 0, "sh_degree": 0, "dilation": 0.05}
    kind: dict[str, Any] = {"yaw_normalise": True, "motion": False, "base": True}
    config = ModelConfig(**size, **kind, offset_unit_m=1.0)
    rng = np.random.default_rng([seed, 7])
    places = scattered(template.mesh, count, rng)
    return AshModel(config, template, places, _known_gaussians(template, places, rng), None)


def scattered(mesh: TemplateMesh, count: int, rng: np.random.Generator) -> TexelLattice:
    """Places of a mesh drawn evenly over its surface, in the form of a lattice; they lie on no texel."""
    area = _areas(mesh)
    triangle = rng.choice(len(area), count, p=area / area.sum())
    return TexelLattice(
        resolution=1,
        texels=torch.arange(count),
        corners=torch.from_numpy(mesh.faces[triangle]),
        barycentric=torch.from_numpy(rng.dirichlet(np.ones(3), count)).float(),
    )


def _areas(mesh: TemplateMesh) -> np.ndarray:
    """Of the triangles, square metres."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    doubled: np.ndarray = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return doubled / 2


def _known_gaussians(template: Template, places: TexelLattice, rng: np.random.Generator) -> Tensor:
    """Raw parameters `[n, 14]`: offset (metres), log-scale, quaternion, opacity's logit, colour's constant."""
    rest = torch.from_numpy(template.mesh.vertices).float()
    points = places.interpolate(rest).numpy()
    pitch = np.sqrt(_areas(template.mesh).sum() / len(points))
    size = np.log(0.7 * pitch) + rng.normal(0, 0.3, (len(points), 1)) + rng.normal(0, 0.4, (len(points), 3))
    offset = 0.002 * _waves(points, 3, 0.1, rng)
    turn = rng.standard_normal((len(points), 4))
    opacity = 1.5 + 1.0 * rng.standard_normal((len(points), 1))
    # Colours that change from one to the next and along the body; 0.5 plus 0.28 times them stays within 0 and 1.
    colour = 0.5 * _waves(points, 3, 0.06, rng) + 0.15 * rng.standard_normal((len(points), 3))
    return torch.from_numpy(np.concatenate([offset, size, turn, opacity, colour], 1)).float()


def _waves(places: np.ndarray, channels: int, length_m: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth random functions over space, of variance one: a sum of waves."""
    count = 32
    directions, phases = rng.standard_normal((3, count)) / length_m, rng.uniform(0, 2 * np.pi, count)
    weights = rng.standard_normal((count, channels)) / (count / 2) ** 0.5
    waves: np.ndarray = np.cos(places @ directions + phases) @ weights
    return waves


@torch.no_grad()
def draw_view(model: AshModel, pose: Pose, camera: Camera) -> np.ndarray:
    """RGBA of a view, uint8 `[h, w, 4]`, straight alpha."""
    drawn = model(pose, camera)
    colour = drawn.rgb[0] / drawn.alpha[0].clamp(min=1e-3)[..., None]
    return (torch.cat([colour, drawn.alpha[0, ..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
