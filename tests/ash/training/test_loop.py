import itertools
import json
import math
import os
import signal
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from helpers.captures import tube_model_config
from helpers.scoring import foreground_psnr

from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.checkpoints import read_safetensors
from ash.config import AshConfig
from ash.files import InputError
from ash.training import loop, stopping
from ash.training.adam import Adam
from ash.training.batches import draw_batch
from ash.training.images import load_training_images
from ash.training.loop import Diverged, Interrupted


def config(**changes) -> AshConfig:
    training = replace(presets.plus("ci").training, steps=12, warmup_steps=4, ema=0.0)
    return AshConfig(model=tube_model_config(), training=replace(training, **changes))


def weights(avatar: AshAvatar) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in avatar.module.state_dict().items()}


def assert_same_weights(one: AshAvatar, other: AshAvatar) -> None:
    for name, value in weights(one).items():
        assert torch.equal(weights(other)[name], value), name


def trained(settings: AshConfig, capture: Capture, folder: Path, *, stops: tuple[int, ...] = ()) -> AshAvatar:
    """An avatar whose training got SIGTERM while each of these steps was drawn, and was taken up again each time."""
    for stop in (*stops, None):
        avatar = AshAvatar.from_capture(settings, capture)
        if stop is None:
            break
        loss_of = avatar.loss

        def losses_then_signal(batches, at, loss_of=loss_of, stop=stop):
            if at == stop:
                os.kill(os.getpid(), signal.SIGTERM)
            return loss_of(batches, at)

        avatar.loss = losses_then_signal
        with pytest.raises(Interrupted, match=f"stopped at step {stop + 1} of {settings.training.steps}"):
            avatar.fit(capture, folder=folder)
    avatar.fit(capture, folder=folder)
    return avatar


def test_known_gaussians_are_recovered_from_their_images(capture, tmp_path):
    avatar = AshAvatar.from_capture(config(steps=200, warmup_steps=150, base_learning_rate=5e-2), capture)
    new_views, new_poses = (capture.splits[name].views for name in ("novel_view", "novel_pose"))
    before = foreground_psnr(avatar, capture, new_views)
    avatar.fit(capture, folder=tmp_path)
    assert foreground_psnr(avatar, capture, new_views) > before + 12
    assert foreground_psnr(avatar, capture, new_poses) > before + 12
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert rows[-1]["step"] == 200
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    curve = [row["train_psnr"] for row in rows if "train_psnr" in row]
    assert len(curve) == 7
    assert curve[-1] > before + 8
    outcome = avatar.outcome()
    assert (outcome.steps, outcome.ended_by, outcome.reserved_psnr) == (200, "steps", curve[-1])


@pytest.mark.parametrize("frames", [1, 2])
def test_a_run_stopped_at_any_step_ends_with_the_same_bits(frames, capture, tmp_path):
    """In its warm-up, in steps that follow each other and in its last one; and what has ended stays as it is."""
    settings = config(ema=0.9, frames_per_step=frames)
    undisturbed = trained(settings, capture, tmp_path / "whole")
    for stops in ((1, 5, 6, 11), ()):
        assert_same_weights(trained(settings, capture, tmp_path / "stopped", stops=stops), undisturbed)


def test_a_run_stopped_before_and_in_its_decay_decides_nothing_anew(capture, tmp_path, monkeypatch):
    """Its end is found by scores: a run that is stopped at any step finds the same end, and ends with the same bits."""
    for name, value in (("FIRST_MARK", 8), ("LULL_STEPS", 0), ("LEAST_STEPS", 0), ("GAIN_DB", 99.0)):
        monkeypatch.setattr(stopping, name, value)
    settings = config(steps=200, warmup="none", warmup_steps=0)
    undisturbed = trained(settings, capture, tmp_path / "whole")
    assert (undisturbed.outcome().ended_by, undisturbed.outcome().steps) == ("plateau", 19)
    again = trained(settings, capture, tmp_path / "stopped", stops=(3, 9, 11, 13))
    assert_same_weights(again, undisturbed)
    assert replace(again.outcome(), seconds=0.0) == replace(undisturbed.outcome(), seconds=0.0)


def test_views_that_are_dear_to_draw_are_scored_late_and_at_the_end(capture, tmp_path):
    trained(config(steps=100, warmup="none", warmup_steps=0, score_from=80), capture, tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "train_psnr" in row] == [96, 100]


