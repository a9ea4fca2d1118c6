"""The table of frames: its rows, and that what is timed is what is defined."""

import time

import numpy as np
import pytest
import torch
from helpers.captures import write_tube_capture

from ash.avatar import AshAvatar
from ash.files import read_json
from ash.inference import Player
from ash.presets import named
from ash.training.images import load_training_images
from benchmarks.speed import frames, profile
from benchmarks.speed.frames import PictureAgreement, TimedAvatar, scaled_camera, subjects


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


def test_the_table_has_every_stage_and_fast_images_agree_with_the_definitions(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frames, "captured", lambda folder: capture)
    subject = TimedAvatar(name="ci", config=named("ci"), width=64, height=64, trains=True)
    results = list(frames.speed_frame(capture, timed=(subject,), rounds=2))
    monkeypatch.setattr(frames, "speed_frame", lambda capture, device: iter(results))
    before = torch.get_num_threads()
    assert frames.main(tmp_path / "rows.json") == 0
    assert torch.get_num_threads() == before
    written = read_json(tmp_path / "rows.json")
    keys = {(row["what"], row["size"], row["threads"], row["candidate"]) for row in written["rows"]}
    expected = {(stage, "64x64", n, "ci") for stage in ("stg1", "stg2", "stg3", "stg4", "frame") for n in (1, 2)}
    expected |= {
        ("frame", "64x64", 1, "ci-naive"),
        ("train_step", "48x48", 1, "ci"),
        ("train_step", "48x48", 1, "ci-naive"),
    }
    assert keys == expected
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in written["rows"])
    agreement = next(result for result in results if isinstance(result, PictureAgreement))
    assert agreement.psnr_db > (80 if agreement.engine == "float32" else 45)
    assert "29.64 frames per second" in capsys.readouterr().out


def test_an_avatar_that_draws_something_else_would_be_seen(capture):
    avatar = AshAvatar(named("ci"), capture)
    camera = scaled_camera(capture.cameras["cam0"], 64, 64)
    player = Player(avatar, capture.motion, camera)
    draw = player.draw
    player.draw = lambda *a, **k: draw(*a, **k) * np.float32(0.9)
    assert frames.agreement(avatar, player, "ci", capture, camera).psnr_db < 40


def test_a_scaled_camera_sees_the_same_window_in_the_middle(capture):
    camera = capture.cameras["cam0"]
    scaled = scaled_camera(camera, 200, 96)
    centre = np.array([0.0, 0.5, 0.0, 1.0])
    pixels = []
    for view in (camera, scaled):
        projected = view.K @ (view.viewmat @ centre)[:3]
        pixels.append(projected[:2] / projected[2] - (view.width / 2, view.height / 2))
    np.testing.assert_allclose(pixels[1], 2 * pixels[0], atol=1e-9)


def test_the_papers_resolutions_are_timed():
    texels = {subject.name: subject.config.model.texels for subject in subjects()}
    assert texels == {"cpu@64": 64, "cpu@128": 128, "cpu": 256, "cpu@512": 512, "paper": 256}
    assert set(frames.PAPER_MS) <= set(texels.values())


def test_the_parts_of_a_step_are_timed_and_make_up_the_whole(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(profile, "captured", lambda folder: capture)
    monkeypatch.setattr(profile, "SUBJECTS", (("ash", "ci", "float32"), ("ddc", "ci", "float32")))
    monkeypatch.setattr(profile, "STEPS", 12)
    assert profile.main(tmp_path / "parts.json", None) == 0
    rows = read_json(tmp_path / "parts.json")["parts"]
    for method in ("ash", "ddc"):
        ms = {row["part"]: row["median_ms"] for row in rows if row["method"] == method}
        still = {"pose backward"} if method == "ddc" else set()  # most of its steps have no gradient in the vertices
        more = {profile.STATIC} | ({profile.VERTICES} if method == "ddc" else set())
        assert set(ms) == {*profile.PARTS, *more}
        assert all(value > 0 for part, value in ms.items() if part not in still)
        assert sum(ms[part] for part in profile.PARTS) == pytest.approx(2 * ms["step"], rel=0.3)
    printed = capsys.readouterr().out
    assert "ash, ci, float32: milliseconds of a training step on one thread" in printed and "decode backward" in printed


def work(seconds: float) -> None:
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_a_part_that_takes_longer_is_seen(capture):
    avatar = AshAvatar(named("ci"), capture)
    decode, images = avatar._decode, load_training_images(capture)
    avatar._decode = lambda *a, **k: (work(0.5), decode(*a, **k))[1]
    parts = {row.part: row.min_ms for row in profile.profile_step("ash", avatar, images, "ci", steps=4)}
    held = ("decode", "step", profile.STATIC)
    assert parts["decode"] > 500 and max(ms for part, ms in parts.items() if part not in held) < 500
