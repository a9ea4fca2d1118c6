"""Stress: pure, seeded functions from a capture to a capture, so that truth stays truth.

Only what a method may learn from or is told changes (training images, tracked motion, calibration of training cameras,
which views exist); test images, their cameras and everything under `truth/` are the original's bytes.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter1d

from ash.capture.dataset import Camera, Capture, Motion, background_path, image_path, pixels_path, spread_cameras
from ash.capture.formats import load_capture, write_cameras, write_motion
from ash.capture.manifest import Manifest
from ash.files import InputError, hash_of, link_or_copy, read_arrays, read_image, sha256_of, write_image
from synth.camera.resampling import resample_rgba
from synth.posing import rotvec_to_rotmat


@dataclass(frozen=True, kw_only=True, slots=True)
class Perturbation:
    """Severities; zero (or None) leaves a part as it is."""

    tracking_deg: float = 0.0  # rms error of tracked joint rotations, smooth in time
    tracking_mm: float = 0.0  # rms error of the tracked root
    calibration_px: float = 0.0  # rms shift of training images by wrong extrinsics
    lens_px: float = 0.0  # radial distortion of training images that no calibration tells: its shift at the near border
    mask_px: int = 0  # training masks dilated (> 0), so that the studio shows, or eroded (< 0)
    exposure_stops: float = 0.0  # rms drift of brightness between training cameras
    colour_stops: float = 0.0  # rms drift of each channel's brightness between training cameras
    noise_factor: float = 1.0  # variance of training images' noise as a multiple of the renders' own
    cameras: int | None = None  # how many training cameras are left, spread evenly
    frames: int | None = None  # how many training frames are left, spread evenly over time
    first_frames: int | None = None  # how many training frames are left, the first of the training motion

    def __post_init__(self) -> None:
        for name in ("tracking_deg", "tracking_mm", "calibration_px", "lens_px", "exposure_stops", "colour_stops"):
            if not 0 <= getattr(self, name) <= 1000:
                raise InputError(f"perturbation: {name} is {getattr(self, name)}, expected 0 to 1000")
        if not (1 <= self.noise_factor <= 1e6 and abs(self.mask_px) <= 100):
            raise InputError("perturbation: expected noise_factor from 1 and mask_px between -100 and 100")
        for name in ("cameras", "frames", "first_frames"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise InputError(f"perturbation: {name} is {getattr(self, name)}, expected at least 1")


def perturb(source: Path, folder: Path, perturbation: Perturbation, *, seed: int = 0) -> Path:
    """Write the perturbed capture of `source` into `folder` and return it. Unchanged files are linked, not copied."""
    capture = load_capture(source)
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: expected an empty folder")
    changed = _subset(capture, perturbation)
    written = _write_changed(capture, changed, folder, perturbation, seed)
    perturbed = {"of": capture.identity, "seed": seed, **asdict(perturbation)}
    manifest = replace(capture.manifest, splits=changed.splits, perturbed=perturbed)
    return finish_copy(source, folder, manifest, written=written, unchanged=_unchanged_files(changed, perturbation))


def finish_copy(source: Path, folder: Path, manifest: Manifest, *, written: set[str], unchanged: set[str]) -> Path:
    """Link the unchanged files of the capture `source` beside those `written` into `folder`; the manifest comes last.

    `manifest`: with the hashes of the files of `source`. Returns `folder`.
    """
    for name in unchanged - written:
        link_or_copy(source / name, folder / name)
    files = {
        name: sha256_of(folder / name) if name in written else manifest.files[name]
        for name in sorted(unchanged | written)
    }
    replace(manifest, files=files).write(folder)
    return folder


def _subset(capture: Capture, perturbation: Perturbation) -> Capture:
    """The capture with fewer training cameras and frames; test splits stay."""
    train = capture.splits["train"]
    cameras, frames = train.cameras, train.frames
    if perturbation.cameras is not None:
        cameras = spread_cameras(capture, perturbation.cameras)
    for count in (perturbation.frames, perturbation.first_frames):
        if count is not None and count > len(frames):
            raise InputError(f"perturbation: {count} frames of {len(frames)}")
    if perturbation.frames is not None:
        chosen = np.unique(np.round(np.linspace(0, len(frames) - 1, perturbation.frames)).astype(int))
        frames = tuple(frames[k] for k in chosen)
    frames = frames[: perturbation.first_frames]
    return replace(capture, splits={**capture.splits, "train": train.only(cameras=cameras, frames=frames)})


def _unchanged_files(capture: Capture, perturbation: Perturbation) -> set[str]:
    """Files of the original that the perturbed capture still has: all but images of dropped views, and scans.

    A scan is made from all training images: it would give back what was taken away. Where nothing is, it stays.
    """
    views = {pair for split in capture.splits.values() for pair in split.views}
    shown = {str(place(Path(), *view)) for view in views for place in (image_path, pixels_path)}
    dropped = ("frames/", "truth/pixels/") + (("scans/",) if perturbation != Perturbation() else ())
    return {name for name in capture.manifest.files if name in shown or not name.startswith(dropped)}


def _write_changed(
    original: Capture, capture: Capture, folder: Path, perturbation: Perturbation, seed: int
) -> set[str]:
    """Write what changes, and return the files' names."""
    written = set()
    if perturbation.tracking_deg or perturbation.tracking_mm:
        write_motion(folder / "motion.npz", mistrack(original.motion, perturbation, seed=seed))
        written.add("motion.npz")
    if perturbation.calibration_px:
        names = set(capture.splits["train"].cameras)
        cameras = [
            miscalibrate(camera, perturbation.calibration_px, seed=seed) if name in names else camera
            for name, camera in original.cameras.items()
        ]
        write_cameras(folder / "cameras.json", cameras)
        written.add("cameras.json")
    drifts = perturbation.exposure_stops or perturbation.colour_stops
    if perturbation.mask_px or perturbation.lens_px or drifts or perturbation.noise_factor > 1:
        for camera, frame in capture.splits["train"].views:
            write_image(image_path(folder, camera, frame), _spoil(original, camera, frame, perturbation, seed))
            written.add(str(image_path(Path(), camera, frame)))
    return written


