"""Frames and steps: the rows of the table, what is drawn when a frame is timed, and agreement with the definitions."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import SIZE
from helpers.commands import refused

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.capture.formats import load_capture
from ash.files import InputError, read_json
from ash.presets import plus
from ash.training.images import load_training_images
from benchmarks import cli
from benchmarks.play.avatars import open_avatars
from benchmarks.speed import frames, profile
from benchmarks.speed.frames import Agreement, Clip, Subject, held_out_clips, scaled_camera, subjects, time_clip

NEAR, NEW = (1, 2, 3), (4, 5)  # Training frames of the tube serve as near motion.
AGREES_DB = 60  # A splat whose opacity is 1/255 is drawn or skipped by rounding.
Trained = tuple[AshAvatar, Capture]


@pytest.fixture(scope="module")
def capture(tube_run: Path) -> Capture:
    return load_capture(tube_run.parent / "capture")


@pytest.fixture(scope="module")
def trained(tube_cells: dict[str, Path]) -> Iterator[Trained]:
    """The tube as ash, and its capture with near motion."""
    with open_avatars(tube_cells["ash"]) as avatars:
        avatar = avatars.only().avatar
        assert isinstance(avatar, AshAvatar)
        yield avatar, with_near_motion(avatars.capture)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The definitions of 512x512 pixels would take seconds."""
    monkeypatch.setattr(frames, "SIZE", (64, 64))


def with_near_motion(capture: Capture) -> Capture:
    near = replace(capture.splits["novel_pose"], frames=NEAR)
    return replace(capture, splits=capture.splits | {"near_pose": near})


def clips_of(capture: Capture) -> list[Clip]:
    """Near and new motion at the size of the capture's images."""
    return [clip for clip in held_out_clips(capture, "it") if clip.camera.width == SIZE]


def agreements(avatar: AshAvatar, capture: Capture, *, threads: tuple[int, ...] = (1,)) -> dict[str, Agreement]:
    """By the motion's name."""
    results = (result for clip in clips_of(capture) for result in time_clip(avatar, clip, threads=threads))
    return {each.candidate.split()[1]: each for each in results if isinstance(each, Agreement)}


def test_the_table_has_every_stage_and_fast_images_agree_with_the_definitions(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frames, "captured", lambda folder: capture)
    monkeypatch.setattr(
        frames, "subjects", lambda: (Subject(name="ci", config=plus("ci"), width=64, height=64, trains=True),)
    )
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
    (agreement,) = written["agreements"]
    assert agreement["least_db"] > AGREES_DB and agreement["frames"] == frames.DEFINITION_RUNS
    assert "29.64 frames per second" in capsys.readouterr().out


