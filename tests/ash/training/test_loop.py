import itertools
import json
import math
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch
from helpers.captures import tube_model_config
from helpers.learning import training_views
from helpers.scoring import foreground_psnr

from ash import presets
from ash.avatar import AshAvatar
from ash.checkpoints import read_safetensors
from ash.config import AshConfig
from ash.files import InputError
from ash.training import loop, stopping
from ash.training.adam import Adam
from ash.training.batches import draw_batch, make_batch
from ash.training.images import load_training_images
from ash.training.loop import Diverged, Interrupted


def config(**changes) -> AshConfig:
    training = replace(presets.plus("ci").training, steps=12, warmup_steps=4, ema=0.0)
    return AshConfig(model=tube_model_config(), training=replace(training, **changes))


def weights(avatar: AshAvatar) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in avatar.module.state_dict().items()}


def test_known_gaussians_are_recovered_from_their_images(capture, tmp_path):
    avatar = AshAvatar.from_capture(config(steps=300, warmup_steps=200, base_learning_rate=5e-2), capture)
    new_views, new_poses = (capture.splits[name].views for name in ("novel_view", "novel_pose"))
    before = foreground_psnr(avatar, capture, new_views)
    avatar.fit(capture, folder=tmp_path)
    assert foreground_psnr(avatar, capture, new_views) > before + 12
    assert foreground_psnr(avatar, capture, new_poses) > before + 12
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert rows[-1]["step"] == 300
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    curve = [row["train_psnr"] for row in rows if "train_psnr" in row]
    assert len(curve) == 9
    assert curve[-1] > before + 8
    outcome = avatar.outcome()
    assert (outcome.steps, outcome.ended_by, outcome.reserved_psnr) == (300, "steps", curve[-1])


def stop_before_end_of(avatar: AshAvatar, step: int) -> None:
    """Send SIGTERM while the given step is drawn."""
    loss_of = avatar.loss

    def losses_then_signal(batches, at):
        if at == step:
            os.kill(os.getpid(), signal.SIGTERM)
        return loss_of(batches, at)

    avatar.loss = losses_then_signal


@pytest.mark.parametrize("frames", [1, 2])
def test_a_run_stopped_at_ten_random_steps_ends_with_the_same_bits(frames, capture, tmp_path):
    settings = config(steps=24, ema=0.9, frames_per_step=frames)
    undisturbed = AshAvatar.from_capture(settings, capture)
    undisturbed.fit(capture, folder=tmp_path / "whole")
    stops = sorted(np.random.default_rng(5).choice(24, 10, replace=False))
    for stop in stops:
        avatar = AshAvatar.from_capture(settings, capture)
        stop_before_end_of(avatar, int(stop))
        with pytest.raises(Interrupted, match=f"stopped at step {stop}|{stop + 1} of 24"):
            avatar.fit(capture, folder=tmp_path / "stopped")
    again = AshAvatar.from_capture(settings, capture)
    again.fit(capture, folder=tmp_path / "stopped")
    for name, value in weights(undisturbed).items():
        assert torch.equal(weights(again)[name], value), name
    once_more = AshAvatar.from_capture(settings, capture)
    once_more.fit(capture, folder=tmp_path / "stopped")
    assert torch.equal(weights(once_more)["base_texels"], weights(undisturbed)["base_texels"])


def test_a_run_stopped_before_and_in_its_decay_decides_nothing_anew(capture, tmp_path, monkeypatch):
    """Its end is found by scores: a run that is stopped at any step finds the same end, and ends with the same bits."""
    for name, value in (("FIRST_MARK", 8), ("LULL_STEPS", 0), ("LEAST_STEPS", 0), ("GAIN_DB", 99.0)):
        monkeypatch.setattr(stopping, name, value)
    settings = config(steps=200, warmup="none", warmup_steps=0)
    undisturbed = AshAvatar.from_capture(settings, capture)
    undisturbed.fit(capture, folder=tmp_path / "whole")
    assert (undisturbed.outcome().ended_by, undisturbed.outcome().steps) == ("plateau", 19)
    for stop in (3, 9, 11, 13):
        avatar = AshAvatar.from_capture(settings, capture)
        stop_before_end_of(avatar, stop)
        with pytest.raises(Interrupted):
            avatar.fit(capture, folder=tmp_path / "stopped")
    again = AshAvatar.from_capture(settings, capture)
    again.fit(capture, folder=tmp_path / "stopped")
    for name, value in weights(undisturbed).items():
        assert torch.equal(weights(again)[name], value), name
    assert replace(again.outcome(), seconds=0.0) == replace(undisturbed.outcome(), seconds=0.0)


