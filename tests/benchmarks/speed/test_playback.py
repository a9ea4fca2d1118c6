"""The table of a trained avatar: its rows, what is posed when a frame is timed, and which frames are compared."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import SIZE, write_tube_capture
from helpers.commands import refused

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.files import InputError, read_json
from ash.inference import LEAST_AGREEMENT_DB, Player
from ash.presets import named
from ash.textures import TextureDrawer
from benchmarks import cli
from benchmarks.play.avatars import open_avatars
from benchmarks.speed import playback
from benchmarks.speed.playback import PlaybackAgreement, held_out_clips, speed_playback

NEAR, NEW = (1, 2, 3), (4, 5)  # Training frames of the tube stand for near motion.


def with_near_motion(capture: Capture) -> Capture:
    near = replace(capture.splits["novel_pose"], frames=NEAR)
    return replace(capture, splits=capture.splits | {"near_pose": near})


@pytest.fixture(scope="module")
def trained(tube_cells: dict[str, Path]) -> Iterator[tuple[AshAvatar, Capture]]:
    """The tube as ash, and its capture with near motion."""
    with open_avatars(tube_cells["ash"]) as avatars:
        avatar = avatars.only().avatar
        assert isinstance(avatar, AshAvatar)
        yield avatar, with_near_motion(avatars.capture)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The definitions of 512x512 pixels would take seconds."""
    monkeypatch.setattr(playback, "SIZE", (64, 64))


def agreements(avatar: AshAvatar, capture: Capture, *, threads: tuple[int, ...] = (1,)) -> dict[str, PlaybackAgreement]:
    """By the motion's name, at the size of the capture's images."""
    clips = [clip for clip in held_out_clips(avatar.module, capture, "it") if clip.camera.width == SIZE]
    found = speed_playback(avatar, clips, threads=threads, rounds=1)
    return {each.candidate.split()[1]: each for each in found if isinstance(each, PlaybackAgreement)}


def spoil(monkeypatch: pytest.MonkeyPatch, noise: float) -> None:
    """Every player decodes something else than on the frame on which its engine was chosen."""
    made = playback.players_of

    def players_of(*arguments: object) -> dict[int, Player]:
        players = made(*arguments)
        for player in players.values():
            engine = player.engine
            assert engine is not None

            def decode(seen: object, exact=engine.decode) -> torch.Tensor:
                raw = exact(seen)
                return raw + noise * torch.randn(raw.shape, generator=torch.Generator().manual_seed(0))

            player.engine = replace(engine, decode=decode)
        return players

    monkeypatch.setattr(playback, "players_of", players_of)


