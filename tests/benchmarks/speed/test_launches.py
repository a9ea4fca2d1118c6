"""What a step of the presets asks a GPU to launch, counted on `meta`, where torch takes the way that CUDA takes."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.captures import write_tube_capture
from helpers.devices import META, without_numbers

import ash.training.adam
from ash.avatar import AshAvatar
from ash.config import TemplateConfig
from ash.presets import named
from ash.training.adam import Adam
from ash.training.batches import draw_batch
from ash.training.images import load_training_images
from ash.warp.arrays import launch
from benchmarks.speed.launches import launches, launches_of_step, launching_ms


def test_what_computes_is_counted_forwards_and_backwards() -> None:
    a = torch.ones(3, 4, device=META, requires_grad=True)
    with launches() as count:
        (a.T.reshape(-1)[2:].view(2, 5) * 3.0).sum().backward()
    assert count.of["aten::mul"] == 2 and count.of["aten::sum"] == 1
    assert not {"aten::view", "aten::t", "aten::slice", "aten::expand", "aten::empty"} & count.of.keys()
    with launches() as nothing:
        a.detach().T.reshape(4, 3)
        torch.empty(3, device=META)
    assert nothing.of.keys() <= {"aten::clone"}  # Of the transposed tensor.


def test_warps_launches_are_counted_beside_torchs() -> None:
    import warp as wp

    from ash.warp.projecting import project  # Any kernel of ours: it is asked for no thread, or is not run.

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(wp, "launch", lambda *_, **__: None)
        with launches() as count:
            launch(project, 5, [], torch.device("cpu"))
            launch(project, 0, [], torch.device("cpu"))
    assert count.of == {"warp::launch": 1}


# Counted: 517, 431 and 592. What the splatter launches, about 30 for both passes, comes on top.
MOST = {"cpu": 560, "paper": 640}


@pytest.fixture
def counted_on_meta(tmp_path_factory, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """How many kernels a step of a preset launches, with so many frames in it."""
    looks = ash.training.adam._all_finite
    without_numbers(monkeypatch)
    monkeypatch.setattr(ash.training.adam, "_all_finite", looks)
    monkeypatch.setattr(torch.Tensor, "__bool__", _yes_on_meta(torch.Tensor.__bool__))
    tube = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")

    def count(preset: str, *, frames: int = 1) -> int:
        config = replace(named(preset), template=TemplateConfig(kind="skinned"))
        avatar, images = AshAvatar(config, tube), load_training_images(tube, META)
        batches = [draw_batch(images, config.training, 0, index) for index in range(frames)]
        optimiser = Adam(avatar.parameter_groups(), eps=1e-15)
        return launches_of_step(avatar, batches, config.training, optimiser)

    return count


@pytest.mark.parametrize("preset", MOST)
def test_a_step_launches_no_more_than_it_did(preset: str, counted_on_meta: Callable[..., int]) -> None:
    """ADR 006 says what follows for a GPU."""
    count = counted_on_meta(preset)
    assert MOST[preset] / 1.2 < count <= MOST[preset]
    assert launching_ms(count) == pytest.approx(count * 5e-3)


def test_frames_in_one_step_share_the_launches_of_decoders_and_adam(counted_on_meta: Callable[..., int]) -> None:
    """Counted of `cpu`: 517 a frame, and 431 where four share a step (1,723)."""
    assert 0.75 < counted_on_meta("cpu", frames=4) / (4 * counted_on_meta("cpu")) < 0.87


def _yes_on_meta(look):
    return lambda tensor: True if tensor.device == META else look(tensor)
