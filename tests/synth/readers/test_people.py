"""The sheet of the cast: who stands where, and how large the file is."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ash.files import InputError
from synth import presets
from synth.readers.people import HEIGHT, LARGEST, OUTFITS, WIDTH, draw_person, encoded, laid_out
from synth.scene import Clip, Rig


def _person(number: int, outfit: str) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 4), (10 * number, 200 * OUTFITS.index(outfit), 0, 255), dtype=np.uint8)


def test_eight_subjects_stand_in_a_row_and_their_loose_outfits_below():
    sheet = laid_out({(outfit, number): _person(number, outfit) for outfit in OUTFITS for number in range(10)})
    assert sheet.size == (8 * WIDTH, 4 * HEIGHT)
    middle = np.asarray(sheet)[HEIGHT // 2 :: HEIGHT, WIDTH // 2 :: WIDTH]
    np.testing.assert_array_equal(middle[0, :, 0], 10 * np.arange(8))
    np.testing.assert_array_equal(middle[:, 1, 0], [10, 10, 90, 90])
    np.testing.assert_array_equal(middle[:, 1, 1], [0, 200, 0, 200])
    assert not middle[2:, 2:].any()


def test_a_sheet_is_small_enough_to_be_published():
    rng = np.random.default_rng(0)
    noise = Image.fromarray(rng.integers(0, 255, (600, 600, 3), dtype=np.uint8))
    content = encoded(noise)
    assert len(content) < LARGEST and Image.open(io.BytesIO(content)).size == (600, 600)
    with pytest.raises(InputError, match="more than 400 kB"):
        encoded(Image.fromarray(rng.integers(0, 255, (1600, 1600, 3), dtype=np.uint8)))


def test_a_person_is_drawn_whole_and_as_its_subject():
    scene = replace(
        presets.scene("mannequin", size="ci", subject=2),
        rig=Rig(kind="ring", cameras=4, held_out=1, width=64, height=96),
        train=(Clip(generator="stand", frames=2),),
        samples=4,
        texture=128,
    )
    one, other = draw_person(scene), draw_person(replace(scene, subject=3))
    covered = one[..., 3] > 0
    assert 0.05 < covered.mean() < 0.5 and not covered[[0, -1]].any() and not covered[:, [0, -1]].any()
    assert (np.abs(one[covered].astype(int) - other[covered]).max(axis=1) > 20).mean() > 0.5
