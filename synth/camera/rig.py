"""Camera rigs: where calibrated cameras stand, and how tightly they frame a person who moves."""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from ash.capture.dataset import Camera
from ash.capture.formats import read_cameras
from ash.capture.lens import distort
from ash.files import InputError, read_json
from synth.posing import nearest_rotation
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
            if (extent := float(np.ptp(pixels, axis=0).max())) < LEAST_EXTENT:
                raise InputError(
                    f"camera {camera.name}: the person is {extent:.1f} pixels tall, {np.median(depth):.0f} m away"
                    f"{_unit_guess(float(np.median(depth)))}; expected at least {LEAST_EXTENT} pixels"
                )
        return cameras
    corners = hull_of(points)  # The others lie between them in every picture.
    pairs = zip(names(rig), place(rig), strict=True)
    return [_frame(rig, name, position, corners, margin=margin) for name, position in pairs]


def _unit_guess(distance: float) -> str:
    """In which unit a rig may be given, if the person is this far away in metres."""
    units = {"centimetres": 100, "millimetres": 1000}
    likely = [name for name, count in units.items() if 0.5 <= distance / count <= 15]
    return f" (is the rig in {' or '.join(likely)}?)" if likely else ""


def hull_of(points: np.ndarray) -> np.ndarray:
    """Those of the points `[n, 3]` that are corners of their convex hull, in the points' order."""
    return points[np.sort(ConvexHull(points).vertices)]


MAX_BYTES = 16 << 20  # of a user's cameras.json
LEAST_EXTENT = 8  # pixels of a person's height or width in a given camera
ROUNDED = 1e-3  # the largest deviation of R R^T from one that is taken for rounding
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")  # OpenCV's


