"""Draw a sheet with a row for each scene: .venv/bin/python docs/scene_sheet.py OUT.webp SCENE...

Each row has five views: training views and, last, one of a new and one of a far pose where the scene has them. Each
person is cropped to fill the tile. Only these views are rendered; a scene takes about a minute.
"""

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image, ImageDraw

from ash.capture.dataset import image_path
from ash.files import InputError
from benchmarks.cell.evaluation import spread
from synth import presets
from synth.camera.render import probe
from synth.capture import describe
from synth.rendering import render_views
from synth.scene import Scene
from synth.views import WantedView, splits

VIEWS, TILE, GREY = 5, (240, 320), (71, 71, 71)  # TILE: width, height in pixels


def row(name: str) -> Image.Image:
    """The scene's views beside one another."""
    scene = scene_of(name)
    line = Image.new("RGB", (VIEWS * TILE[0], TILE[1]), GREY)
    for column, image in enumerate(pictures(scene, shown(scene))):
        line.paste(tile(image), (column * TILE[0], 0))
    ImageDraw.Draw(line).text((6, 6), name)
    return line


def pictures(scene: Scene, views: Sequence[tuple[str, int]]) -> Iterator[Image.Image]:
    """RGBA images of a scene, cameras and frames given, twice as high as a tile."""
    scene = replace(scene, rig=replace(scene.rig, width=2 * TILE[1], height=2 * TILE[1]), samples=32)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with ProcessPoolExecutor(mp_context=get_context("spawn")) as executor:
            describe(scene, folder, executor)
        for camera, frame in views:
            render_views(scene, folder, probe(), [WantedView(camera=camera, frame=frame)])
            yield Image.open(image_path(folder, camera, frame))


def scene_of(name: str) -> Scene:
    """The scene of reports; an InputError names the known ones."""
    return presets.scene(name, size="quick" if name in ("tight", "loose") else "factor")


def shown(scene: Scene) -> list[tuple[str, int]]:
    """Camera and frame of views: evenly spaced training images, then the middle ones of new and of far poses."""
    parts = splits(scene)
    poses = [list(parts[name].views) for name in ("novel_pose", "far_pose") if name in parts]
    training = list(parts["train"].views)
    spaced = [training[index] for index in spread(len(training), VIEWS - len(poses))]
    return spaced + [views[len(views) // 2] for views in poses]


def tile(image: Image.Image) -> Image.Image:
    """The person of an RGBA image on grey, with a margin of 6 % above and below."""
    left, top, right, bottom = image.getchannel("A").getbbox()
    height = max(1.12 * (bottom - top), 1.12 * (right - left) * TILE[1] / TILE[0])
    width, x, y = height * TILE[0] / TILE[1], (left + right) / 2, (top + bottom) / 2
    box = [round(edge) for edge in (x - width / 2, y - height / 2, x + width / 2, y + height / 2)]
    person = image.crop(box).resize(TILE, Image.Resampling.LANCZOS)
    return Image.alpha_composite(Image.new("RGBA", TILE, (*GREY, 255)), person).convert("RGB")


if __name__ == "__main__":
    out, *names = sys.argv[1:]
    try:
        for name in names:
            scene_of(name)
    except InputError as error:  # before minutes of rendering
        sys.exit(str(error))
    sheet = Image.new("RGB", (VIEWS * TILE[0], len(names) * TILE[1]), GREY)
    for index, name in enumerate(names):
        print(f"{name} ({index + 1} of {len(names)})", flush=True)
        sheet.paste(row(name), (0, index * TILE[1]))
    sheet.save(out, quality=80)