def test_the_table_of_a_trained_cell_has_every_stage_and_agrees_with_the_definitions(
    tube_cells: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["speed", "frame", "--avatar", str(tube_cells["ash"]), "--json", str(tmp_path / "rows.json")]
    assert cli.main(command) == cli.DONE
    written = read_json(tmp_path / "rows.json")
    assert set(written) == {"rows", "agreements", "paper_ms"}
    (by,) = {row["candidate"].removesuffix("-naive") for row in written["rows"]}
    assert by.startswith("ash_plus+") and by.endswith(":ci new"), "the method with its changes, the preset, the motion"
    sizes, stages = ("64x64", f"{SIZE}x{SIZE}"), ("stg1", "stg2", "stg3", "stg4", "frame")
    expected = {(what, size, n, by) for size in sizes for what in stages for n in (1, 2)}
    expected |= {("frame", size, 1, f"{by}-naive") for size in sizes}
    assert {(row["what"], row["size"], row["threads"], row["candidate"]) for row in written["rows"]} == expected
    assert [agreement["size"] for agreement in written["agreements"]] == list(sizes)
    for agreement in written["agreements"]:
        assert agreement["frames"] == len(NEW)
        assert AGREES_DB < agreement["least_db"] <= agreement["median_db"]
    assert f"median of {len(NEW)} frames" in capsys.readouterr().out


def test_another_method_and_several_avatars_are_refused(tube_run: Path, tube_cells: dict[str, Path], capsys) -> None:
    assert "expected an avatar of ASH" in refused(capsys, "speed", "frame", "--avatar", str(tube_cells["ddc"]))
    assert "give the folder of a cell" in refused(capsys, "speed", "frame", "--avatar", str(tube_run))


def test_near_and_new_motion_are_timed_in_the_order_of_playback(trained: Trained) -> None:
    _, capture = trained
    near = replace(capture.splits["near_pose"], frames=NEAR[::-1])
    clips = held_out_clips(replace(capture, splits=capture.splits | {"near_pose": near}), "it")
    timed = [(clip.title, tuple(pose.frame for pose in clip.poses), clip.camera.width) for clip in clips]
    assert timed == [("it near", NEAR, 64), ("it near", NEAR, SIZE), ("it new", NEW, 64), ("it new", NEW, SIZE)]
    with pytest.raises(InputError, match="near or new motion"):
        held_out_clips(replace(capture, splits={"train": capture.splits["train"]}), "it")


def test_a_timed_frame_poses_its_own_template_and_not_that_of_the_frames_before(
    trained: Trained, monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    template, posed, timed = avatar.module.template, [], []
    anew, render = template.pose_uncached, avatar.render

    def recorded(pose, *rest, **options):
        posed.clear()
        image = render(pose, *rest, **options)
        timed.append((pose.frame, *posed))
        return image

    monkeypatch.setattr(template, "pose_uncached", lambda pose: posed.append(pose.frame) or anew(pose))
    monkeypatch.setattr(avatar, "render", recorded)
    agreements(avatar, capture, threads=(1, 2))
    assert avatar.config.model.window > 1
    assert timed == [(frame, frame) for frame in (*NEAR, *NEW) for _ in (1, 2)]


def test_one_wrong_image_lowers_the_least_agreement_and_not_the_median(
    trained: Trained, monkeypatch: pytest.MonkeyPatch
) -> None:
    avatar, capture = trained
    render = avatar.render

    def dimmed(pose, *rest, **options):
        wrong = pose.frame == NEAR[1] and torch.get_num_threads() == 2
        return render(pose, *rest, **options) * np.float32(0.9 if wrong else 1)

    monkeypatch.setattr(avatar, "render", dimmed)
    assert agreements(avatar, capture)["near"].least_db > AGREES_DB
    near = agreements(avatar, capture, threads=(1, 2))["near"]
    assert near.least_db < 40 < AGREES_DB < near.median_db


def test_an_empty_image_does_not_agree(trained: Trained, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, capture = trained
    empty = np.zeros((SIZE, SIZE, 4), np.float32)
    monkeypatch.setattr(avatar, "render", lambda *_, **__: empty)
    assert agreements(avatar, capture)["near"].median_db < 30


def test_an_avatar_without_decoders_agrees_too(capture: Capture) -> None:
    config = plus("ci")
    avatar = AshAvatar.from_capture(replace(config, model=replace(config.model, motion=False)), capture)
    for agreement in agreements(avatar, with_near_motion(capture)).values():
        assert agreement.least_db > AGREES_DB


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
    assert texels == {
        "ash cpu": 128,
        "ash_plus cpu@64": 64,
        "ash_plus cpu": 128,
        "ash_plus cpu@256": 256,
        "ash_plus cpu@512": 512,
        "ash paper": 256,
    }
    assert set(frames.PAPER_MS) <= set(texels.values())


def test_the_parts_of_a_step_are_timed_and_make_up_the_whole(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(profile, "captured", lambda folder: capture)
    monkeypatch.setattr(profile, "SUBJECTS", (("ash_plus", "ci", "float32"), ("ddc_plus", "ci", "float32")))
    monkeypatch.setattr(profile, "STEPS", 12)
    assert profile.main(tmp_path / "parts.json", None) == 0
    rows = read_json(tmp_path / "parts.json")["rows"]
    for method in ("ash_plus", "ddc_plus"):
        ms = {row["what"]: row["median_ms"] for row in rows if row["candidate"] == f"{method} ci float32"}
        still = (
            {"pose backward"} if method == "ddc_plus" else set()
        )  # most of its steps have no gradient in the vertices
        more = {profile.VERTICES} if method == "ddc_plus" else set()
        assert set(ms) == {*profile.PARTS, *more, "train_step"}
        assert all(value > 0 for part, value in ms.items() if part not in still)
        assert sum(ms[part] for part in profile.PARTS) == pytest.approx(2 * ms["step"], rel=0.3)
    assert "decode backward" in capsys.readouterr().out


def test_a_part_that_takes_longer_is_seen(capture, tmp_path):
    avatar = AshAvatar.from_capture(plus("ci"), capture)
    decode, images = avatar._decode, load_training_images(capture)

    def slow(*arguments):
        until = time.thread_time() + 0.3
        while time.thread_time() < until:
            pass
        return decode(*arguments)

    avatar._decode = slow
    candidate = profile.profiled(avatar, images, "it", tmp_path)
    parts = {part: ms for number in range(3) for part, ms in candidate.call(number).items()}
    others = [ms for part, ms in parts.items() if part not in ("decode", "step")]
    assert parts["decode"] > 300 and parts["decode"] > max(others)
