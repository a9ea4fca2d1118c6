"""Contact sheets and turntables: what a scene looks like at a glance."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from ash.dataset import Capture, image_path
from ash.files import read_image
from synth import presets
from synth.capture import View, describe, render_views
from synth.render import probe
from synth.scene import Rig, Scene

SHOWN = ("still", "skinned", *presets.RUNGS, "tight", "loose")
WIDTH, HEIGHT = 240, 320
AROUND = 24  # pictures of a turntable
VIEWS = (0, 21, 12, 4)  # of them, beside the motions of a sheet; the last column is the test motion
BACKGROUND = 0.28  # grey under the transparent parts


def flatten(rgba: np.ndarray) -> np.ndarray:
    """An RGBA image over grey, uint8 `[h, w, 3]`."""
    alpha = rgba[..., 3:] / 255
    return np.round(rgba[..., :3] * alpha + 255 * BACKGROUND * (1 - alpha)).astype(np.uint8)


def contact_sheet(capture: Capture, *, cameras: int = 4, frames: int = 8) -> np.ndarray:
    """Training views, one row per camera, spread over rig and motion; the last columns show test poses."""
    train, test = capture.splits["train"], capture.splits["novel_pose"]
    rows = []
    shown = _spread(train.cameras, cameras)
    held_out = _spread(test.cameras, cameras)
    for k, camera in enumerate(shown):
        row = [flatten(capture.image(camera, frame)) for frame in _spread(train.frames, frames - 2)]
        row += [flatten(capture.image(held_out[k % len(held_out)], frame)) for frame in _spread(test.frames, 2)]
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def draw_sheets(out: Path, names: tuple[str, ...]) -> list[Path]:
    """Draw `rungs.png`, a row for each scene (a pose of every training clip, then one of the test), and a turntable.

    Only the pictures that are shown are rendered: the scenes are those of size `quick`, at 240x320 pixels.
    """
    rows = []
    for name in names:
        scene = _shown(name)
        with tempfile.TemporaryDirectory(prefix="ash-bench-sheet-") as folder:
            describe(scene, Path(folder))
            row = np.concatenate([_picture(scene, Path(folder), view) for view in _poses(scene)], axis=1)
            rows.append(_labelled(row, name))
            if name == names[-1]:
                turning = [View(camera=f"cam{k:03d}", frame=_poses(scene)[1].frame) for k in range(AROUND)]
                around = [Image.fromarray(_picture(scene, Path(folder), view)) for view in turning]
    out.mkdir(parents=True, exist_ok=True)
    sheet, turntable = out / "rungs.png", out / "turntable.webp"
    Image.fromarray(np.concatenate(rows)).save(sheet, optimize=True)
    around[0].save(turntable, save_all=True, append_images=around[1:], duration=120, loop=0, quality=80)
    return [sheet, turntable]


def _shown(name: str) -> Scene:
    rig = Rig(kind="ring", cameras=AROUND, held_out=1, width=WIDTH, height=HEIGHT)
    return replace(presets.scene(name, size="quick"), rig=rig, texture=1024)


def _poses(scene: Scene) -> list[View]:
    """A view of the middle of every clip; of a single clip, from every side."""
    clips = scene.train if len(scene.train) > 1 else scene.train * len(VIEWS)
    first, views = 0, []
    for clip, camera in zip((*clips, *scene.test), (*VIEWS, 2), strict=False):
        views.append(View(camera=f"cam{camera:03d}", frame=first + clip.frames // 2))
        first += clip.frames if len(scene.train) > 1 else 0
    return views


def _picture(scene: Scene, folder: Path, view: View) -> np.ndarray:
    render_views(scene, folder, probe(), [view])
    return flatten(read_image(image_path(folder, view.camera, view.frame), shape=(HEIGHT, WIDTH, 4)))


def _labelled(row: np.ndarray, name: str) -> np.ndarray:
    image = Image.fromarray(row)
    ImageDraw.Draw(image).text((6, 4), name, fill=(235, 235, 235))
    return np.asarray(image)


def write_turntable(capture: Capture, path: Path, *, milliseconds: int = 90) -> None:
    """Write an animated picture (WebP or GIF, by the file's name): the motion seen from cameras in order of azimuth."""
    train = capture.splits["train"]
    azimuth = {name: np.arctan2(*capture.cameras[name].position[[0, 2]]) for name in train.cameras}
    around = sorted(train.cameras, key=lambda name: azimuth[name])
    frames = []
    for k, frame in enumerate(train.frames):
        camera = around[k * len(around) // len(train.frames)]
        frames.append(Image.fromarray(flatten(capture.image(camera, frame))))
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)


def _spread(items: tuple, count: int) -> list:
    return [items[k] for k in np.round(np.linspace(0, len(items) - 1, min(count, len(items)))).astype(int)]
