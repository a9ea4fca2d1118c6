"""A step that shows several frames: what it shows, and that its gradient is the mean of those of its frames."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.captures import tiny_plus
from helpers.numerics import relative_error

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.config import AshConfig, TemplateConfig
from ash.decoders import UNet
from ash.files import InputError
from ash.presets import named
from ash.training.batches import Batch, draw_batch, draw_step
from ash.training.images import ReadAhead, load_training_images
from baselines.ddc import DdcAvatar, ddc_config

FRAMES, STEP = 3, 4  # a step of so many frames, after the warm-up


def of_frames(count: int = FRAMES, *, noise: float = 0.0, **model: Any) -> AshConfig:
    tiny = tiny_plus(steps=8, warmup_steps=2)
    training = replace(tiny.training, frames_per_step=count, texture_noise=noise)
    skinned = TemplateConfig(kind="skinned")
    return replace(tiny, model=replace(tiny.model, **model), training=training, template=skinned)


def mesh_of_frames(**changes: Any) -> Any:
    mesh = ddc_config(of_frames(**changes), seed=0, template=TemplateConfig(kind="skinned"))
    return replace(mesh, texture=32, vertices_every=1)


def test_steps_of_several_frames_show_what_as_many_steps_of_one_frame_do(capture: Capture) -> None:
    images, training = load_training_images(capture), of_frames().training
    assert len(images.frames) % FRAMES  # Epochs end within steps.
    ahead, epochs = ReadAhead(images.views, readers=2), len(images.frames)
    try:
        shown = [batch for step in range(epochs) for batch in draw_step(ahead, images, training, 7, step)]
    finally:
        ahead.close()
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
    "shared trunk": lambda capture: AshAvatar.from_capture(of_frames(shared_trunk=True), capture),
    "two networks": lambda capture: AshAvatar.from_capture(
        of_frames(shared_trunk=False, global_features=True), capture
    ),
    "noise": lambda capture: AshAvatar.from_capture(of_frames(noise=0.5, window=3), capture),
    "instance": lambda capture: AshAvatar.from_capture(of_frames(norm="instance"), capture),
    "refining": lambda capture: AshAvatar.from_capture(of_frames(refine=True), capture),
    "motionless": lambda capture: AshAvatar.from_capture(of_frames(motion=False), capture),
    "mesh": lambda capture: DdcAvatar.from_capture(mesh_of_frames(noise=0.5, global_features=True), capture),
    "moving mesh": lambda capture: DdcAvatar.from_capture(replace(mesh_of_frames(), refine="motion"), capture),
}


@pytest.mark.parametrize("natively", [True, False])
@pytest.mark.parametrize("learner", LEARNERS)
def test_the_gradient_of_a_step_is_the_mean_of_its_frames(
    learner: str, natively: bool, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not natively:  # As on a GPU: the frames are one batch of the U-Nets.
        monkeypatch.setattr(UNet, "_can_use_native", lambda net, texture: False)
    avatar = LEARNERS[learner](capture)
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
