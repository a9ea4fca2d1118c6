"""Draw the first people of the cast, standing: .venv/bin/python docs/cast_sheet.py OUT.webp PEOPLE

Eight people in a row, in tight clothes and below in loose ones, each cropped to fill the tile. A person takes about 20
seconds.
"""

import sys
from dataclasses import replace

from PIL import Image, ImageDraw
from scene_sheet import GREY, TILE, pictures, tile

from synth import presets
from synth.scene import Scene
from synth.views import splits

IN_A_ROW, OUTFITS = 8, ("tight", "loose")


def standing(outfit: str, subject: int) -> Scene:
    """A person of an outfit who stands still."""
    still = presets.scene("still", size="ci")
    return replace(presets.scene(outfit, size="ci", subject=subject), train=still.train, test=still.test)


def picture(outfit: str, subject: int) -> Image.Image:
    """The person from the first camera, with the number."""
    scene = standing(outfit, subject)
    (image,) = pictures(scene, [next(iter(splits(scene)["train"].views))])
    person = tile(image)
    ImageDraw.Draw(person).text((6, 6), str(subject))
    return person


if __name__ == "__main__":
    out, people = sys.argv[1], int(sys.argv[2])
    starts = range(0, people, IN_A_ROW)
    rows = [(outfit, range(start, min(start + IN_A_ROW, people))) for start in starts for outfit in OUTFITS]
    sheet = Image.new("RGB", (min(people, IN_A_ROW) * TILE[0], len(rows) * TILE[1]), GREY)
    for index, (outfit, row) in enumerate(rows):
        for column, subject in enumerate(row):
            print(f"{outfit}, person {subject}", flush=True)
            sheet.paste(picture(outfit, subject), (column * TILE[0], index * TILE[1]))
    sheet.save(out, quality=80)
