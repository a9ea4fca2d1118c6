"""A contact sheet of all scenes and a turntable: what a scene looks like at a glance."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from ash.capture.dataset import image_path
from ash.files import read_image
from synth import presets
from synth.camera.render import probe
from synth.capture import describe
from synth.scene import Rig, Scene
from synth.shooting import render_views
from synth.views import WantedView

SHOWN = ("still", "skinned", *presets.RUNGS, "tight", "loose")
WIDTH, HEIGHT = 240, 320
AROUND = 24  # pictures of a turntable
VIEWS = (0, 21, 12, 4)  # of them, beside the motions of a sheet; the last column is the test motion
BACKGROUND = 0.28  # grey under the transparent parts


def flatten(rgba: np.ndarray) -> np.ndarray:
    """An RGBA image over grey, uint8 `[h, w, 3]`."""
    alpha = rgba[..., 3:] / 255
    return np.round(rgba[..., :3] * alpha + 255 * BACKGROUND * (1 - alpha)).astype(np.uint8)


Draw = Callable[[Scene, Sequence[WantedView]], list[np.ndarray]]  # RGBA of views of a scene, uint8 `[h, w, 4]`.


def path_traced(scene: Scene, views: Sequence[WantedView]) -> list[np.ndarray]:
    """Views of a scene as its capture has them."""
    with tempfile.TemporaryDirectory(prefix="ash-bench-sheet-") as name:
        folder = Path(name)
        describe(scene, folder)
        render_views(scene, folder, probe(), list(views))
        shape = (scene.rig.height, scene.rig.width, 4)
        return [read_image(image_path(folder, view.camera, view.frame), shape=shape) for view in views]


def draw_sheets(out: Path, scenes: Sequence[tuple[str, Scene, Draw]]) -> list[Path]:
    """Draw `rungs.png`, a row for each scene (a pose of every training clip, then one of the test), and a turntable.

    Only the pictures that are shown are drawn, at 240x320 pixels; the turntable is of the last scene.
    """
    rows: list[np.ndarray] = []
    around: list[Image.Image] = []
    for name, full, draw in scenes:
        scene = _shown(full)
        poses = _poses(scene)
        last = len(rows) == len(scenes) - 1
        turning = [WantedView(camera=f"cam{k:03d}", frame=poses[1].frame) for k in range(AROUND)] if last else []
        drawn = [flatten(image) for image in draw(scene, list(dict.fromkeys([*poses, *turning])))]
        pictures = dict(zip(dict.fromkeys([*poses, *turning]), drawn, strict=True))
        rows.append(_labelled(np.concatenate([pictures[view] for view in poses], axis=1), name))
        around = [Image.fromarray(pictures[view]) for view in turning]
    out.mkdir(parents=True, exist_ok=True)
    sheet, turntable = out / "rungs.png", out / "turntable.webp"
    Image.fromarray(np.concatenate(rows)).save(sheet, optimize=True)
    around[0].save(turntable, save_all=True, append_images=around[1:], duration=120, loop=0, quality=80)
    return [sheet, turntable]


def _shown(scene: Scene) -> Scene:
    rig = Rig(kind="ring", cameras=AROUND, held_out=1, width=WIDTH, height=HEIGHT)
    return replace(scene, rig=rig, texture=1024)


def _poses(scene: Scene) -> list[WantedView]:
    """A view of the middle of every clip; of a single clip, from every side."""
    clips = scene.train if len(scene.train) > 1 else scene.train * len(VIEWS)
    first, views = 0, []
    for clip, camera in zip((*clips, *scene.test), (*VIEWS, 2), strict=False):
        views.append(WantedView(camera=f"cam{camera:03d}", frame=first + clip.frames // 2))
        first += clip.frames if len(scene.train) > 1 else 0
    return views


def _labelled(row: np.ndarray, name: str) -> np.ndarray:
    image = Image.fromarray(row)
    ImageDraw.Draw(image).text((6, 4), name, fill=(235, 235, 235))
    return np.asarray(image)
