"""Videos: a motion from a camera, a spiral or a rig's cameras, methods and truth side by side, each with its name."""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Camera, Capture, Pose
from ash.files import InputError
from benchmarks.play.avatars import AvatarSet
from benchmarks.play.cameras import RIG, SPIRAL, camera_named, first_camera, resized, spiral_camera
from benchmarks.play.motions import MotionClip
from benchmarks.play.truth import TruthCache, TruthRenderer
from benchmarks.report.pictures import PAPER, on_paper

RIG_CAMERAS = 4
CAPTION = 26  # pixels above a row of pictures
INK = (20, 25, 35)
WEBP_QUALITY = 80
MP4_QUALITY = 8  # of imageio-ffmpeg's 0 to 10


@dataclass(frozen=True, kw_only=True, slots=True)
class VideoSpec:
    """What a video shows."""

    clip: MotionClip
    frames: tuple[int, ...]
    camera: str  # a camera of the capture, `spiral`, or `rig`
    height: int  # pixels of one picture
    truth: bool


def render_video(avatars: AvatarSet, spec: VideoSpec, on_progress: Callable[[str], None]) -> Iterator[np.ndarray]:
    """The video's frames, uint8 `[h, w, 3]`: a row per avatar for a rig's cameras, else one row.

    Raises:
        InputError: an unknown camera; no truth can be rendered.
    """
    cameras_of(avatars.capture, spec, 0)  # An unknown camera is refused before avatars are loaded.
    clip, titles = spec.clip, (*(["Truth"] if spec.truth else []), *avatars.titles)
    loaded, truths = {title: avatars[title] for title in avatars.titles}, TruthCache(avatars.capture)
    with closing(TruthRenderer(avatars.capture.folder)) as truth:

        def picture(title: str, frame: int, camera: Camera) -> np.ndarray:
            pose = Pose(clip.motion, frame)
            if title in loaded:
                return on_paper(loaded[title].on_black(pose, camera))
            truth_frame = truths.find(clip, frame, camera)
            size = (camera.width, camera.height)
            if truth_frame is not None and (truth_frame.camera.width, truth_frame.camera.height) == size:
                return on_paper(truth_frame.on_black)
            on_progress(f"truth of frame {frame}, camera {camera.name}")
            return on_paper(truth.render(pose, camera, captured=clip.captured))

        for step, frame in enumerate(spec.frames):
            cameras = cameras_of(avatars.capture, spec, step)
            rows = [_captioned([picture(title, frame, camera) for camera in cameras], title) for title in titles]
            sheet = np.concatenate(rows, axis=1 if len(cameras) == 1 else 0)
            # Video codecs halve the colours' resolution: sides are even.
            yield np.pad(sheet, ((0, sheet.shape[0] % 2), (0, sheet.shape[1] % 2), (0, 0)), mode="edge")


def cameras_of(capture: Capture, spec: VideoSpec, step: int) -> list[Camera]:
    """The cameras of one frame of the video, at its size."""
    first = first_camera(capture)
    size = {"height": spec.height, "width": round(spec.height * first.width / first.height)}
    if spec.camera == SPIRAL:
        return [spiral_camera(capture, step, **size)]
    if spec.camera == RIG:
        split = capture.splits.get("novel_view", capture.splits["train"])
        return [resized(capture.cameras[name], **size) for name in split.cameras[:RIG_CAMERAS]]
    return [resized(camera_named(capture, spec.camera), **size)]


def _captioned(pictures: list[np.ndarray], title: str) -> np.ndarray:
    row = np.concatenate(pictures, axis=1)
    strip = Image.new("RGB", (row.shape[1], CAPTION), (PAPER,) * 3)
    ImageDraw.Draw(strip).text((8, 6), title, fill=INK, font=ImageFont.load_default(15))
    return np.concatenate([np.asarray(strip), row])


def write_video(path: Path, frames: Iterator[np.ndarray], *, fps: float) -> int:
    """Write an mp4 (H.264) or an animated WebP by the path's suffix, whole or not at all; the number of frames.

    Raises:
        InputError: a folder that cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".video.", suffix=path.suffix)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    os.close(descriptor)
    temporary = Path(name)
    try:
        count = (_write_webp if path.suffix == ".webp" else _write_mp4)(temporary, frames, fps)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    import imageio_ffmpeg

    first = next(frames)
    options = {"fps": fps, "quality": MP4_QUALITY, "macro_block_size": 2, "output_params": ["-movflags", "+faststart"]}
    count = 0
    with closing(imageio_ffmpeg.write_frames(str(path), (first.shape[1], first.shape[0]), **options)) as writer:
        writer.send(None)
        for frame in chain([first], frames):
            writer.send(np.ascontiguousarray(frame))
            count += 1
    return count


def _write_webp(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    first, *rest = (Image.fromarray(frame) for frame in frames)
    options: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0, "quality": WEBP_QUALITY, "method": 4}
    first.save(path, save_all=True, append_images=rest, **options)
    return 1 + len(rest)