def mistrack(motion: Motion, perturbation: Perturbation, *, seed: int) -> Motion:
    """Motion as a tracker with errors reports it: smooth in time, with the stated rms per joint and of the root."""
    rng = np.random.default_rng([seed, 1])
    noise = rng.standard_normal(motion.dofs.shape)
    for index in np.unique(motion.sequence):
        chosen = motion.sequence == index
        noise[chosen] = gaussian_filter1d(noise[chosen], 1.5, axis=0, mode="wrap")
    noise /= np.sqrt(np.mean(noise**2, axis=0, keepdims=True))
    scale = np.full(motion.dofs.shape[1], np.deg2rad(perturbation.tracking_deg) / np.sqrt(3))
    scale[:3] = perturbation.tracking_mm / 1000 / np.sqrt(3)
    return replace(motion, dofs=motion.dofs + scale * noise)


def miscalibrate(camera: Camera, pixels: float, *, seed: int) -> Camera:
    """The camera turned by a small random rotation that shifts its image by about `pixels` rms."""
    rng = np.random.default_rng([seed, 2, int(hash_of(camera.name)[:8], 16)])
    angles = rng.standard_normal(3) * pixels / np.sqrt(2) / camera.K[0, 0]
    viewmat = camera.viewmat.copy()
    viewmat[:3] = rotvec_to_rotmat(angles) @ viewmat[:3]
    return replace(camera, viewmat=viewmat)


def _spoil(capture: Capture, camera: str, frame: int, perturbation: Perturbation, seed: int) -> np.ndarray:
    image = capture.image(camera, frame)
    colour, alpha = image[..., :3].astype(np.float64) / 255, image[..., 3]
    rng = np.random.default_rng([seed, 3, int(hash_of([camera, frame])[:8], 16)])
    if perturbation.noise_factor > 1:
        variance = read_arrays(pixels_path(capture.folder, camera, frame), expected=("noise",))["noise"]
        deviation = np.sqrt(np.maximum(variance.astype(np.float64), 0) * (perturbation.noise_factor - 1))
        colour = colour + deviation[..., None] * rng.standard_normal(colour.shape)
    if perturbation.exposure_stops or perturbation.colour_stops:
        own = np.random.default_rng([seed, 4, int(hash_of(camera)[:8], 16)])
        stops = perturbation.exposure_stops * own.standard_normal() + perturbation.colour_stops * own.standard_normal(3)
        colour = np.clip(np.clip(colour, 0, 1) ** 2.2 * 2**stops, 0, 1) ** (1 / 2.2)
    if perturbation.mask_px > 0:  # What lay behind the person is now part of the picture.
        share = alpha[..., None] / 255
        colour = share * colour + (1 - share) * _plate(capture, camera)
    if perturbation.mask_px:
        alpha = _shift_mask(alpha, perturbation.mask_px)
    rgb = np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)
    image = np.concatenate([np.where(alpha[..., None] > 0, rgb, 0), alpha[..., None]], axis=-1)
    return through_lens(image, capture.cameras[camera], perturbation.lens_px) if perturbation.lens_px else image


def through_lens(image: np.ndarray, camera: Camera, pixels: float) -> np.ndarray:
    """An image (uint8 RGBA, straight alpha) as a lens with pincushion distortion shows it.

    `pixels`: the shift at the middle of the border that is nearer to the centre; it falls with the cube of the radius.

    Raises:
        InputError: the camera has a lens already.
    """
    if not camera.is_pinhole:
        raise InputError(f"perturbation: lens_px needs pinhole cameras, and {camera.name} has a distortion")
    focal = np.diag(camera.K)[:2]
    border = float(min((camera.width, camera.height) / focal)) / 2
    lens = np.array([pixels / (focal.mean() * border**3), 0, 0, 0])
    return resample_rgba(image, camera, replace(camera, distortion=lens))


def _plate(capture: Capture, name: str) -> np.ndarray:
    path, camera = background_path(capture.folder, name), capture.cameras[name]
    if not path.is_file():
        raise InputError(f"{path}: masks that are too large show the studio, expected a picture of it")
    return read_image(path, shape=(camera.height, camera.width, 3)).astype(np.float64) / 255


def _shift_mask(alpha: np.ndarray, pixels: int) -> np.ndarray:
    inside = alpha > 127
    cross = np.ones((3, 3), dtype=bool)
    if pixels > 0:
        grown = binary_dilation(inside, cross, iterations=pixels)
        return np.where(grown, 255, alpha).astype(np.uint8)
    return np.where(binary_erosion(inside, cross, iterations=-pixels), alpha, 0).astype(np.uint8)
