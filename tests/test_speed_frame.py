"""The table of frames: its rows, and that what is timed is what is defined."""

import numpy as np
import pytest
import torch
from captures import write_tube_capture

from ash.files import read_json
from ash.inference import Player
from ash.method import AshAvatar
from ash.presets import named
from benchmarks import speed_frame
from benchmarks.speed_frame import Agreement, Subject, scaled_camera, subjects


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


def test_the_table_has_every_stage_and_fast_images_agree_with_the_definitions(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(speed_frame, "speed_capture", lambda data: capture)
    subject = Subject(name="ci", config=named("ci"), width=64, height=64, trains=True)
    results = list(speed_frame.speed_frame(capture, timed=(subject,), rounds=2))
    monkeypatch.setattr(speed_frame, "speed_frame", lambda capture: iter(results))
    before = torch.get_num_threads()
    assert speed_frame.main(tmp_path / "rows.json") == 0
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
    agreement = next(result for result in results if isinstance(result, Agreement))
    assert agreement.psnr_db > (80 if agreement.engine == "float32" else 45)
    assert "29.64 frames per second" in capsys.readouterr().out


def test_an_avatar_that_draws_something_else_would_be_seen(capture):
    avatar = AshAvatar(named("ci"), capture)
    camera = scaled_camera(capture.cameras["cam0"], 64, 64)
    player = Player(avatar, capture.motion, camera)
    draw = player.draw
    player.draw = lambda *a, **k: draw(*a, **k) * np.float32(0.9)
    assert speed_frame.agreement(avatar, player, "ci", capture, camera).psnr_db < 40


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
    assert texels == {"cpu@64": 64, "cpu@128": 128, "cpu": 256, "cpu@512": 512, "frugal": 128, "paper": 256}
    assert set(speed_frame.PAPER_MS) <= set(texels.values())
