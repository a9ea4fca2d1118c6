"""The player, spoken to as a browser speaks, and in a real one."""

import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.chromium import chromium
from helpers.viewers import FakeBrowser, browsers
from PIL import Image

from benchmarks.play.doors import DoorOptions
from benchmarks.play.player import Player, playing

pytestmark = pytest.mark.slow  # Trains, and drives a browser: a minute and more.

PATIENCE = 120.0  # seconds; software graphics on a busy machine


@pytest.fixture(scope="module")
def player(tube_run: Path) -> Iterator[Player]:
    with playing(tube_run, doors=DoorOptions(clients=8)) as player:
        yield player


@pytest.fixture()
def viewer(player: Player) -> Iterator[FakeBrowser]:
    with browsers(player.url, 1, width=160, height=160) as (browser,):
        browser.wait_for(lambda: browser.arrivals and "Avatar" in browser.controls, PATIENCE)
        yield browser


def state_of(player: Player):
    (page,) = player._pages.values()
    return page.viewer.state


def test_it_plays_and_stops_and_steps_by_keys(player: Player, viewer: FakeBrowser) -> None:
    assert state_of(player).playing
    viewer.press("Play or pause")
    viewer.wait_for(lambda: not state_of(player).playing)
    before = state_of(player).step
    viewer.press("Next frame")
    viewer.wait_for(lambda: state_of(player).step == (before + 1) % 2)
    viewer.press("Previous frame")
    viewer.wait_for(lambda: state_of(player).step == before)


def test_a_still_viewer_gets_one_sharp_picture_and_then_none(player: Player, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    viewer.wait_for(lambda: "160 x 160" in viewer.words and not state_of(player).playing, PATIENCE)
    time.sleep(1.0)
    count = len(viewer.arrivals)
    time.sleep(1.0)
    assert len(viewer.arrivals) == count


def test_the_latest_camera_wins(player: Player, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    viewer.wait_for(lambda: not state_of(player).playing)
    count = len(viewer.arrivals)
    for _ in range(300):
        viewer.angle += 0.005
        viewer.look(viewer.angle)
    eye = np.array([2.5 * np.sin(viewer.angle), 1.2, 2.5 * np.cos(viewer.angle)])
    viewer.wait_for(lambda: np.allclose(state_of(player).eye.position, eye, atol=1e-5), PATIENCE)
    time.sleep(1.0)
    assert count < len(viewer.arrivals) < count + 200, "many were never drawn"


def test_methods_truth_errors_and_joints_are_chosen(player: Player, viewer: FakeBrowser) -> None:
    viewer.press("Play or pause")
    other = player.cast.titles[1]
    viewer.set("Avatar", other)
    viewer.wait_for(lambda: f"**{other}**" in viewer.words, PATIENCE)
    viewer.set("Camera", "cam0")
    viewer.press("Truth beside it")
    viewer.wait_for(lambda: "Against the truth" in viewer.words and "dB, FLIP" in viewer.words, PATIENCE)
    viewer.set("Show the error", "FLIP")
    viewer.set("Joint", player.cast.capture.skeleton.names[1])
    time.sleep(1.0)  # As a hand needs: the sliders take the joint's angles first.
    viewer.set("About x", 30)
    viewer.wait_for(lambda: state_of(player).bends == ((1, (30.0, 0.0, 0.0)),))
    viewer.wait_for(lambda: "No truth of this view yet" in viewer.words, PATIENCE)


def test_an_avatar_that_fails_is_told_of_and_the_player_lives_on(
    player: Player, viewer: FakeBrowser, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = player.cast.actor(player.cast.titles[0])
    with monkeypatch.context() as patch:

        def broken(*_: object) -> None:
            raise RuntimeError("the <b>decoder</b> fell over")

        patch.setattr(actor, "view", broken)
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


def test_eight_viewers_are_all_served(player: Player) -> None:
    with browsers(player.url, 8, width=128, height=128) as eight:
        for each in eight:
            each.wait_for(lambda each=each: len(each.arrivals) > 1, PATIENCE)
        turning = [threading.Thread(target=each.turn, args=(4.0,)) for each in eight]
        [thread.start() for thread in turning]
        [thread.join() for thread in turning]
        counts = [len(each.arrivals) for each in eight]
    assert min(counts) > 0.4 * max(counts), f"nobody starves: {counts}"


def test_ten_browsers_that_vanish_leave_nothing_behind(player: Player) -> None:
    with browsers(player.url, 1) as (first,):
        first.wait_for(lambda: first.arrivals, PATIENCE)
    time.sleep(1.0)
    names = sorted(thread.name.partition("_")[0] for thread in threading.enumerate())
    for _ in range(10):
        browser = FakeBrowser(player.url, width=64, height=64)
        browser.wait_for(lambda browser=browser: browser.arrivals, PATIENCE)
        browser.socket.socket.close()  # As a process that is killed: without a word.
        browser._thread.join(5)
    end = time.perf_counter() + 30
    while (player.doors.inside or player._pages) and time.perf_counter() < end:
        time.sleep(0.1)
    assert player.doors.inside == 0 and player._pages == {} and player.stream._viewers == []
    now = sorted(thread.name.partition("_")[0] for thread in threading.enumerate())
    assert [name for name in now if "ThreadPool" not in name] == [name for name in names if "ThreadPool" not in name]


def test_all_threads_end_with_the_player(tube_run: Path) -> None:
    before = {thread.ident for thread in threading.enumerate()}
    with playing(tube_run) as player, browsers(player.url, 2, width=64, height=64) as two:
        for each in two:
            each.wait_for(lambda each=each: each.arrivals, PATIENCE)
    end = time.perf_counter() + 20
    while time.perf_counter() < end and {t.ident for t in threading.enumerate()} - before:
        time.sleep(0.1)
    left = [t.name for t in threading.enumerate() if t.ident not in before]
    assert left == []


def test_in_a_real_browser_it_shows_turns_and_switches(player: Player) -> None:
    def pixels(tab) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)

    def seen(tab, seconds: float = PATIENCE) -> np.ndarray:
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            picture = pixels(tab)
            if (np.ptp(picture[:, :300].reshape(-1, 3), axis=0) > 60).any():
                return picture
            time.sleep(0.3)
        raise AssertionError("no avatar in the page")

    with chromium() as browser:
        tab = browser.new_page(viewport={"width": 700, "height": 420})
        problems: list[str] = []
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.goto(player.url)
        assert "token" not in tab.url
        tab.get_by_text("Held-out motion, frame").first.wait_for(timeout=1000 * PATIENCE)
        tab.keyboard.press(" ")
        first = seen(tab)
        tab.mouse.move(200, 200)
        tab.mouse.down()
        tab.mouse.move(300, 230, steps=5)
        tab.mouse.up()
        end = time.perf_counter() + PATIENCE
        while np.abs(pixels(tab) - first)[:, :300].mean() < 0.5:
            assert time.perf_counter() < end, "dragging turns the picture"
        tab.keyboard.press("m")
        tab.get_by_text(f"{player.cast.titles[1]} · Held-out").first.wait_for(timeout=1000 * PATIENCE)
        assert problems == []
