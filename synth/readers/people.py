"""A sheet of the cast: subjects side by side, each in both outfits, one path-traced view of a standing pose."""

import io
import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from ash.files import InputError, write_atomic
from synth import presets
from synth.camera.render import Studio, probe
from synth.camera.rig import make_cameras
from synth.capture import make_body
from synth.cloth.surface import true_surface
from synth.motion.clips import make_motion
from synth.person import texture
from synth.person.anny_body import baked_body
from synth.person.cast import subject
from synth.readers.sheets import flatten
from synth.scene import Clip, Rig, Scene, stream

OUTFITS = ("tight", "loose")
WIDTH, HEIGHT = 256, 384
ACROSS = 8  # subjects in a row
SAMPLES = 32  # per pixel
QUALITIES = (84, 76, 68, 60, 50)  # of the file, the first that is small enough
LARGEST = 400_000  # bytes
ROOM = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (0.0, 1.9)])  # all are seen as large


def draw_cast(out: Path, numbers: Sequence[int], *, workers: int = 1) -> Path:
    """Draw the subjects into `out/cast.webp`: a row of tight outfits, the loose ones of the same people below.

    Raises:
        InputError: more subjects than fit into a picture of 400 kB.
    """
    for number in numbers:
        baked_body(number)  # A block of subjects at once, before processes that would all do it.
    scenes = {(outfit, number): _standing(outfit, number) for outfit in OUTFITS for number in numbers}
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        pictures = dict(zip(scenes, pool.map(draw_person, scenes.values()), strict=True))
    content = encoded(laid_out(pictures))
    write_atomic(out / "cast.webp", content)
    return out / "cast.webp"


def laid_out(pictures: Mapping[tuple[str, int], np.ndarray]) -> Image.Image:
    """Pictures `[h, w, 4]` of outfits and numbers as a sheet: eight subjects in a row, an outfit below the other."""
    numbers = list(dict.fromkeys(number for _, number in pictures))
    across = min(ACROSS, len(numbers))
    sheet = Image.new("RGB", (across * WIDTH, -(-len(numbers) // across) * len(OUTFITS) * HEIGHT))
    for index, number in enumerate(numbers):
        row, column = divmod(index, across)
        for k, outfit in enumerate(OUTFITS):
            place = (column * WIDTH, (len(OUTFITS) * row + k) * HEIGHT)
            sheet.paste(_labelled(pictures[outfit, number], number), place)
    return sheet


def encoded(sheet: Image.Image) -> bytes:
    """The sheet as WebP, in the best quality that is small enough.

    Raises:
        InputError: it takes more than 400 kB in the lowest one.
    """
    for quality in QUALITIES:
        content = io.BytesIO()
        sheet.save(content, format="webp", quality=quality, method=6)
        if len(content.getvalue()) < LARGEST:
            return content.getvalue()
    raise InputError(
        f"a sheet of {sheet.width}x{sheet.height} takes more than {LARGEST // 1000} kB: expected fewer people"
    )


def draw_person(scene: Scene) -> np.ndarray:
    """The scene's person in its first frame, seen from a little beside its front: RGBA uint8 `[h, w, 4]`."""
    body = make_body(scene)
    motion = make_motion(body.skeleton, scene.train, fps=scene.fps, seed=stream(scene, "motion"))
    posed = true_surface(body, motion, scene.outfit, seed=stream(scene, "folds"))[0]
    seed, person = stream(scene, "texture"), subject(scene.subject)
    person = person.loose if scene.outfit.skirt else person
    image = texture.paint(body, size=scene.texture, seed=seed, subject=person)
    camera = make_cameras(scene.rig, np.concatenate([posed, ROOM]))[1]
    studio = Studio(probe(), body.surface, image, scene.light, depth=scene.depth)
    return studio.shoot(posed, [camera], samples=scene.samples, seeds=[0])[0].rgba


def _standing(outfit: str, number: int) -> Scene:
    """The outfit's scene, standing, seen by a camera in front."""
    scene = presets.scene(outfit, size="quick", subject=number)
    rig = Rig(kind="ring", cameras=24, held_out=1, width=WIDTH, height=HEIGHT)
    clip = Clip(generator="stand", frames=2)
    return replace(scene, rig=rig, train=(clip,), test=(clip,), samples=SAMPLES, texture=1024)


def _labelled(rgba: np.ndarray, number: int) -> Image.Image:
    image = Image.fromarray(flatten(rgba))
    ImageDraw.Draw(image).text((6, 4), str(number), fill=(235, 235, 235))
    return image
