"""The player, spoken to as a browser speaks; `test_in_a_browser.py` has a real one."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from helpers.browser import FLAGS, find_chromium
from helpers.viewers import PATIENCE, FakeBrowser, browsers, state_of
from helpers.waiting import wait_for

from ash.capture.formats import load_capture
from benchmarks.play.auth import AuthOptions
from benchmarks.play.motions import first_clip, motion_clips
from benchmarks.play.player import PlayServer, playing


@pytest.fixture(scope="module")
def player(tube_run: Path) -> Iterator[PlayServer]:
    with playing(tube_run, options=AuthOptions(clients=8)) as player:
        yield player


@pytest.fixture()
def viewer(player: PlayServer) -> Iterator[FakeBrowser]:
    with browsers(player.url, 1, width=160, height=160) as (browser,):
        browser.wait_for(lambda: browser.arrivals and "Avatar" in browser.controls, PATIENCE)
        yield browser


def test_it_plays_stops_steps_and_slows_down(player: PlayServer, viewer: FakeBrowser) -> None:
    assert state_of(player).playing
    viewer.press("Play or pause")
    viewer.wait_for(lambda: not state_of(player).playing)
    before = state_of(player).step
    viewer.press("Next frame")
    viewer.wait_for(lambda: state_of(player).step == (before + 1) % 2)
    viewer.press("Previous frame")
    viewer.wait_for(lambda: state_of(player).step == before)
    viewer.set("Speed", "1/4")
    viewer.wait_for(lambda: state_of(player).speed == 0.25)


def test_a_still_viewer_gets_one_sharp_picture_and_then_none(player: PlayServer, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    viewer.wait_for(lambda: "160 x 160" in viewer.words and not state_of(player).playing, PATIENCE)
    time.sleep(1.0)
    count = len(viewer.arrivals)
    time.sleep(1.0)
    assert len(viewer.arrivals) == count


def test_the_latest_camera_wins(player: PlayServer, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    viewer.wait_for(lambda: not state_of(player).playing)
    count = len(viewer.arrivals)
    for _ in range(300):
        viewer.angle += 0.005
        viewer.look(viewer.angle)
    eye = np.array([2.5 * np.sin(viewer.angle), 1.2, 2.5 * np.cos(viewer.angle)])
    viewer.wait_for(lambda: np.allclose(state_of(player).viewpoint.position, eye, atol=1e-5), PATIENCE)
    time.sleep(1.0)
    assert count < len(viewer.arrivals) < count + 200, "many were never drawn"


def test_methods_truth_and_errors_are_chosen(player: PlayServer, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    other = player.avatars.titles[1]
    viewer.set("Avatar", other)
    assert other == "DDC+"
    viewer.wait_for(lambda: "**DDC+**" in viewer.words, PATIENCE)
    viewer.set("Camera", "cam0")
    viewer.press("Truth beside it")
    viewer.wait_for(lambda: "Against the truth" in viewer.words and "dB, FLIP" in viewer.words, PATIENCE)
    viewer.set("Show the error", True)
    viewer.wait_for(lambda: state_of(player).error)
    viewer.set("Camera", "free")
    viewer.look(2.0)
    viewer.wait_for(lambda: "No truth of this view yet" in viewer.words, PATIENCE)


def test_an_avatar_that_fails_is_told_of_and_the_player_lives_on(
    player: PlayServer, viewer: FakeBrowser, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = player.avatars[player.avatars.titles[0]]
    with monkeypatch.context() as patch:

        def broken(*_: object, **__: object) -> None:
            raise RuntimeError("the <b>decoder</b> fell over")

        patch.setattr(loaded, "on_black", broken)
        viewer.look(1.0)
        viewer.wait_for(lambda: "could not be drawn" in viewer.words and "decoder" in viewer.words, PATIENCE)
        assert "<b>" not in viewer.words
    count = len(viewer.arrivals)
    viewer.look(1.1)
    viewer.wait_for(lambda: len(viewer.arrivals) > count, PATIENCE)
    viewer.send(
        "ViewerCameraMessage", wxyz=[float("nan")] * 4, position=[0.0] * 3, fov=0.8, near=0.01, far=9.0,
        image_height=160, image_width=160, look_at=[0.0] * 3, up_direction=[0.0, 1.0, 0.0],
    )  # fmt: skip
    viewer.look(1.2)
    viewer.wait_for(lambda: len(viewer.arrivals) > count + 1, PATIENCE)


@pytest.mark.parametrize("seconds", [3.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_eight_viewers_are_all_served_within_bounds(player: PlayServer, seconds: float) -> None:
    process = psutil.Process()
    with browsers(player.url, 8, width=128, height=128) as eight:
        for each in eight:
            each.wait_for(lambda each=each: len(each.arrivals) > 1, PATIENCE)
        before, threads = process.memory_info().rss, threading.active_count()
        turning = [threading.Thread(target=each.turn, args=(seconds,)) for each in eight]
        [thread.start() for thread in turning]
        [thread.join() for thread in turning]
        grown = process.memory_info().rss - before
        counts = [len(each.arrivals) for each in eight]
        assert threading.active_count() <= threads + 8, "a thread per message would be seen"
    assert min(counts) > 0.4 * max(counts), f"nobody starves: {counts}"
    assert grown < 128e6, "what is not yet sent is replaced, not piled up"


def test_browsers_that_are_killed_leave_nothing_behind(player: PlayServer, tmp_path: Path) -> None:
    path = find_chromium()
    if path is None:
        pytest.skip("no Chromium on PATH")
    for number in range(2):
        command = [path, *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={tmp_path / str(number)}", player.url]
        browser = subprocess.Popen(
            command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            wait_for(lambda: any(page.viewer.served for page in list(player.pages.values())), PATIENCE)
        finally:
            os.killpg(browser.pid, signal.SIGKILL)
            browser.wait(20)
        wait_for(lambda: not player.auth.connected and not player.pages and not player.drawing.viewers, PATIENCE)
        if number == 0:  # The first brings the server's pool of threads along.
            names, children = thread_names(), psutil.Process().children()
    assert thread_names() == names and psutil.Process().children() == children


def thread_names() -> list[str]:
    return sorted(thread.name for thread in threading.enumerate() if "ThreadPool" not in thread.name)


@pytest.mark.parametrize(
    ("asked", "opens"), [((), "test"), (("train",), "train"), (("walk",), "walk"), (("dance", "test"), "dance")]
)
def test_it_opens_on_the_motion_that_was_asked_for(asked: tuple[str, ...], opens: str, small_capture: Path) -> None:
    clips = motion_clips(load_capture(small_capture), asked)
    assert len({clip.name for clip in clips}) == len(clips) == 2 + len(set(asked) - {"train", "test"})
    assert clips[first_clip(clips, asked)].name == opens


def test_new_viewers_see_the_motion_that_was_asked_for_and_all_threads_end_with_the_player(tube_run: Path) -> None:
    before = thread_names()
    with playing(tube_run, motions=("train",)) as player, browsers(player.url, 2, width=64, height=64) as two:
        for each in two:
            each.wait_for(lambda each=each: each.arrivals and "Training motion, frame" in each.words, PATIENCE)
    wait_for(lambda: thread_names() == before)
