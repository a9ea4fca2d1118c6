"""Cameras beside a capture's own: a browser's viewpoint, the paper's spiral around the person, other image sizes."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera, Capture
from ash.files import InputError
from synth.camera.rig import look_at

FREE, SPIRAL, RIG = "free", "spiral", "rig"
SPIRAL_RISE = 0.35  # of its distance: how far the spiral's camera goes up and down
SPIRAL_STEPS = 96  # of one turn
START = (0.25, 0.12, 0.96)  # direction from the person's middle to a new viewer, nearly of length 1


def resized(camera: Camera, *, width: int, height: int) -> Camera:
    """The same view in other pixels; another aspect ratio adds pixels at two sides and cuts none off."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] += np.array([width - scale * camera.width, height - scale * camera.height]) / 2
    return replace(camera, width=width, height=height, K=K)


def fov_of(camera: Camera) -> float:
    """A camera's field of view from bottom to top, radians."""
    return float(2 * np.arctan2(camera.height / 2, camera.K[1, 1]))


def first_camera(capture: Capture) -> Camera:
    """The capture's first camera: viewers begin with its field of view and its distance."""
    return next(iter(capture.cameras.values()))


def distance_between(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Metres between two cameras `[4, 4]`, and radians between their directions."""
    moved = one[:3, :3].T @ one[:3, 3] - other[:3, :3].T @ other[:3, 3]
    turned = Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude()
    return float(np.linalg.norm(moved)), float(turned)


def middle_of(capture: Capture) -> np.ndarray:
    """The middle of the resting person, `[3]` metres."""
    vertices = capture.template.vertices
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def camera_distance(capture: Capture) -> float:
    """Metres from the person's middle to the first camera."""
    return float(np.linalg.norm(first_camera(capture).position - middle_of(capture)))


def spiral_camera(capture: Capture, step: int, *, width: int, height: int) -> Camera:
    """Camera number `step` of the spiral: once around the person in `SPIRAL_STEPS`, up and down at half that rate.

    It has the distance and the field of view of the capture's first camera.
    """
    middle, angle = middle_of(capture), 2 * np.pi * step / SPIRAL_STEPS
    side = np.array([np.sin(angle), 0.15 + SPIRAL_RISE * np.sin(angle / 2), np.cos(angle)])
    viewmat = look_at(middle + camera_distance(capture) * side / np.linalg.norm(side), middle)
    return resized(replace(first_camera(capture), name=SPIRAL, viewmat=viewmat), width=width, height=height)


def camera_named(capture: Capture, name: str) -> Camera:
    """A camera of the capture, or an InputError that lists them."""
    if name not in capture.cameras:
        raise InputError(f"camera: expected {SPIRAL}, {RIG} or one of {', '.join(capture.cameras)}, got {name!r}")
    return capture.cameras[name]