def test_a_limit_in_seconds_is_met(capture, tmp_path, monkeypatch):
    """By a clock on which every question takes a hundredth of a second; nothing here is a plateau."""
    ticks = itertools.count()
    monkeypatch.setattr(loop.time, "process_time", lambda: next(ticks) / 100)
    monkeypatch.setattr(stopping, "GAIN_DB", -math.inf)
    avatar = AshAvatar.from_capture(config(steps=100_000, seconds=2.0), capture)
    avatar.fit(capture, folder=tmp_path)
    assert avatar.outcome().ended_by == "seconds"
    assert avatar.outcome().seconds == pytest.approx(2, abs=0.1)


def test_snapshots_are_what_would_be_used(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "SNAPSHOT_SECONDS", (0, 10_000))
    avatar = AshAvatar.from_capture(config(snapshots=True, ema=0.5, steps=1, warmup_steps=0), capture)
    avatar.fit(capture, folder=tmp_path)
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["000000.safetensors"]
    other = AshAvatar.from_capture(config(), capture)
    other.load(tmp_path / "snapshots" / "000000.safetensors")
    for name, value in weights(avatar).items():
        assert torch.equal(weights(other)[name], value), name


@pytest.mark.parametrize(("rate", "dead"), [(2e-3, False), (0.0, True)])
def test_decoders_that_carry_nothing_are_found(capture, tmp_path, rate, dead):
    """A head that never leaves zero adds the same in every frame; one that learns does not."""
    avatar = AshAvatar.from_capture(config(learning_rate=rate, steps=24), capture)
    avatar.fit(capture, folder=tmp_path)
    assert avatar.outcome().carries_nothing == dead
    assert (avatar.outcome().correction_spread == 0) == dead


def test_without_decoders_there_is_nothing_to_carry(capture, tmp_path):
    settings = config(warmup="none", warmup_steps=0)
    avatar = AshAvatar.from_capture(replace(settings, model=replace(settings.model, motion=False)), capture)
    avatar.fit(capture, folder=tmp_path)
    assert avatar.outcome().correction_spread is None
    assert not avatar.outcome().carries_nothing


def test_the_average_of_the_weights_is_the_result_and_nothing_else_changes(capture, tmp_path):
    last, averaged = AshAvatar.from_capture(config(), capture), AshAvatar.from_capture(config(ema=0.5), capture)
    passed = []
    loss_of = last.loss

    def note_weights(*arguments):
        passed.append(last.module.base_texels.detach().clone())
        return loss_of(*arguments)

    last.loss = note_weights
    last.fit(capture, folder=tmp_path / "last")
    averaged.fit(capture, folder=tmp_path / "averaged")
    expected = passed[0]
    for step, base in enumerate([*passed[1:12], last.module.base_texels.detach()]):
        decay = min(0.5, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * base
    torch.testing.assert_close(averaged.module.base_texels.detach(), expected, atol=1e-5, rtol=1e-5)
    assert not torch.equal(averaged.module.base_texels, last.module.base_texels)


def test_reserved_views_are_never_trained_on(capture):
    images = load_training_images(capture.training_only())
    assert len(images.reserved) == 2
    for step in range(64):
        batch = draw_batch(images, replace(config().training, views_per_step=4), 0, step)
        seen = {(camera.name, batch.frame) for camera in batch.cameras}
        assert not seen & set(images.reserved)
        assert len(seen) == 4 - sum(frame == batch.frame for _, frame in images.reserved)


def test_equal_seeds_give_equal_bits_and_other_seeds_do_not(capture, tmp_path):
    results = []
    for run, seed in enumerate((0, 0, 1)):
        avatar = AshAvatar.from_capture(replace(config(), seed=seed), capture)
        avatar.fit(capture, folder=tmp_path / str(run))
        results.append(weights(avatar)["base_texels"])
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_nan_rolls_back_once_and_then_ends_the_run(capture, tmp_path):
    avatar = AshAvatar.from_capture(config(), capture)
    loss_of, spoiled = avatar.loss, []

    def spoil(batches, step):
        spoiled.append(step == 6)
        factor = float("nan") if step == 6 and sum(spoiled) <= times else 1.0
        return factor * loss_of(batches, step)

    avatar.loss = spoil
    times = 1
    avatar.fit(capture, folder=tmp_path / "once")
    assert all(torch.isfinite(value).all() for value in weights(avatar).values())
    times = 99
    spoiled.clear()
    with pytest.raises(Diverged, match="step 6"):
        avatar.fit(capture, folder=tmp_path / "always")


def poison(avatar: AshAvatar, *, at: set[int], times: int) -> None:
    """Spoil a weight before the given steps are decoded, `times` times in all."""
    loss_of, left = avatar.loss, [times]

    def poisoned(batches, step):
        if step in at and left[0] > 0:
            left[0] -= 1
            with torch.no_grad():
                avatar.module.base_texels[0, 3] = float("nan")
        return loss_of(batches, step)

    avatar.loss = poisoned


def test_a_weight_that_is_nan_rolls_back_once_and_then_ends_the_run_as_diverged(capture, tmp_path):
    """The splatter refuses such Gaussians as wrong input; the run must not end as that."""
    avatar = AshAvatar.from_capture(config(), capture)
    poison(avatar, at={7}, times=1)
    avatar.fit(capture, folder=tmp_path / "once")
    assert all(torch.isfinite(value).all() for value in weights(avatar).values())
    avatar = AshAvatar.from_capture(config(), capture)
    poison(avatar, at={7}, times=2)
    with pytest.raises(Diverged, match=r"Gaussians that cannot be drawn \(scales.*at step 7, again"):
        avatar.fit(capture, folder=tmp_path / "always")


@pytest.mark.parametrize("spoiled", [{12}, {12, 24}])
def test_weights_that_the_last_step_spoiled_are_never_the_result(capture, tmp_path, monkeypatch, spoiled):
    avatar, made, step = AshAvatar.from_capture(config(), capture), [0], Adam.step

    def spoil(optimiser, *arguments):
        finite = step(optimiser, *arguments)
        made[0] += 1
        if made[0] in spoiled:
            with torch.no_grad():
                avatar.module.base_texels[0, 3] = float("nan")
        return finite

    monkeypatch.setattr(Adam, "step", spoil)
    if len(spoiled) == 2:
        with pytest.raises(Diverged, match="weights not finite at step 12, again"):
            avatar.fit(capture, folder=tmp_path)
    else:
        avatar.fit(capture, folder=tmp_path)
        assert made[0] == 24
        assert all(torch.isfinite(value).all() for value in weights(avatar).values())


def test_a_damaged_checkpoint_is_named(capture, tmp_path):
    avatar = AshAvatar.from_capture(config(), capture)
    avatar.save(tmp_path / "weights.safetensors")
    content = (tmp_path / "weights.safetensors").read_bytes()
    (tmp_path / "weights.safetensors").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"weights\.safetensors: expected a safetensors checkpoint"):
        avatar.load(tmp_path / "weights.safetensors")