def test_a_limit_in_seconds_is_met(capture, tmp_path, monkeypatch):
    """By a clock on which every question takes a twentieth of a second; nothing here is a plateau."""
    ticks = itertools.count()
    monkeypatch.setattr(loop.time, "process_time", lambda: next(ticks) / 20)
    monkeypatch.setattr(stopping, "GAIN_DB", -math.inf)
    avatar = trained(config(steps=100_000, seconds=2.0), capture, tmp_path)
    assert avatar.outcome().ended_by == "seconds"
    assert avatar.outcome().seconds == pytest.approx(2, abs=0.15)


def test_snapshots_are_what_would_be_used(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "SNAPSHOT_SECONDS", (0, 10_000))
    avatar = trained(config(snapshots=True, ema=0.5, steps=1, warmup_steps=0), capture, tmp_path)
    assert [path.name for path in (tmp_path / "snapshots").iterdir()] == ["000000.safetensors"]
    other = AshAvatar.from_capture(config(), capture)
    other.load(tmp_path / "snapshots" / "000000.safetensors")
    assert_same_weights(other, avatar)


@pytest.mark.parametrize(("rate", "dead"), [(2e-3, False), (0.0, True)])
def test_decoders_that_carry_nothing_are_found(capture, tmp_path, rate, dead):
    """A head that never leaves zero adds the same in every frame; one that learns does not."""
    outcome = trained(config(learning_rate=rate, steps=24), capture, tmp_path).outcome()
    assert outcome.carries_nothing == (outcome.correction_spread == 0) == dead


def test_without_decoders_there_is_nothing_to_carry(capture, tmp_path):
    settings = replace(config(warmup="none", warmup_steps=0), model=tube_model_config(motion=False))
    outcome = trained(settings, capture, tmp_path).outcome()
    assert outcome.correction_spread is None and not outcome.carries_nothing


def test_the_average_of_the_weights_is_the_result_and_nothing_else_changes(capture, tmp_path):
    last, passed = AshAvatar.from_capture(config(), capture), []
    loss_of = last.loss

    def note_weights(*arguments):
        passed.append(last.module.base_texels.detach().clone())
        return loss_of(*arguments)

    last.loss = note_weights
    last.fit(capture, folder=tmp_path / "last")
    averaged = trained(config(ema=0.5), capture, tmp_path / "averaged")
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


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("loss", "at step 6, again"),
        ("weight", r"Gaussians that cannot be drawn \(scales.*at step 7, again"),  # Not as wrong input.
        ("last step", "weights not finite at step 12, again"),
    ],
)
@pytest.mark.parametrize("times", [1, 2])
def test_what_is_not_finite_rolls_back_once_and_then_ends_the_run_as_diverged(
    where, message, times, capture, tmp_path, monkeypatch
):
    """A loss, a weight before it is decoded, and a weight after the last step, which is never the result."""
    avatar = AshAvatar.from_capture(config(), capture)
    loss_of, step_of, left, reached = avatar.loss, Adam.step, times, 0

    def spoil(here: str, at: int) -> bool:
        nonlocal left
        spoiled = (where, reached) == (here, at) and left > 0
        left -= spoiled
        if spoiled and here != "loss":
            with torch.no_grad():
                avatar.module.base_texels[0, 3] = float("nan")
        return spoiled

    def loss(batches, step):
        nonlocal reached
        reached = step
        spoil("weight", 7)
        return loss_of(batches, step) * (float("nan") if spoil("loss", 6) else 1.0)

    def step(optimiser, *arguments):
        finite = step_of(optimiser, *arguments)
        spoil("last step", 11)
        return finite

    avatar.loss = loss
    monkeypatch.setattr(Adam, "step", step)
    with pytest.raises(Diverged, match=message) if times == 2 else nullcontext():
        avatar.fit(capture, folder=tmp_path)
    assert left == 0
    assert times == 2 or all(torch.isfinite(value).all() for value in weights(avatar).values())


def test_a_damaged_checkpoint_is_named(capture, tmp_path):
    avatar = AshAvatar.from_capture(config(), capture)
    avatar.save(tmp_path / "weights.safetensors")
    content = (tmp_path / "weights.safetensors").read_bytes()
    (tmp_path / "weights.safetensors").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"weights\.safetensors: expected a safetensors checkpoint"):
        avatar.load(tmp_path / "weights.safetensors")


def test_a_checkpoint_is_taken_up_whole_or_named(capture, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    avatar = trained(config(), capture, tmp_path)
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
            trained(config(), capture, tmp_path)
        assert str(raised.value).isprintable()
    path.write_bytes(whole)
    assert_same_weights(trained(config(), capture, tmp_path), avatar)
