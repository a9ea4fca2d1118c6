"""The trivial baseline: the training image of the nearest pose and camera, moved to where the person stands.

It learns nothing and draws nothing. A method that is no better than this does not work: breakdown points are measured
against it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.numpy
import torch
from jaxtyping import Float

from ash.capture.dataset import Camera, Capture, Motion, Pose, Skeleton, require_pose
from ash.capture.novelty import pose_distances, pose_quats
from ash.checkpoints import read_safetensors
from ash.files import InputError, write_atomic
from ash.protocol import StageClock
from ash.rotations import root_yaw


@dataclass(frozen=True, kw_only=True, slots=True)
class RootView:
    """How a camera sees the root joint."""

    pixel: Float[np.ndarray, " 2"]
    pixels_per_metre: float  # at the root's depth
    direction: Float[np.ndarray, " 3"]  # from the root to the camera, unit, in the root's heading


class NearestImage:
    """The Avatar protocol (see `ash.protocol`) without learning: looks up a training image."""

    seedless = True  # Nothing here is random.

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self.train = capture.splits["train"]

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """There is nothing to learn: the training images are the model."""

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """The nearest training image, shifted and scaled so that the root lies where `camera` sees it."""
        skeleton = self.capture.skeleton
        with clock.stage("stg1"):
            require_pose(pose, skeleton)
            wanted = see_root(skeleton, pose, camera)
            trained = pose_quats(self.capture.motion.dofs[list(self.train.frames)])
            distances = pose_distances(pose_quats(pose.dofs[None])[0], trained)
            near = self.train.frames[int(distances.argmin())]
            views = {
                name: see_root(skeleton, Pose(self.capture.motion, near), self.capture.cameras[name])
                for name in self.train.seeing(near)
            }
            name = max(views, key=lambda candidate: float(views[candidate].direction @ wanted.direction))
        with clock.stage("stg4"):
            return move_image(self.capture.image(name, near), views[name], wanted, camera)

    def parameter_count(self) -> int:
        """Nothing is learned."""
        return 0

    def gaussian_count(self) -> int:
        """None."""
        return 0

    def save(self, path: Path) -> None:
        """Write which images are looked up: the frames; the images are the capture's."""
        write_atomic(path, safetensors.numpy.save({"frames": np.array(self.train.frames, dtype=np.int64)}))

    def load(self, path: Path) -> None:
        """Check that the capture is the one that `save` knew."""
        frames = read_safetensors(path)[0].get("frames")
        if frames is None or frames.tolist() != list(self.train.frames):
            raise InputError(f"{path}: was written for another capture")


def central_frame(motion: Motion, frames: tuple[int, ...]) -> int:
    """The frame among `frames` whose pose is nearest to all others, by the sum of distances."""
    poses = pose_quats(motion.dofs[list(frames)])
    return frames[int(np.argmin([pose_distances(pose, poses).sum() for pose in poses]))]


def see_root(skeleton: Skeleton, pose: Pose, camera: Camera) -> RootView:
    """Where and how large a camera sees the root, and from which side."""
    root = skeleton.heads[0] + pose.dofs[:3]
    pixel, depth = camera.project(root)
    yaw = float(root_yaw(torch.from_numpy(pose.dofs)))
    unturn = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    towards = unturn @ (camera.position - root)
    return RootView(
        pixel=pixel,
        pixels_per_metre=float(camera.K[0, 0] / depth),
        direction=towards / np.linalg.norm(towards),
    )


def move_image(image: np.ndarray, view: RootView, wanted: RootView, camera: Camera) -> Float[np.ndarray, "h w 4"]:
    """Resample a straight uint8 RGBA image for another camera; premultiplied float32, empty beyond its border."""
    straight = torch.from_numpy(image).float() / 255
    premultiplied = torch.cat([straight[..., :3] * straight[..., 3:], straight[..., 3:]], -1)
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    scale = view.pixels_per_metre / wanted.pixels_per_metre
    source = [
        (grid - float(to)) * scale + float(start)
        for grid, to, start in zip((x, y), wanted.pixel, view.pixel, strict=True)
    ]
    size = image.shape[1], image.shape[0]
    grid = torch.stack([2 * place / side - 1 for place, side in zip(source, size, strict=True)], -1)[None]
    moved = torch.nn.functional.grid_sample(premultiplied.permute(2, 0, 1)[None], grid, align_corners=False)
    return moved[0].permute(1, 2, 0).contiguous().numpy()


def nearest(capture: Capture, *, seed: int, preset: str) -> NearestImage:
    """The training image of the nearest pose and camera; the same for every seed and preset."""
    return NearestImage(capture)
