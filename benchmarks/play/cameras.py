"""Cameras that nobody set up: the paper's spiral around the person, and any camera at another size."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera, Capture
from ash.files import InputError
from synth.camera.rig import look_at

SPIRAL, RIG = "spiral", "rig"
RISE = 0.35  # of its distance: how far the spiral's camera goes up and down
TURN_FRAMES = 96  # frames of one turn
START = (0.25, 0.12, 0.96)  # from the person's middle, nearly of length 1
STEPS_PER_SECOND = 12.0  # where the spiral is played


def resized(camera: Camera, *, width: int, height: int) -> Camera:
    """The same view in other pixels; a changed aspect ratio adds room at two sides and cuts nothing off."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] += np.array([width - scale * camera.width, height - scale * camera.height]) / 2
    return replace(camera, width=width, height=height, K=K)


def fov_of(camera: Camera) -> float:
    """A camera's field of view from bottom to top, radians."""
    return float(2 * np.arctan2(camera.height / 2, camera.K[1, 1]))


def first_camera(capture: Capture) -> Camera:
    """The capture's first camera: viewers begin with its field of view, and as far away."""
    return next(iter(capture.cameras.values()))


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """How far two cameras `[4, 4]` stand from each other, metres, and are turned, radians."""
    moved = one[:3, :3].T @ one[:3, 3] - other[:3, :3].T @ other[:3, 3]
    turned = Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude()
    return float(np.linalg.norm(moved)), float(turned)


def middle_of(capture: Capture) -> np.ndarray:
    """The middle of the resting person, `[3]` metres."""
    vertices = capture.template.vertices
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def reach_of(capture: Capture) -> float:
    """How far the first camera stands from the person's middle, metres."""
    return float(np.linalg.norm(first_camera(capture).position - middle_of(capture)))


def starting_place(capture: Capture) -> np.ndarray:
    """Where a new viewer stands, `[3]` metres: before the person, as far away as the capture's first camera."""
    return middle_of(capture) + reach_of(capture) * np.array(START)


def spiral_camera(capture: Capture, step: float, *, width: int, height: int) -> Camera:
    """Camera number `step` of a spiral: once around the person in `TURN_FRAMES`, up and down at half that rate.

    It stands as far away as the capture's first camera, with its field of view.
    """
    middle = middle_of(capture)
    angle = 2 * np.pi * step / TURN_FRAMES
    side = np.array([np.sin(angle), 0.15 + RISE * np.sin(angle / 2), np.cos(angle)])
    viewmat = look_at(middle + reach_of(capture) * side / np.linalg.norm(side), middle)
    return resized(replace(first_camera(capture), name=SPIRAL, viewmat=viewmat), width=width, height=height)


def camera_named(capture: Capture, name: str) -> Camera:
    """A camera of the capture, or an InputError that lists them."""
    if name not in capture.cameras:
        raise InputError(f"camera: expected {SPIRAL}, {RIG} or one of {', '.join(capture.cameras)}, got {name!r}")
    return capture.cameras[name]
