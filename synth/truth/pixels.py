"""What every pixel of a capture sees, derived exactly from the stored triangle and barycentrics.

Nothing here is rendered: each channel is a function of the posed surface, so it is exact to the float.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from ash.capture.dataset import Capture, pixels_path
from ash.capture.formats import read_surface_truth
from ash.files import InputError, read_arrays
from synth.person.body import Surface, vertex_normals


@dataclass(frozen=True, kw_only=True, slots=True)
class PixelTruth:
    """The stored truth of a view: what each pixel's centre hits."""

    camera: str
    frame: int
    triangle: np.ndarray  # [h, w] int64, -1: none
    weights: np.ndarray  # [h, w, 3] of the triangle's corners, zero where there is none
    noise: np.ndarray  # [h, w] variance of sRGB in 0..1

    @property
    def covered(self) -> np.ndarray:
        """Where the surface is hit, `[h, w]` bool."""
        return self.triangle >= 0


def pixel_truth(capture: Capture, camera: str, frame: int) -> PixelTruth:
    """Read the truth of a view.

    Raises:
        InputError: the file is missing, damaged or does not fit the camera or the surface.
    """
    path = pixels_path(capture.folder, camera, frame)
    arrays = read_arrays(path, expected=("triangle", "barycentric", "noise"))
    view = capture.cameras[camera]
    shape = (view.height, view.width)
    triangle, rest = arrays["triangle"].astype(np.int64), arrays["barycentric"].astype(np.float64)
    if triangle.shape != shape or rest.shape != (*shape, 2) or arrays["noise"].shape != shape:
        raise InputError(f"{path}: expected channels of {shape[0]}x{shape[1]}")
    if triangle.max() >= len(surface_truth(capture).faces):
        raise InputError(f"{path}: names a triangle that the surface lacks")
    weights = np.concatenate([1 - rest.sum(axis=-1, keepdims=True), rest], axis=-1)
    return PixelTruth(
        camera=camera,
        frame=frame,
        triangle=triangle,
        weights=np.where(triangle[..., None] >= 0, weights, 0.0),
        noise=arrays["noise"].astype(np.float64),
    )


def surface_truth(capture: Capture) -> Surface:
    """Read the rendered surface at rest, whose faces and UVs all frames share."""
    names = ("rest", "faces", "uvs", "uv_faces", "part")
    arrays = read_arrays(capture.folder / "truth" / "surface.npz", expected=names)
    rest, uvs = (arrays[name].astype(np.float64) for name in ("rest", "uvs"))
    faces, uv_faces, part = (arrays[name].astype(np.int64) for name in ("faces", "uv_faces", "part"))
    return Surface(vertices=rest, faces=faces, uvs=uvs, uv_faces=uv_faces, part=part)


def posed_surface(capture: Capture, frame: int) -> np.ndarray:
    """Vertices of the rendered surface in a frame, `[s, 3]` metres."""
    return read_surface_truth(capture.folder, frame).astype(np.float64)


def mix(pixels: PixelTruth, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values per vertex `[s, k]` over the pixels, `[h, w, k]`; zero where nothing is hit."""
    corners = values[faces[np.maximum(pixels.triangle, 0)]]
    return np.einsum("hwc,hwck->hwk", pixels.weights, corners)


def points(capture: Capture, pixels: PixelTruth, *, frame: int | None = None) -> np.ndarray:
    """World position of what each pixel sees, `[h, w, 3]`; with `frame`, where that same spot of cloth is then."""
    vertices = posed_surface(capture, pixels.frame if frame is None else frame)
    return mix(pixels, surface_truth(capture).faces, vertices)


def depth(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Depth along the optical axis, `[h, w]` metres; zero where nothing is hit."""
    view = capture.cameras[pixels.camera]
    in_camera = points(capture, pixels) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    return np.where(pixels.covered, in_camera[..., 2], 0.0)


def normals(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Unit shading normals in the world, `[h, w, 3]`, as the renderer interpolates them; zero where nothing is hit."""
    faces = surface_truth(capture).faces
    mixed = mix(pixels, faces, vertex_normals(posed_surface(capture, pixels.frame), faces))
    return mixed / np.maximum(np.linalg.norm(mixed, axis=-1, keepdims=True), 1e-12)


def uvs(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Where in the atlas each pixel lies, `[h, w, 2]`, v up."""
    surface = surface_truth(capture)
    return mix(pixels, surface.uv_faces, surface.uvs)


def parts(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Part label per pixel, `[h, w]` index into `synth.person.body.PARTS`; -1 where nothing is hit."""
    return np.where(pixels.covered, surface_truth(capture).part[np.maximum(pixels.triangle, 0)], -1)


def flow(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Optical flow to the next frame, `[h, w, 2]` pixels: where the spot seen here will be, seen or hidden.

    Raises:
        ValueError: the frame is the last of its sequence.
    """
    following = pixels.frame + 1
    sequence = capture.motion.sequence
    if following >= len(sequence) or sequence[following] != sequence[pixels.frame]:
        raise ValueError(f"frame {pixels.frame} is the last of its sequence, expected one with a next frame")
    view = capture.cameras[pixels.camera]
    safe = np.where(pixels.covered[..., None], 0, view.position + view.viewmat[2, :3])
    before, _ = view.project(points(capture, pixels) + safe)
    after, _ = view.project(points(capture, pixels, frame=following) + safe)
    return np.where(pixels.covered[..., None], after - before, 0.0)


def albedo(capture: Capture, pixels: PixelTruth) -> np.ndarray:
    """Colour of the cloth before light, `[h, w, 3]` sRGB in 0..1, read bilinearly from the painted texture."""
    with Image.open(capture.folder / "truth" / "texture.png") as image:
        texture = np.asarray(image, dtype=np.float64) / 255
    u, v = np.moveaxis(uvs(capture, pixels), -1, 0)
    place = (1 - v) * texture.shape[0] - 0.5, u * texture.shape[1] - 0.5  # row and column
    colours = [map_coordinates(texture[..., channel], place, order=1, mode="nearest") for channel in range(3)]
    return np.where(pixels.covered[..., None], np.stack(colours, axis=-1), 0.0)
