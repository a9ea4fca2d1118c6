"""From lenses that distort to pinholes: what a lab does with its footage before a method sees it.

Images and masks are resampled, as a lab has to; the truth per pixel is traced again for the pinhole, so it stays exact.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Capture, image_path, pixels_path
from ash.capture.formats import load_capture, read_surface_truth, write_cameras
from ash.files import InputError, link_or_copy, read_arrays, sha256_of, write_arrays, write_image
from synth.camera.render import Studio, probe
from synth.person.body import Surface
from synth.scene import Light
from synth.truth.pixels import surface_truth


def undistort(source: Path, folder: Path) -> Path:
    """Write the capture `source` as pinhole cameras with the same K see it into `folder`, and return it.

    Raises:
        InputError: not a capture, or `folder` is not empty.
    """
    capture = load_capture(source)
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: expected an empty folder")
    pinholes = {name: replace(camera, distortion=np.zeros(4)) for name, camera in capture.cameras.items()}
    written = {"cameras.json"}
    write_cameras(folder / "cameras.json", list(pinholes.values()))
    views = sorted({view for split in capture.splits.values() for view in split.views}, key=lambda view: view[1])
    studio = _studio(capture)
    for name, frame in views:
        if not capture.cameras[name].is_pinhole:
            studio.dress(read_surface_truth(capture.folder, frame))
            written |= _write_view(capture, pinholes[name], frame, studio, folder)
    for name in set(capture.manifest.files) - written:
        link_or_copy(source / name, folder / name)
    files = {
        name: sha256_of(folder / name) if name in written else digest for name, digest in capture.manifest.files.items()
    }
    replace(capture.manifest, undistorted={"of": capture.identity}, files=files).write(folder)
    return folder


def resample(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """An image `[h, w, k]` of a distorting camera as its pinhole sees it, bilinearly; zero where it saw nothing.

    Also returns the sum of squared weights per pixel `[h, w]`: what remains of independent noise's variance.
    """
    pinhole = replace(camera, distortion=np.zeros(4))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = pinhole.directions(np.stack([x, y], axis=-1))
    place = camera.project(camera.position + rays)[0] - 0.5
    low = np.floor(place).astype(np.int64)
    share = place - low
    result, squares = np.zeros(image.shape), np.zeros(image.shape[:2])
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = low[..., 0] + dx, low[..., 1] + dy
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            weight = np.abs(1 - dx - share[..., 0]) * np.abs(1 - dy - share[..., 1]) * inside
            value = image[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
            result += weight[..., None] * value
            squares += weight**2
    return result, squares


def _write_view(capture: Capture, pinhole: Camera, frame: int, studio: Studio, folder: Path) -> set[str]:
    camera = capture.cameras[pinhole.name]
    rgba = capture.image(camera.name, frame) / 255.0
    noise = read_arrays(pixels_path(capture.folder, camera.name, frame), expected=("noise",))["noise"]
    premultiplied = np.concatenate([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:], noise[..., None]], axis=-1)
    straight, squares = resample(premultiplied, camera)
    alpha = straight[..., 3:4]
    colour = np.where(alpha > 0.5 / 255, straight[..., :3] / np.maximum(alpha, 1e-6), 0)
    image = np.round(255 * np.clip(np.concatenate([colour, alpha], axis=-1), 0, 1)).astype(np.uint8)
    triangle, barycentric = studio.look(pinhole)
    write_arrays(
        pixels_path(folder, camera.name, frame),
        triangle=triangle,
        barycentric=barycentric.astype(np.float16),
        noise=(straight[..., 4] * squares).astype(np.float16),
    )
    write_image(image_path(folder, camera.name, frame), image)
    return {str(place(Path(), camera.name, frame)) for place in (image_path, pixels_path)}


def _studio(capture: Capture) -> Studio:
    """A studio that only asks what lies where: its texture and light are of no matter."""
    blank = np.zeros((8, 8, 3), dtype=np.uint8)
    truth = surface_truth(capture)
    surface = Surface(vertices=truth.rest, faces=truth.faces, uvs=truth.uvs, uv_faces=truth.uv_faces, part=truth.part)
    return Studio(probe(), surface, blank, Light(), depth=2)
