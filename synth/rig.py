"""Camera rigs: where calibrated cameras stand, and how tightly they frame a person who moves."""

import numpy as np

from ash.dataset import Camera
from synth.scene import Rig


def place(rig: Rig) -> np.ndarray:
    """Positions of the cameras, `[n, 3]` metres, before aiming."""
    k = np.arange(rig.cameras)
    # The golden angle spreads azimuths evenly for any number; heights run from the waist to above the head.
    azimuth = np.pi * (3 - np.sqrt(5)) * k + 0.2
    elevation = np.deg2rad(-2 + 47 * ((k * 0.618034 + 0.3) % 1.0) ** 1.5)
    ring = rig.radius * np.cos(elevation)
    return np.stack([ring * np.sin(azimuth), 0.95 + rig.radius * np.sin(elevation), ring * np.cos(azimuth)], axis=1)


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World-to-camera matrix `[4, 4]` (OpenCV axes) of a camera that looks at `target`, world up being up."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 1.0, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return viewmat


def make_cameras(rig: Rig, points: np.ndarray, *, margin: float = 0.04) -> list[Camera]:
    """Aim every camera at the capture volume and choose its focal length so that all `points` `[n, 3]` stay in view.

    `margin` is left free on each side, as a share of the image.
    """
    names = [f"cam{k:03d}" for k in range(rig.cameras)]
    return [
        _frame(rig, name, position, points, margin=margin) for name, position in zip(names, place(rig), strict=True)
    ]


def _frame(rig: Rig, name: str, position: np.ndarray, points: np.ndarray, *, margin: float) -> Camera:
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    # Aim at the middle of what is seen, which is not the middle of the volume; a few rounds settle it.
    for _ in range(4):
        viewmat = look_at(position, target)
        seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        rays = seen[:, :2] / seen[:, 2:]
        middle = (rays.min(axis=0) + rays.max(axis=0)) / 2
        depth = seen[:, 2].mean()
        target = position + viewmat[:3, :3].T @ np.array([middle[0] * depth, middle[1] * depth, depth])
    half = np.abs(rays).max(axis=0)
    room = (0.5 - margin) * np.array([rig.width, rig.height])
    focal = float(np.min(room / half))
    K = np.array([[focal, 0, rig.width / 2], [0, focal, rig.height / 2], [0, 0, 1.0]])
    return Camera(name=name, width=rig.width, height=rig.height, K=K, viewmat=viewmat)


def held_out(rig: Rig) -> list[int]:
    """Indices of the cameras kept for novel views, spread evenly over the rig."""
    step = rig.cameras / rig.held_out
    return [int(step * (k + 0.5)) for k in range(rig.held_out)]
