"""Draw a sheet with a row for each scene, or with the first people of the cast:

    .venv/bin/python docs/scene_sheet.py OUT.webp SCENE...
    .venv/bin/python docs/scene_sheet.py OUT.webp --people N

A scene has five views: training views and, last, one of a new and one of a far pose where the scene has them. People
stand, eight in a row, in tight clothes and below in loose ones. Each is cropped to fill the tile. Only what is shown is
rendered; a scene takes about a minute, a person 20 seconds.
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
IN_A_ROW, OUTFITS = 8, ("tight", "loose")


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


def standing(outfit: str, subject: int) -> Image.Image:
    """A person who stands still, from the first camera, with the number."""
    still = presets.scene("still", size="ci")
    scene = replace(presets.scene(outfit, size="ci", subject=subject), train=still.train, test=still.test)
    (image,) = pictures(scene, [next(iter(splits(scene)["train"].views))])
    person = tile(image)
    ImageDraw.Draw(person).text((6, 6), str(subject))
    return person


def of_people(people: int) -> Image.Image:
    """The sheet of the first people."""
    starts = range(0, people, IN_A_ROW)
    rows = [(outfit, range(start, min(start + IN_A_ROW, people))) for start in starts for outfit in OUTFITS]
    sheet = Image.new("RGB", (min(people, IN_A_ROW) * TILE[0], len(rows) * TILE[1]), GREY)
    for index, (outfit, subjects) in enumerate(rows):
        for column, subject in enumerate(subjects):
            print(f"{outfit}, person {subject}", flush=True)
            sheet.paste(standing(outfit, subject), (column * TILE[0], index * TILE[1]))
    return sheet


def of_scenes(names: Sequence[str]) -> Image.Image:
    """The sheet of scenes.

    Raises:
        InputError: an unknown scene, before minutes of rendering.
    """
    for name in names:
        scene_of(name)
    sheet = Image.new("RGB", (VIEWS * TILE[0], len(names) * TILE[1]), GREY)
    for index, name in enumerate(names):
        print(f"{name} ({index + 1} of {len(names)})", flush=True)
        sheet.paste(row(name), (0, index * TILE[1]))
    return sheet


if __name__ == "__main__":
    out, *what = sys.argv[1:]
    try:
        made = of_people(int(what[1])) if what[:1] == ["--people"] else of_scenes(what)
    except InputError as error:
        sys.exit(str(error))
    made.save(out, quality=80)
