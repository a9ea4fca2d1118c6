"""What a step is shown: a background for every pixel where the empty studio is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers.captures import tiny_preset
from helpers.learning import training_views

from ash import presets
from ash.files import InputError
from ash.training.batches import draw_batch, over
from ash.training.images import load_training_images
from ash.training.losses import view_loss
from benchmarks.cell.registry import find_method


def test_where_a_mask_is_too_large_the_studio_explains_what_it_shows(capture):
    images = load_training_images(capture)
    name, _ = capture.splits["train"].views[0]
    size = capture.cameras[name].height, capture.cameras[name].width
    plate = np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8)
    training = replace(presets.plus("ci").training, background="studio", views_per_step=1)
    with pytest.raises(InputError, match="pictures of the empty studio"):
        draw_batch(images, training, 0, 0)
    images = replace(images, backgrounds=dict.fromkeys(images.cameras, plate))
    plain = draw_batch(images, replace(training, background="random"), 0, 0)
    batch = draw_batch(images, training, 0, 0)
    mask, camera = plain.foreground, plain.cameras[0]
    assert batch.background.shape == batch.targets.shape
    outside, within = (mask == 0)[..., None].expand_as(batch.targets), (mask == 1)[..., None].expand_as(batch.targets)
    torch.testing.assert_close(batch.targets[within], plain.targets[within])
    assert torch.equal(batch.background[outside], plain.background.expand_as(batch.targets)[outside])
    whole = images.cameras[camera.name]
    left, top = np.round(whole.K[:2, 2] - camera.K[:2, 2]).astype(int)
    window = torch.from_numpy(plate[top : top + camera.height, left : left + camera.width]).float()[None] / 255
    torch.testing.assert_close(batch.background[within], window[within])
    # What nobody covers looks as the image does: no loss, wherever the mask ends.
    nothing = over(torch.zeros_like(batch.targets), torch.zeros_like(mask), batch.background)
    grown = replace(batch, targets=nothing)
    assert float(view_loss([nothing], [grown], training)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("method", ["ash", "ddc", "oracle_texture"])
def test_a_background_for_every_pixel_is_drawn_behind_everybody(method, capture, monkeypatch):
    monkeypatch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=4, warmup_steps=2))
    avatar = find_method(method).load()(capture, seed=0, preset="ci")
    camera = [capture.cameras["cam1"]]
    colour = torch.tensor([0.2, 0.5, 0.9])
    flat = training_views(avatar, 0, camera, colour, 3)
    behind = colour.expand(1, camera[0].height, camera[0].width, 3)
    torch.testing.assert_close(training_views(avatar, 0, camera, behind, 3), flat, atol=2e-3, rtol=0)
