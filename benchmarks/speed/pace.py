"""Training steps per second of a preset on a device, found in seconds: what `ash-bench doctor` asks.

The steps are the loop's own, on a mannequin in front of four cameras whose images need no renderer: flat silhouettes
have the crops and the Gaussians of real ones.
"""

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import ash.training.loop
from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose, image_path
from ash.capture.formats import load_capture, write_cameras, write_motion, write_skeleton, write_template
from ash.capture.manifest import Manifest, Split
from ash.config import TemplateConfig
from ash.devices import finish
from ash.files import write_image
from ash.mesh.rasterizing import project_vertices, rasterize_mesh
from ash.presets import named
from ash.template.template import RestDeformation, Template
from ash.training.batches import draw_batch
from ash.training.images import load_training_images
from synth.camera.rig import make_cameras
from synth.motion.clips import make_motion
from synth.person.mannequin import mannequin
from synth.scene import Clip, Rig

CAMERAS, FRAMES, FPS = 4, 4, 25.0
FIRST_STEPS = 3  # not counted: kernels are compiled, and each frame is posed


@dataclass(frozen=True, kw_only=True, slots=True)
class PacedPreset:
    """A preset, and the size of the images that it is meant for."""

    name: str
    width: int
    height: int


PACED = (PacedPreset(name="cpu", width=256, height=256), PacedPreset(name="paper", width=1285, height=940))


def steps_per_second(preset: PacedPreset, device: torch.device, *, seconds: float) -> float:
    """As many steps of the preset's training as fit into `seconds`, by the clock; at least one."""
    config = named(preset.name)
    training = replace(config.training, warmup="none", warmup_steps=0, steps=10**9, seconds=math.inf)
    with tempfile.TemporaryDirectory() as folder:
        capture = stand_in(Path(folder), preset.width, preset.height)
        skinned = TemplateConfig(kind="skinned")
        avatar = AshAvatar(replace(config, template=skinned, training=training, device=str(device)), capture)
        images = load_training_images(capture, avatar.device)
        run = ash.training.loop._Run(avatar, training, replace(images, reserved=()), Path(folder) / "run")
        start, first = time.perf_counter(), 0
        while run.step <= FIRST_STEPS or time.perf_counter() - start < seconds:
            run.advance([draw_batch(images, training, 0, run.step)])
            if run.step == FIRST_STEPS:
                finish(avatar.device)
                start, first = time.perf_counter(), run.step
        finish(avatar.device)
        return (run.step - first) / (time.perf_counter() - start)


def stand_in(folder: Path, width: int, height: int) -> Capture:
    """A capture of a walking mannequin whose images are flat silhouettes."""
    body = mannequin(skirt=True)
    mesh = body.template()
    motion = make_motion(body.skeleton, (Clip(generator="walk", frames=FRAMES),), fps=FPS, seed=0)
    template = Template(mesh, body.skeleton, RestDeformation(mesh))
    posed = [template.pose(Pose(motion, frame)).vertices for frame in range(FRAMES)]
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_template(folder / "template.npz", mesh)
    write_motion(folder / "motion.npz", motion)
    rig = Rig(cameras=CAMERAS, held_out=1, width=width, height=height)
    cameras = make_cameras(rig, torch.cat(posed).double().numpy())
    write_cameras(folder / "cameras.json", cameras)
    split = Split(cameras=tuple(camera.name for camera in cameras), frames=tuple(range(FRAMES)))
    Manifest(scene="mannequin", seed=0, splits={"train": split}, files={}).write(folder)
    for frame, vertices in enumerate(posed):
        for camera in cameras:
            write_image(image_path(folder, camera.name, frame), _silhouette(vertices, template.faces, camera))
    return load_capture(folder)


def _silhouette(vertices: torch.Tensor, faces: torch.Tensor, camera: Camera) -> np.ndarray:
    viewmat, K = (torch.from_numpy(matrix).to(vertices) for matrix in (camera.viewmat, camera.K))
    pixels = project_vertices(vertices, viewmat, K).double()
    drawn = rasterize_mesh(pixels, faces, width=camera.width, height=camera.height)
    image = np.full((camera.height, camera.width, 4), 180, np.uint8)
    image[..., 3] = np.where(drawn.triangle.numpy() >= 0, 255, 0)
    return image
