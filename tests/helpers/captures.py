"""A small capture for tests: a bending tube with known texel Gaussians, drawn by the splatter itself."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.figures import ring_cameras, tube_mesh, tube_motion, tube_skeleton

from ash import presets
from ash.capture.dataset import Capture, Pose, image_path, scan_path, surface_path
from ash.capture.formats import load_capture, write_cameras, write_motion, write_skeleton, write_template
from ash.config import AshConfig, ModelConfig, TemplateConfig
from ash.fields import apply_overrides
from ash.files import sha256_of, write_arrays, write_image, write_json
from ash.gaussians.initialising import blank_gaussians
from ash.mesh.drawing import draw_mesh, textured, topology_of
from ash.model import AshModel
from ash.template.template import RestDeformation, Template
from ash.textures import build_lattice

CAMERAS, FRAMES, SIZE, TEXELS = 5, 6, 48, 16


def tube_model_config(**changes) -> ModelConfig:
    """A model small enough for tests."""
    small = {"texels": TEXELS, "window": 2, "width": 4, "levels": 2, "norm": "none", "shared_trunk": True}
    plain = {"yaw_normalise": True, "sh_degree": 0, "base": True, "dilation": 0.05}
    return ModelConfig(**(small | plain | changes))


def tiny_preset(*, steps: int, warmup_steps: int) -> AshConfig:
    """The preset `ci` at a size for the tube: the paper's text."""
    return _tiny(replace(presets.ci(), template=TemplateConfig(nodes=20, steps=3)), steps, warmup_steps)


def tiny_plus(changes: Mapping[str, Any] | None = None, *, steps: int, warmup_steps: int) -> AshConfig:
    """The same with all additions, and other values at dotted keys; the warm-up is static."""
    base = replace(presets.plus("ci"), template=TemplateConfig(nodes=20, steps=3))
    return apply_overrides(_tiny(base, steps, warmup_steps), changes or {}, of="tiny")


def _tiny(config: AshConfig, steps: int, warmup_steps: int) -> AshConfig:
    model = replace(config.model, texels=16, shuffle=1, width=4, levels=2, window=2)
    training = replace(config.training, steps=steps, warmup_steps=warmup_steps, fitted_steps=3)
    return replace(config, model=model, training=training)


def tube_template() -> Template:
    """The tube's mesh as it is, skinned."""
    return Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()))


def known_model() -> AshModel:
    """Texel Gaussians with random colours that no training has touched."""
    config = tube_model_config(motion=False)
    lattice = build_lattice(tube_mesh(), TEXELS)
    raw = blank_gaussians(config, len(lattice.texels), 0.06)
    raw[:, 10] = 3.0
    raw[:, 11:14] = torch.randn(len(raw), 3, generator=torch.Generator().manual_seed(1))
    return AshModel(config, tube_template(), lattice, raw, None)


def write_tube_capture(folder: Path) -> Capture:
    """Camera 0 is held out, and so are the last two frames, a sequence of their own."""
    cameras, motion, model = ring_cameras(CAMERAS, SIZE), tube_motion(FRAMES), known_model()
    motion.sequence[-2:] = 1
    write_cameras(folder / "cameras.json", cameras)
    write_skeleton(folder / "skeleton.json", tube_skeleton())
    write_template(folder / "template.npz", tube_mesh())
    write_motion(folder / "motion.npz", motion)
    posed = np.stack([model.template.pose(Pose(motion, frame)).vertices.numpy() for frame in range(FRAMES)])
    write_arrays(folder / "truth" / "template.npz", vertices=posed)
    write_arrays(folder / "truth" / "surface.npz", faces=tube_mesh().faces)
    for frame in range(FRAMES):
        write_arrays(surface_path(folder, frame), vertices=posed[frame])
    for frame in range(FRAMES - 2):
        write_arrays(scan_path(folder, frame), vertices=posed[frame], faces=tube_mesh().faces)
    train = {"cameras": [c.name for c in cameras[1:]], "frames": list(range(FRAMES - 2))}
    splits = {
        "train": train,
        "novel_view": {"cameras": ["cam0"], "frames": train["frames"]},
        "novel_pose": {"cameras": ["cam0"], "frames": [FRAMES - 2, FRAMES - 1]},
    }
    for split in splits.values():
        for name in split["cameras"]:
            for frame in split["frames"]:
                camera = next(c for c in cameras if c.name == name)
                with torch.no_grad():
                    drawn = model(Pose(motion, frame), camera)
                write_image(image_path(folder, name, frame), _straight_rgba(drawn.rgb[0], drawn.alpha[0]))
    files = {str(p.relative_to(folder)): sha256_of(p) for p in folder.rglob("*") if p.is_file()}
    manifest = {"schema": 1, "scene": "tube", "seed": 0, "splits": splits, "files": files, "complete": True}
    write_json(folder / "manifest.json", manifest)
    return load_capture(folder)


def paint_tube(capture: Capture, texture: torch.Tensor, vertices: Callable[[Pose], torch.Tensor]) -> None:
    """Write all images anew: the tube's mesh with its vertices there, under a texture `[3, h, w]`."""
    mesh, topology = tube_mesh(), topology_of(torch.from_numpy(tube_mesh().faces))
    uvs, uv_faces = torch.from_numpy(mesh.uvs).float(), torch.from_numpy(mesh.uv_faces)
    shade = textured(texture, uvs, uv_faces, torch.zeros(len(mesh.vertices), 3), topology.faces, None)
    for camera, frame in {view for split in capture.splits.values() for view in split.views}:
        at = vertices(Pose(capture.motion, frame))
        drawn = draw_mesh(at, topology, capture.cameras[camera], shade, torch.zeros(3))
        write_image(image_path(capture.folder, camera, frame), _straight_rgba(drawn[..., :3], drawn[..., 3]))


def _straight_rgba(premultiplied: torch.Tensor, alpha: torch.Tensor) -> np.ndarray:
    colour = premultiplied / alpha.clamp(min=1e-3)[..., None]
    return (torch.cat([colour, alpha[..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
