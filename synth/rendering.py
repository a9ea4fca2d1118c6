"""What the cameras and the scanner make of a scene: images with their truth, scans, and the empty studio."""

from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, background_path, image_path, pixels_path, scan_path
from ash.capture.formats import read_cameras, read_surface_truth
from ash.files import read_arrays, read_image, write_arrays, write_image
from synth.camera.render import Picture, Renderer, Studio, empty_studio
from synth.camera.scanning import scan
from synth.person.body import Surface
from synth.scene import Scene, stream
from synth.views import WantedView, is_scanned, splits

_STUDIOS: dict[tuple[str, str], Studio] = {}  # One per process and capture: it is costly to build and never changes.


def studio_of(scene: Scene, folder: Path, renderer: Renderer) -> Studio:
    """The studio of a capture with its person, one per process."""
    key = (scene.identity, str(folder))
    if key not in _STUDIOS:
        _STUDIOS.clear()
        arrays = read_arrays(folder / "truth" / "surface.npz", expected=("rest", "faces", "uvs", "uv_faces", "part"))
        surface = Surface(
            vertices=arrays["rest"],
            faces=arrays["faces"].astype(np.int64),
            uvs=arrays["uvs"],
            uv_faces=arrays["uv_faces"].astype(np.int64),
            part=arrays["part"].astype(np.int64),
        )
        image = read_image(folder / "truth" / "texture.png", shape=(scene.texture, scene.texture, 3))
        _STUDIOS[key] = Studio(renderer, surface, image, scene.light, depth=scene.depth)
    return _STUDIOS[key]


def render_views(scene: Scene, folder: Path, renderer: Renderer, views: list[WantedView]) -> int:
    """Render the views of one frame and write them; the image last, so that its presence means that all is there."""
    studio = studio_of(scene, folder, renderer)
    cameras = read_cameras(folder / "cameras.json")
    pose = read_surface_truth(folder, views[0].frame)
    _scan(scene, folder, studio, cameras, pose, views[0].frame)
    for view in views:  # Written one by one: every image is kept as soon as it is there.
        seed = stream(scene, "pixels", view.camera, view.frame)
        (picture,) = studio.render(pose, [cameras[view.camera]], samples=scene.samples, seeds=[seed])
        _write_view(folder, view, picture)
    return len(views)


def render_backgrounds(scene: Scene, folder: Path, renderer: Renderer) -> None:
    """Write the empty studio as every camera sees it."""
    cameras = list(read_cameras(folder / "cameras.json").values())
    if all(background_path(folder, camera.name).is_file() for camera in cameras):
        return
    for camera, image in zip(cameras, empty_studio(renderer, cameras, seed=stream(scene, "plates")), strict=True):
        write_image(background_path(folder, camera.name), image)


def _scan(scene: Scene, folder: Path, studio: Studio, cameras: dict[str, Camera], pose: np.ndarray, frame: int) -> None:
    """Write the scan of a training frame, where it is missing."""
    if not is_scanned(scene, frame) or scan_path(folder, frame).is_file():
        return
    studio.dress(pose)
    training = [cameras[name] for name in splits(scene)["train"].seeing(frame)]
    vertices, faces = scan(studio, training, scene.scanner, seed=stream(scene, "scan", frame))
    write_arrays(scan_path(folder, frame), vertices=vertices, faces=faces)


def _write_view(folder: Path, view: WantedView, picture: Picture) -> None:
    write_arrays(
        pixels_path(folder, view.camera, view.frame),
        triangle=picture.triangle,
        barycentric=picture.barycentric.astype(np.float16),
        noise=picture.noise.astype(np.float16),
    )
    write_image(image_path(folder, view.camera, view.frame), picture.rgba)