def test_the_table_of_a_trained_cell_has_every_stage_and_agrees_with_the_definitions(
    tube_cells: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["speed", "frame", "--avatar", str(tube_cells["ash"]), "--json", str(tmp_path / "rows.json")]
    assert cli.main(command) == cli.DONE
    written = read_json(tmp_path / "rows.json")
    assert set(written) == {"rows", "agreements", "paper_ms"}
    (by,) = {row["candidate"].removesuffix("-naive") for row in written["rows"]}
    assert by.startswith("ash+") and by.endswith(":ci new"), "the method with its changes, the preset, the motion"
    sizes, stages = ("64x64", f"{SIZE}x{SIZE}"), ("stg1", "stg2", "stg3", "stg4", "frame")
    expected = {(what, size, n, by) for size in sizes for what in stages for n in (1, 2)}
    expected |= {("frame", size, 1, f"{by}-naive") for size in sizes}
    assert {(row["what"], row["size"], row["threads"], row["candidate"]) for row in written["rows"]} == expected
    assert all(0 < row["min_ms"] <= row["median_ms"] for row in written["rows"])
    assert [found["size"] for found in written["agreements"]] == list(sizes)
    for found in written["agreements"]:
        assert found["frames"] == len(NEW)
        assert LEAST_AGREEMENT_DB < found["least_db"] <= found["median_db"]
    assert f"of {len(NEW)} frames, decoded by shares of" in capsys.readouterr().out


def test_another_method_and_several_avatars_are_refused(tube_run: Path, tube_cells: dict[str, Path], capsys) -> None:
    assert "expected an avatar of ASH" in refused(capsys, "speed", "frame", "--avatar", str(tube_cells["ddc"]))
    assert "give the folder of a cell" in refused(capsys, "speed", "frame", "--avatar", str(tube_run))


def test_a_capture_without_held_out_motion_is_refused(trained: tuple[AshAvatar, Capture]) -> None:
    avatar, capture = trained
    with pytest.raises(InputError, match="near or new motion"):
        held_out_clips(avatar.module, replace(capture, splits={"train": capture.splits["train"]}), "it")


def test_near_and_new_motion_are_timed_in_the_order_of_playback(trained: tuple[AshAvatar, Capture]) -> None:
    avatar, capture = trained
    near = replace(capture.splits["near_pose"], frames=NEAR[::-1])
    clips = held_out_clips(avatar.module, replace(capture, splits=capture.splits | {"near_pose": near}), "it")
    seen = [(clip.candidate, tuple(pose.frame for pose in clip.poses), clip.camera.width) for clip in clips]
    assert seen == [("it near", NEAR, 64), ("it near", NEAR, SIZE), ("it new", NEW, 64), ("it new", NEW, SIZE)]


def test_a_timed_frame_poses_its_own_template_and_not_that_of_the_frames_before(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    template, posed, timed = avatar.module.template, [], []
    anew, time_it = template.pose_anew, playback.timed_frame

    def timed_frame(player: Player, frame: int, *rest: object) -> dict[str, float]:
        posed.clear()
        ms = time_it(player, frame, *rest)
        timed.append((frame, *posed))
        return ms

    monkeypatch.setattr(template, "pose_anew", lambda pose: posed.append(pose.frame) or anew(pose))
    monkeypatch.setattr(playback, "timed_frame", timed_frame)
    agreements(avatar, capture, threads=(1, 2))
    assert avatar.config.model.window > 1
    assert timed == [(frame, frame) for frame in (*NEAR, *NEW) for _ in (1, 2)]


def test_decoders_that_say_something_else_lower_the_agreement(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    good = agreements(avatar, capture)["near"]
    assert good.frames == len(NEAR) and good.least_db > LEAST_AGREEMENT_DB
    spoil(monkeypatch, 0.3)
    bad = agreements(avatar, capture)["near"]
    assert bad.median_db < 40 and bad.least_db < good.least_db - 10


def test_what_is_told_has_the_least_share_that_is_decoded(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    monkeypatch.setattr(TextureDrawer, "trust", lambda self, textures: 0.7 if self.novelty(textures) > 1e-3 else 1.0)
    found = agreements(avatar, capture)
    assert found["new"].least_trust == 0.7
    assert f"of {len(NEW)} frames, decoded by shares of 0.70 or more" in found["new"].told()


def test_one_bad_frame_is_the_least_and_not_the_median(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    draw = Player.draw

    def dimmed(self: Player, frame: int, *rest: object, **more: object) -> np.ndarray:
        return draw(self, frame, *rest, **more) * np.float32(0.9 if frame == NEAR[1] else 1)

    monkeypatch.setattr(Player, "draw", dimmed)
    found = agreements(avatar, capture)["near"]
    assert found.least_db < 40 < LEAST_AGREEMENT_DB < found.median_db


def test_one_bad_player_is_not_hidden_by_the_other(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    made = playback.players_of

    def players_of(*arguments: object) -> dict[int, Player]:
        players = made(*arguments)
        draw = players[2].draw
        monkeypatch.setattr(players[2], "draw", lambda *a, **k: draw(*a, **k) * np.float32(0.9))
        return players

    monkeypatch.setattr(playback, "players_of", players_of)
    assert agreements(avatar, capture, threads=(1, 2))["near"].median_db < 40


def test_an_image_of_nothing_does_not_agree(
    trained: tuple[AshAvatar, Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    monkeypatch.setattr(Player, "draw", lambda self, frame, camera, **k: np.zeros((camera.height, camera.width, 4)))
    monkeypatch.setattr(playback, "timed_frame", lambda *a: {"frame": 1.0})
    assert agreements(avatar, capture)["near"].median_db < 30


def test_an_avatar_without_decoders_agrees_too(tmp_path: Path) -> None:
    capture = with_near_motion(write_tube_capture(tmp_path / "capture"))
    config = named("ci")
    avatar = AshAvatar(replace(config, model=replace(config.model, motion=False)), capture)
    for found in agreements(avatar, capture).values():
        assert found.least_trust == 1.0 and found.least_db > LEAST_AGREEMENT_DB
        assert found.engines == () and "no decoders" in found.told()


def test_torch_has_as_many_threads_afterwards_as_before(trained: tuple[AshAvatar, Capture]) -> None:
    avatar, capture = trained
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        list(speed_playback(avatar, held_out_clips(avatar.module, capture, "it")[:1], threads=(1,), rounds=1))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