def rig_from_file(path: Path, *, held_out: int | None = None) -> Rig:
    """A rig of the user's own cameras, all of one size; a quarter of them is held out (1 to 8) unless told otherwise.

    The file is a `cameras.json` of a capture, one of 3D Gaussian Splatting, or a `transforms.json` of nerfstudio. Its
    world is in metres with y up. Rotations that are rounded are made orthonormal.

    Raises:
        InputError: the file is none of these, its cameras differ in size, or a lens or rotation is not of our kind.
    """
    text = json.dumps({"cameras": _camera_rows(path, read_json(path, most=MAX_BYTES))}, sort_keys=True)
    try:
        cameras = _parse(text)
    except InputError as error:
        raise InputError(f"{path}: {str(error).partition(': ')[2]}") from error
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1:
        raise InputError(f"{path}: expected cameras of one size, got {sorted(sizes)}")
    width, height = sizes.pop()
    held_out = min(max(1, len(cameras) // 4), 8) if held_out is None else held_out
    return Rig(kind="given", given=text, cameras=len(cameras), held_out=held_out, width=width, height=height)


def _camera_rows(path: Path, content: Any) -> list[dict[str, Any]]:
    """The cameras of a file as rows of our `cameras.json`."""
    try:
        foreign = True
        if isinstance(content, dict) and "frames" in content:
            rows = [_from_nerfstudio(content | frame, k) for k, frame in enumerate(content["frames"])]
        else:
            rows = content["cameras"] if isinstance(content, dict) else content
            foreign = any("rotation" in row for row in rows)
            rows = [_from_splatting(row, k) if "rotation" in row else dict(row) for k, row in enumerate(rows)]
        if foreign and len({row["name"] for row in rows}) < len(rows):  # Names of images may repeat in other folders.
            rows = [row | {"name": f"cam{k:03d}"} for k, row in enumerate(rows)]
        for row in rows:
            row["distortion"] = _four_coefficients(row)
            if "viewmat" in row:
                row["viewmat"] = _orthonormal(row)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{path}: expected a list of cameras: of a capture, 3D Gaussian Splatting (cameras.json) or nerfstudio"
            f" (transforms.json) ({type(error).__name__}: {error})"
        ) from error
    return rows


def _from_splatting(row: dict[str, Any], index: int) -> dict[str, Any]:
    """A row of the `cameras.json` that 3D Gaussian Splatting writes: camera-to-world rotation, position, no lens."""
    rotation = np.array(row["rotation"], dtype=np.float64).T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ np.array(row["position"], dtype=np.float64)
    K = [[row["fx"], 0, row["width"] / 2], [0, row["fy"], row["height"] / 2], [0, 0, 1]]
    name = _plain_name(row.get("img_name", ""), index)
    return {"name": name, "width": row["width"], "height": row["height"], "K": K, "viewmat": viewmat.tolist()}


def _from_nerfstudio(row: dict[str, Any], index: int) -> dict[str, Any]:
    """A frame of `transforms.json`: camera-to-world with OpenGL axes (y up, z backwards), a lens by its fields."""
    if row.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        raise InputError(f"camera {index}: camera_model {row['camera_model']!r}, expected OPENCV or PINHOLE")
    viewmat = np.linalg.inv(np.array(row["transform_matrix"], dtype=np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    K = [[row["fl_x"], 0, row["cx"]], [0, row["fl_y"], row["cy"]], [0, 0, 1]]
    return {
        "name": _plain_name(row.get("file_path", ""), index),
        "width": int(row["w"]),
        "height": int(row["h"]),
        "K": K,
        "viewmat": viewmat.tolist(),
        "distortion": [row.get(name, 0.0) for name in COEFFICIENTS[:6]],
    }


def _plain_name(image: str, index: int) -> str:
    stem = Path(image).stem
    return stem if re.fullmatch(r"[A-Za-z0-9][\w.-]{0,60}", stem) else f"cam{index:03d}"


def _four_coefficients(row: dict[str, Any]) -> list[float]:
    """k1 k2 p1 p2 of a camera whose further coefficients are zero; also nested, as OpenCV returns them."""
    values = np.array(row.get("distortion", []), dtype=np.float64).ravel().tolist()
    for name, value in list(zip(COEFFICIENTS, values, strict=False))[4:]:
        if value != 0:
            raise InputError(f"camera {row['name']}: {name} is {value:g}, expected 0: the lens model is k1 k2 p1 p2")
    if not values:
        return [0.0] * 4
    if len(values) > len(COEFFICIENTS):
        raise InputError(f"camera {row['name']}: distortion has {len(values)} numbers, expected at most 14")
    return values[:4]


def _orthonormal(row: dict[str, Any]) -> list[list[float]]:
    """The camera's matrix, with the nearest rotation where its own is rounded."""
    viewmat = np.array(row["viewmat"], dtype=np.float64)
    if viewmat.shape != (4, 4) or not (np.abs(viewmat) < 1e9).all():
        return row["viewmat"]  # Refused where it is read.
    rotation = viewmat[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > ROUNDED:
        raise InputError(
            f"camera {row['name']}: its rotation is not orthonormal: off by {error:.2g}, expected at most {ROUNDED:g}"
        )
    if error > 1e-9:
        viewmat[:3, :3] = nearest_rotation(rotation)
    return viewmat.tolist()


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
    """Indices of the training cameras that see each frame: `cameras_per_frame`, one out of each sector around the rig.

    In every round of (training cameras / cameras per frame) frames each camera is used once; where that is no whole
    number, sectors of one camera less begin anew a frame earlier. From round to round the sectors are shifted against
    each other, so that cameras meet in other parts. An axis through the middle of the rig is up.
    """
    around = place(rig) if rig.kind != "given" else np.stack([camera.position for camera in _parse(rig.given)])
    training = [k for k in range(rig.cameras) if k not in held_out(rig)]
    azimuth = np.arctan2(*(around[training][:, [0, 2]] - around[:, [0, 2]].mean(axis=0)).T)
    sectors = np.array_split(np.array(training)[np.argsort(azimuth, kind="stable")], rig.cameras_per_frame)
    return [
        [int(sector[(frame + number * (frame // len(sector))) % len(sector)]) for number, sector in enumerate(sectors)]
        for frame in range(frames)
    ]