def test_a_checkpoint_is_taken_up_whole_or_named(capture, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    avatar = AshAvatar.from_capture(config(), capture)
    avatar.fit(capture, folder=tmp_path)
    whole = path.read_bytes()
    tensors, facts = read_safetensors(path)
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}  # The file's own memory is written over below.
    moments = next(name for name in tensors if name.endswith("exp_avg"))
    damaged = {
        "KeyError": ({n: t for n, t in tensors.items() if n != moments}, facts),
        "RuntimeError": (tensors | {moments: torch.zeros(3, 5, 7)}, facts),
        "NaN or infinity": (tensors | {moments: torch.full_like(tensors[moments], float("nan"))}, facts),
        "KeyError: 'step'": (tensors, {n: f for n, f in facts.items() if n != "step"}),
        "invalid literal": (tensors, facts | {"step": "many"}),
        "of the rate": (tensors, facts | {"seconds": "nan"}),
        "scores": (tensors, facts | {"course": '{"scores": [{"step": "x", "psnr": 1.0}]}'}),
    }
    for reason, (spoiled, told) in damaged.items():
        path.write_bytes(safetensors.torch.save(spoiled, metadata=told))
        with pytest.raises(InputError, match=rf"checkpoint\.safetensors: .*{reason}") as raised:
            AshAvatar.from_capture(config(), capture).fit(capture, folder=tmp_path)
        assert str(raised.value).isprintable()
    path.write_bytes(whole)
    again = AshAvatar.from_capture(config(), capture)
    again.fit(capture, folder=tmp_path)
    assert all(torch.equal(a, b) for a, b in zip(weights(avatar).values(), weights(again).values(), strict=True))


def test_a_crop_draws_what_the_full_image_shows_there(capture):
    images = load_training_images(capture.training_only())
    batch = make_batch(images, 1, ["cam1", "cam2"], torch.tensor([0.2, 0.4, 0.6]))
    avatar = AshAvatar.from_capture(config(), capture)
    background = torch.tensor([0.2, 0.4, 0.6])
    cropped = training_views(avatar, 1, batch.cameras, background, 0)
    for view, (name, camera) in enumerate(zip(["cam1", "cam2"], batch.cameras, strict=True)):
        full = training_views(avatar, 1, [capture.cameras[name]], background, 0)[0]
        left, top = (capture.cameras[name].K[:2, 2] - camera.K[:2, 2]).astype(int)
        window = full[top : top + camera.height, left : left + camera.width]
        torch.testing.assert_close(cropped[view], window, atol=2e-5, rtol=0)
