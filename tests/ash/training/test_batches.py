"""What a step is shown: several frames, whose gradient is the mean of theirs, and a background for every pixel."""

from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers.captures import tiny_plus, tiny_preset
from helpers.learning import training_views
from helpers.numerics import relative_error

from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.config import AshConfig, TemplateConfig
from ash.decoders import UNet
from ash.files import InputError
from ash.presets import named
from ash.training.batches import Batch, draw_batch, draw_step, over
from ash.training.images import ReadAhead, load_training_images
from ash.training.losses import view_loss
from baselines.ddc import DdcAvatar, DdcConfig, ddc_config
from benchmarks.cell.registry import find_method

FRAMES, STEP = 3, 4  # a step of so many frames, after the warm-up


def of_frames(count: int = FRAMES, *, noise: float = 0.0, **model: Any) -> AshConfig:
    changes = {"training.frames_per_step": count, "training.texture_noise": noise}
    return tiny_plus(changes | {f"model.{name}": value for name, value in model.items()}, steps=8, warmup_steps=2)


def mesh_of_frames(refine: str = "static", **changes: Any) -> DdcConfig:
    mesh = ddc_config(of_frames(**changes), seed=0, template=TemplateConfig())
    return replace(mesh, texture=32, vertices_every=1, refine=refine)


def test_steps_of_several_frames_show_what_as_many_steps_of_one_frame_do(capture: Capture) -> None:
    images, training = load_training_images(capture), of_frames().training
    assert len(images.frames) % FRAMES  # Epochs end within steps.
    epochs = len(images.frames)
    with closing(ReadAhead(images.views, readers=2)) as ahead:
        shown = [batch for step in range(epochs) for batch in draw_step(ahead, images, training, 7, step)]
    alone = [draw_batch(images, training, 7, step) for step in range(FRAMES * epochs)]
    for batch, one in zip(shown, alone, strict=True):
        assert (batch.frame, [c.name for c in batch.cameras]) == (one.frame, [c.name for c in one.cameras])
        assert torch.equal(batch.targets, one.targets) and torch.equal(batch.background, one.background)
    for epoch in range(FRAMES):
        seen = [batch.frame for batch in shown[epoch * epochs : (epoch + 1) * epochs]]
        assert sorted(seen) == sorted(images.frames)


def gradients(avatar: AshAvatar | DdcAvatar, batches: list[Batch], step: int) -> dict[str, torch.Tensor]:
    """Of the loss of a step's views."""
    avatar.module.zero_grad()
    avatar.loss(batches, step).backward()
    return {n: p.grad.clone() for n, p in avatar.module.named_parameters() if p.grad is not None}


LEARNERS = {
    "shared trunk": of_frames(shared_trunk=True),
    "two networks": of_frames(shared_trunk=False, global_features=True),
    "noise": of_frames(noise=0.5, window=3),
    "instance": of_frames(norm="instance"),
    "refining": of_frames(refine=True),
    "motionless": of_frames(motion=False),
    "mesh": mesh_of_frames(noise=0.5, global_features=True),
    "moving mesh": mesh_of_frames("motion"),
}


@pytest.mark.parametrize("natively", [True, False])
@pytest.mark.parametrize("learner", LEARNERS)
def test_the_gradient_of_a_step_is_the_mean_of_its_frames(
    learner: str, natively: bool, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not natively:  # As on a GPU: the frames are one batch of the U-Nets.
        monkeypatch.setattr(UNet, "_can_use_native", lambda net, texture: False)
    config = LEARNERS[learner]
    avatar = (AshAvatar if isinstance(config, AshConfig) else DdcAvatar).from_capture(config, capture)
    for net in avatar.module.modules():
        if isinstance(net, UNet):
            torch.nn.init.normal_(net.head.weight, std=0.1, generator=torch.manual_seed(1))
    images, first = load_training_images(capture), STEP * FRAMES
    batches = [draw_batch(images, avatar.config.training, 0, first + index) for index in range(FRAMES)]
    together = gradients(avatar, batches, STEP)
    alone = [gradients(avatar, [batch], first + index) for index, batch in enumerate(batches)]
    assert together.keys() == alone[0].keys() and any(gradient.any() for gradient in together.values())
    for name, found in together.items():
        expected = torch.stack([one[name] for one in alone]).mean(0)
        assert relative_error(found, expected) < 1e-4, name


def test_what_would_mix_frames_is_refused() -> None:
    with pytest.raises(InputError, match="norm 'batch-as-released' mixes what is decoded together; expected 1"):
        of_frames(norm="batch-as-released")
    official = named("official")
    together = replace(official.training, frames_per_step=2)
    with pytest.raises(InputError, match="mixes what is decoded together"):
        replace(ddc_config(official, seed=0, template=TemplateConfig()), training=together)
    with pytest.raises(InputError, match="frames_per_step: expected at least 1, got 0"):
        of_frames(0)


# --- a background for every pixel where the empty studio is known -----------------------------------------------------


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
