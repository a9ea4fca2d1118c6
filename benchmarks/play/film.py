"""Films: a motion from a camera, a spiral or a rig's cameras, methods and truth side by side, names burnt in."""

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Camera, Capture, Pose, image_path
from ash.files import InputError
from ash.protocol import StageClock
from benchmarks.cell import metrics
from benchmarks.play.actors import Cast
from benchmarks.play.cameras import RIG, SPIRAL, camera_named, first_camera, resized, spiral_camera
from benchmarks.play.motions import Act
from benchmarks.play.truth import TruthStudio, Wanted
from benchmarks.report.pictures import PAPER, on_paper

SUFFIXES = (".mp4", ".webp")
RIG_CAMERAS = 4
CAPTION = 26  # pixels above a row of pictures
INK = (20, 25, 35)
WEBP_QUALITY = 80
MP4_QUALITY = 8  # of imageio-ffmpeg's 0 to 10

Panel = Callable[[int, Camera], np.ndarray]  # frame and camera -> uint8 RGBA on black, of the camera's size


@dataclass(frozen=True, kw_only=True, slots=True)
class Script:
    """What a film shows."""

    act: Act
    frames: tuple[int, ...]
    camera: str  # a camera of the capture, `spiral`, or `rig`
    height: int  # pixels of one picture
    fps: float
    truth: bool


def shoot(cast: Cast, script: Script, tell: Callable[[str], None]) -> Iterator[np.ndarray]:
    """The film's frames, uint8 `[h, w, 3]`: a row per avatar for a rig's cameras, else one row.

    Raises:
        InputError: an unknown camera; no truth can be rendered.
    """
    panels = {title: _avatar_panel(cast, title, script.act) for title in cast.titles}
    studio = TruthStudio(cast.capture.folder)
    try:
        if script.truth:
            panels = {"Truth": _truth_panel(cast.capture, script.act, studio, tell), **panels}
        for step, frame in enumerate(script.frames):
            cameras = cameras_of(cast.capture, script, step)
            rows = [(title, [on_paper(panel(frame, camera)) for camera in cameras]) for title, panel in panels.items()]
            yield _sheet(rows, in_one_row=len(cameras) == 1)
    finally:
        studio.close()


def cameras_of(capture: Capture, script: Script, step: int) -> list[Camera]:
    """The cameras of one frame of the film, at its size."""
    first = first_camera(capture)
    size = {"height": script.height, "width": round(script.height * first.width / first.height)}
    if script.camera == SPIRAL:
        return [spiral_camera(capture, float(step), **size)]
    if script.camera == RIG:
        split = capture.splits.get("novel_view", capture.splits["train"])
        return [resized(capture.cameras[name], **size) for name in split.cameras[:RIG_CAMERAS]]
    return [resized(camera_named(capture, script.camera), **size)]


def _avatar_panel(cast: Cast, title: str, act: Act) -> Panel:
    actor = cast.actor(title)

    def draw(frame: int, camera: Camera) -> np.ndarray:
        return metrics.quantise(actor.picture(Pose(act.motion, frame), camera, StageClock()))

    return draw


def _truth_panel(capture: Capture, act: Act, studio: TruthStudio, tell: Callable[[str], None]) -> Panel:
    def draw(frame: int, camera: Camera) -> np.ndarray:
        known = capture_image(capture, act, frame, camera)
        if known is not None:
            return known
        tell(f"truth of frame {frame}, camera {camera.name}")
        wanted = Wanted(motion=act.motion, frame=frame, camera=camera, captured=act.captured)
        return metrics.on_black(studio.render(wanted, lambda _: None))

    return draw


def capture_image(capture: Capture, act: Act, frame: int, camera: Camera) -> np.ndarray | None:
    """The capture's own image of this view on black, None where it has none or of another size."""
    own = capture.cameras.get(camera.name)
    if not act.captured or own is None or (own.width, own.height) != (camera.width, camera.height):
        return None
    if not (np.array_equal(own.K, camera.K) and np.array_equal(own.viewmat, camera.viewmat)):
        return None
    if not image_path(capture.folder, camera.name, frame).is_file():
        return None
    return metrics.on_black(capture.image(camera.name, frame))


def _sheet(rows: list[tuple[str, list[np.ndarray]]], *, in_one_row: bool) -> np.ndarray:
    """Pictures with their row's name above: one beside the other, or a row each."""
    blocks = [_captioned(np.concatenate(pictures, axis=1), title) for title, pictures in rows]
    sheet = np.concatenate(blocks, axis=1 if in_one_row else 0)
    # Video codecs halve the colours' resolution: sides are even.
    return np.pad(sheet, ((0, sheet.shape[0] % 2), (0, sheet.shape[1] % 2), (0, 0)), mode="edge")


def _captioned(picture: np.ndarray, title: str) -> np.ndarray:
    strip = Image.new("RGB", (picture.shape[1], CAPTION), (PAPER,) * 3)
    ImageDraw.Draw(strip).text((8, 6), title, fill=INK, font=ImageFont.load_default(15))
    return np.concatenate([np.asarray(strip), picture])


def write_film(path: Path, frames: Iterator[np.ndarray], *, fps: float) -> int:
    """Write an mp4 (H.264) or an animated WebP, whole or not at all, and return the number of frames.

    Raises:
        InputError: another ending, or a folder that cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a film that ends with {' or '.join(SUFFIXES)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".film.", suffix=path.suffix)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    os.close(descriptor)
    temporary = Path(name)
    try:
        count = (_write_mp4 if path.suffix == ".mp4" else _write_webp)(temporary, frames, fps)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    import imageio_ffmpeg

    first = next(frames)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (first.shape[1], first.shape[0]),
        fps=fps,
        quality=MP4_QUALITY,
        macro_block_size=2,
        output_params=["-movflags", "+faststart"],
    )
    writer.send(None)
    count = 0
    try:
        for frame in chain([first], frames):
            writer.send(np.ascontiguousarray(frame))
            count += 1
    finally:
        writer.close()
    return count


def _write_webp(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    pictures = [Image.fromarray(frame) for frame in frames]
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / fps),
        loop=0,
        quality=WEBP_QUALITY,
        method=4,
    )
    return len(pictures)
