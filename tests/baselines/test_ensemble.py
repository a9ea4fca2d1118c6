"""The control for blending: the mean picture of two avatars."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import tiny_preset, write_tube_capture

from ash import presets
from ash.capture.dataset import Pose
from ash.protocol import Avatar, StageClock
from baselines.ensemble import wo_mot_plus_twice, wo_mot_twice


@pytest.mark.parametrize("method", [wo_mot_twice, wo_mot_plus_twice])
def test_it_draws_the_mean_of_two_seeds_also_after_loading(method, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=8, warmup_steps=10))
    capture = write_tube_capture(tmp_path / "capture")
    made = method(capture.training_only(), seed=3, preset="ci")
    assert isinstance(made, Avatar)
    made.fit(capture.training_only(), folder=tmp_path / "fit")
    camera, pose, clock = capture.cameras["cam0"], Pose(capture.motion, 3), StageClock()
    one, other = (avatar.render(pose, camera, clock=clock) for avatar in made.avatars)
    image = made.render(pose, camera, clock=clock)
    assert not np.array_equal(one, other)
    np.testing.assert_allclose(image, (one + other) / 2, atol=1e-6)
    assert made.gaussian_count() == 2 * made.avatars[0].gaussian_count() > 0
    assert made.parameter_count() == 2 * made.avatars[0].parameter_count() > 0
    made.save(tmp_path / "weights.safetensors")
    again = method(capture.training_only(), seed=3, preset="ci")
    again.load(tmp_path / "weights.safetensors")
    assert np.array_equal(again.render(pose, camera, clock=clock), image)
