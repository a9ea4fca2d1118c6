"""Gaussians that are free in every training frame: each frame learns its own, and new poses get the nearest ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.captures import tiny_plus

from ash.capture.dataset import Capture, Pose
from ash.presets import ash_plus
from ash.protocol import StageClock
from baselines.per_frame import PerFrameAvatar, per_frame


def made(capture: Capture, steps: int = 12) -> PerFrameAvatar:
    config = tiny_plus(steps=steps, warmup_steps=2)
    config = replace(
        config, model=replace(config.model, motion=True), template=replace(config.template, kind="skinned")
    )
    return PerFrameAvatar.from_capture(replace(config, training=replace(config.training, learning_rate=0.02)), capture)


def test_a_frame_draws_its_own_gaussians_and_another_pose_those_of_the_nearest(capture: Capture) -> None:
    avatar = made(capture)
    table = avatar.module.decoders
    for row, frame in enumerate(table.frames):
        frame.data.fill_(float(row))
    frames = capture.splits["train"].frames
    decoded = [table([avatar._inputs_of(frame)])[0].mean().item() for frame in frames]
    assert decoded == [0.0, 1.0, 2.0, 3.0]
    moved = replace(capture.motion, dofs=capture.motion.dofs.copy())
    moved.dofs[2, :3] += 1.0  # Elsewhere in the room it is the same pose,
    moved.dofs[2, 8] += 1e-3  # and nearly the same one a little bent.
    assert table([avatar.module.frame_inputs(Pose(moved, 2))])[0].mean().item() == 2.0


def test_a_step_moves_the_frame_that_was_drawn_and_training_is_resumed(capture: Capture, tmp_path: Path) -> None:
    avatar = made(capture)
    avatar.fit(capture.training_only(), folder=tmp_path / "run")
    assert all(bool(frame.any()) for frame in avatar.module.decoders.frames)
    again = made(capture)
    again.fit(capture.training_only(), folder=tmp_path / "run")
    pose, camera = Pose(capture.motion, 5), capture.cameras["cam0"]
    images = [one.render(pose, camera, clock=StageClock()) for one in (avatar, again)]
    np.testing.assert_array_equal(*images)
    alone = made(capture)
    inputs = [alone._inputs_of(1)]
    alone.module.decoders(inputs).sum().backward()
    grads = [frame.grad is not None for frame in alone.module.decoders.frames]
    assert grads == [False, True, False, False]


def test_it_learns_as_fast_as_static_texels_and_is_else_as_ash_plus() -> None:
    config, plus = per_frame.config("cpu"), ash_plus.config("cpu")
    assert config.training.learning_rate == plus.training.base_learning_rate
    assert replace(config, training=replace(config.training, learning_rate=plus.training.learning_rate)) == plus
