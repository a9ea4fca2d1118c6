"""Camera rigs: where calibrated cameras stand, and how tightly they frame a person who moves."""

import json
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from ash.capture.dataset import Camera
from ash.capture.formats import read_cameras
from ash.capture.lens import distort
from ash.files import InputError, read_json
from synth.scene import Rig

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def place(rig: Rig) -> np.ndarray:
    """Positions of the cameras, `[n, 3]` metres, before aiming."""
    k = np.arange(rig.cameras)
    if rig.kind == "ring":
        azimuth, elevation = 2 * np.pi * k / rig.cameras + 0.2, np.full(rig.cameras, np.deg2rad(8.0))
    elif rig.kind == "cap":
        azimuth = np.deg2rad(60) * np.sqrt((k + 0.5) / rig.cameras) * np.sin(GOLDEN_ANGLE * k)
        elevation = np.deg2rad(20 + 25 * np.sqrt((k + 0.5) / rig.cameras) * np.cos(GOLDEN_ANGLE * k))
    elif rig.kind == "studio":
        # A hall with rings at four heights, most cameras low, as studios are built.
        rings = np.array([-2.0, 12.0, 28.0, 46.0])[np.minimum(k % 10 // 3, 3)]
        azimuth, elevation = 2 * np.pi * k / rig.cameras * 7, np.deg2rad(rings)
    else:
        # The golden angle spreads azimuths evenly for any number; heights run from the waist to above the head.
        azimuth = GOLDEN_ANGLE * k + 0.2
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


def names(rig: Rig) -> list[str]:
    """The cameras' names, in order."""
    if rig.kind == "given":
        return [row["name"] for row in json.loads(rig.given)["cameras"]]
    return [f"cam{k:03d}" for k in range(rig.cameras)]


def make_cameras(rig: Rig, points: np.ndarray, *, margin: float = 0.04) -> list[Camera]:
    """Aim every camera at the capture volume and choose its focal length so that all `points` `[n, 3]` stay in view.

    `margin` is left free on each side, as a share of the image. The cameras of a given rig are taken as they are.

    Raises:
        InputError: a given camera never sees the person, or has a part of it behind.
    """
    if rig.kind == "given":
        cameras = _parse(rig.given)
        for camera in cameras:
            pixels, depth = camera.project(points)
            if (depth < 0.05).any() or (pixels.max(axis=0) < 0).any() or (pixels.min(axis=0) > _size(rig)).any():
                raise InputError(f"camera {camera.name}: expected the person in front of it and in its picture")
        return cameras
    corners = hull_of(points)  # The others lie between them in every picture.
    pairs = zip(names(rig), place(rig), strict=True)
    return [_frame(rig, name, position, corners, margin=margin) for name, position in pairs]


def hull_of(points: np.ndarray) -> np.ndarray:
    """Those of the points `[n, 3]` that are corners of their convex hull, in the points' order."""
    return points[np.sort(ConvexHull(points).vertices)]


MAX_BYTES = 16 << 20  # of a user's cameras.json


def rig_from_file(path: Path, *, held_out: int | None = None) -> Rig:
    """A rig of the user's own cameras, all of one size; a quarter of them is held out (1 to 8) unless told otherwise.

    Raises:
        InputError: the file is not a valid `cameras.json`, or its cameras differ in size.
    """
    read_json(path, most=MAX_BYTES)
    cameras = list(read_cameras(path).values())
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1:
        raise InputError(f"{path}: expected cameras of one size, got {sorted(sizes)}")
    width, height = sizes.pop()
    told = read_json(path, most=MAX_BYTES)
    text = json.dumps({"cameras": told} if isinstance(told, list) else told, sort_keys=True)
    held_out = min(max(1, len(cameras) // 4), 8) if held_out is None else held_out
    return Rig(kind="given", given=text, cameras=len(cameras), held_out=held_out, width=width, height=height)


def _size(rig: Rig) -> np.ndarray:
    return np.array([rig.width, rig.height])


def _parse(text: str) -> list[Camera]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        path.write_text(text)
        return list(read_cameras(path).values())


def _frame(rig: Rig, name: str, position: np.ndarray, points: np.ndarray, *, margin: float) -> Camera:
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    lens, aspect = np.array(rig.distortion), np.array([1.0, rig.pixel_aspect])
    # Aim at the middle of what is seen, which is not the middle of the volume; a few rounds settle it.
    for _ in range(4):
        viewmat = look_at(position, target)
        seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        rays = distort(seen[:, :2] / seen[:, 2:], lens)
        middle = (rays.min(axis=0) + rays.max(axis=0)) / 2
        depth = seen[:, 2].mean()
        target = position + viewmat[:3, :3].T @ np.array([middle[0] * depth, middle[1] * depth, depth])
    half = np.abs(rays).max(axis=0)
    room = (0.5 - margin) * _size(rig)
    focal = float(np.min(room / (half * aspect)))
    K = np.array([[focal, 0, rig.width / 2], [0, focal * rig.pixel_aspect, rig.height / 2], [0, 0, 1.0]])
    return Camera(name=name, width=rig.width, height=rig.height, K=K, viewmat=viewmat, distortion=lens)


def held_out(rig: Rig) -> list[int]:
    """Indices of the cameras kept for novel views, spread evenly over the rig."""
    step = rig.cameras / rig.held_out
    return [int(step * (k + 0.5)) for k in range(rig.held_out)]


def rotation(rig: Rig, frames: int) -> list[list[int]]:
    """Indices of the training cameras that see each frame: `rig.part` of them, one out of each sector around the rig.

    In every round of (training cameras / part) frames each camera is used once; where that is no whole number, sectors
    of one camera less begin anew a frame earlier. From round to round the sectors are shifted against each other, so
    that cameras meet in other parts. An axis through the middle of the rig is up.
    """
    around = place(rig) if rig.kind != "given" else np.stack([camera.position for camera in _parse(rig.given)])
    training = [k for k in range(rig.cameras) if k not in held_out(rig)]
    azimuth = np.arctan2(*(around[training][:, [0, 2]] - around[:, [0, 2]].mean(axis=0)).T)
    sectors = np.array_split(np.array(training)[np.argsort(azimuth, kind="stable")], rig.part)
    return [
        [int(sector[(frame + number * (frame // len(sector))) % len(sector)]) for number, sector in enumerate(sectors)]
        for frame in range(frames)
    ]


def spread(positions: np.ndarray, count: int) -> list[int]:
    """Indices of `count` cameras `[n, 3]` far from each other; a larger subset contains the smaller."""
    directions = positions - positions.mean(axis=0)
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    chosen = [int(np.argmin(positions[:, 1]))]
    distance = np.linalg.norm(directions - directions[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(directions - directions[chosen[-1]], axis=1))
    return chosen
