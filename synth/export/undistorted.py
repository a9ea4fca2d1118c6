"""From lenses that distort to pinholes: what a lab does with its footage before a method sees it.

Images and masks are resampled, as a lab has to; the truth per pixel, where a capture has it, is traced again for the
pinhole, so it stays exact.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Capture, image_path, pixels_path
from ash.capture.formats import load_capture, read_surface_truth, write_cameras
from ash.files import InputError, read_arrays, write_arrays, write_image
from synth.camera.render import Studio, probe
from synth.camera.resampling import resample, resample_rgba
from synth.perturbation.perturb import finish_copy
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
    write_cameras(folder / "cameras.json", list(pinholes.values()))
    written = {"cameras.json"}
    studio = _studio(capture) if (source / "truth" / "surface.npz").is_file() else None
    for name, frame in {view for split in capture.splits.values() for view in split.views}:
        camera, pinhole = capture.cameras[name], pinholes[name]
        if camera.is_pinhole:
            continue
        write_image(image_path(folder, name, frame), resample_rgba(capture.image(name, frame), camera, pinhole))
        written.add(str(image_path(Path(), name, frame)))
        if studio is not None:
            studio.dress(read_surface_truth(source, frame))
            write_arrays(pixels_path(folder, name, frame), **_pixel_truth(capture, pinhole, frame, studio))
            written.add(str(pixels_path(Path(), name, frame)))
    manifest = replace(capture.manifest, undistorted={"of": capture.identity})
    return finish_copy(source, folder, manifest, written=written, unchanged=set(manifest.files))


def _pixel_truth(capture: Capture, pinhole: Camera, frame: int, studio: Studio) -> dict[str, np.ndarray]:
    noise = read_arrays(pixels_path(capture.folder, pinhole.name, frame), expected=("noise",))["noise"]
    variance, squares = resample(noise[..., None], capture.cameras[pinhole.name], pinhole)
    triangle, barycentric = studio.look(pinhole)
    noise = (variance[..., 0] * squares).astype(np.float16)
    return {"triangle": triangle, "barycentric": barycentric.astype(np.float16), "noise": noise}


def _studio(capture: Capture) -> Studio:
    """A studio that only asks what lies where: its texture and light are of no matter."""
    blank = np.zeros((8, 8, 3), dtype=np.uint8)
    return Studio(probe(), surface_truth(capture), blank, Light(), depth=2)
