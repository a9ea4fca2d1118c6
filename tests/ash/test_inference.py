"""Playback: engines are measured, and one that draws something else is not used."""

import ctypes
import gc
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import write_tube_capture

from ash import inference
from ash.avatar import AshAvatar
from ash.capture.dataset import Pose
from ash.inference import LEAST_AGREEMENT_DB, Player, psnr
from ash.presets import named
from ash.protocol import StageClock


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


def woken(capture, **model) -> AshAvatar:
    """An avatar whose untrained decoders say something."""
    config = named("ci")
    avatar = AshAvatar(replace(config, model=replace(config.model, **model)), capture)
    generator = torch.Generator().manual_seed(0)
    for parameter in avatar.module.decoders.parameters() if avatar.module.decoders else ():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    return avatar


def test_what_is_played_is_what_was_trained(capture):
    avatar, camera = woken(capture), capture.cameras["cam0"]
    player = Player(avatar, capture.motion, camera)
    names = {engine.name for engine in player.engines}
    assert names == {"float32", "bfloat16", "openvino"}
    assert player.engine.ms == min(engine.ms for engine in player.engines)
    for engine in player.engines:  # Which of them is fastest changes from run to run.
        player.engine = engine
        for frame in (0, 3):
            clock = StageClock()
            drawn = player.draw(frame, camera, clock=clock)
            trained = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
            np.testing.assert_allclose(drawn, trained, atol=0.05 if engine.name == "openvino" else 0.02)
            assert psnr(drawn[..., :3], trained[..., :3], trained[..., 3]) > LEAST_AGREEMENT_DB
            assert list(clock.ms) == ["stg1", "stg2", "stg3", "stg4"]


def test_decoders_matter_to_the_picture(capture):
    avatar, camera = woken(capture), capture.cameras["cam0"]
    still = Player(woken(capture, motion=False), capture.motion, camera)
    assert still.engine is None and still.engines == ()
    assert np.abs(still.draw(0, camera) - Player(avatar, capture.motion, camera).draw(0, camera)).max() > 0.01


def test_an_engine_whose_picture_differs_is_dropped_however_fast(capture, monkeypatch):
    avatar, camera = woken(capture), capture.cameras["cam0"]
    outputs = avatar.module.base.shape
    monkeypatch.setattr(inference, "_in_bfloat16", lambda decoders: lambda conditions: torch.zeros(outputs))
    monkeypatch.setattr(inference, "find_spec", lambda name: None)
    player = Player(avatar, capture.motion, camera)
    assert [engine.name for engine in player.engines] == ["float32"] and player.engine.agreement_db == np.inf


def test_every_engine_follows_the_motion_on_any_number_of_threads(capture):
    avatar, camera = woken(capture), capture.cameras["cam0"]
    threads = torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            player = Player(avatar, capture.motion, camera)
            for frame in (0, 3, 5):
                conditions = avatar.module.conditions(Pose(capture.motion, frame))
                with torch.no_grad():
                    expected = avatar.module.decoders(conditions)
                    for engine in player.engines:
                        tolerance = 0.0 if engine.name == "float32" else 0.03 * float(expected.abs().max())
                        found = engine.decode(conditions)
                        assert found.shape == expected.shape and found.dtype == torch.float32
                        torch.testing.assert_close(found, expected, rtol=0, atol=tolerance, msg=engine.name)
    finally:
        torch.set_num_threads(threads)


class SignalStack(ctypes.Structure):
    """C's `stack_t`: where the handlers of signals run in this thread."""

    _fields_ = (("address", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


def test_players_that_come_and_go_leave_the_signals_a_stack(capture):
    """Where the processor has AMX, OpenVINO takes one; a signal that finds its memory gone ends the process."""
    players = [Player(woken(capture), capture.motion, capture.cameras["cam0"]) for _ in range(3)]
    while players:
        players.pop(0)
        gc.collect()
    stack = SignalStack()
    assert ctypes.CDLL(None).sigaltstack(None, ctypes.byref(stack)) == 0
    if not stack.address:
        return
    spans = [re.match(r"(\w+)-(\w+) rw", line) for line in Path("/proc/self/maps").read_text().splitlines()]
    assert any(int(span[1], 16) <= stack.address < int(span[2], 16) for span in spans if span)
