"""The player in a real browser: what people do with mouse and keys, and what they then see."""

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import Visit, Visitor
from helpers.scoring import psnr
from helpers.viewers import PATIENCE, state_of
from helpers.waiting import wait_for
from PIL import Image

from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.cell.metrics import quantise
from benchmarks.play.cameras import resized
from benchmarks.play.player import PlayServer, playing
from benchmarks.play.rendering import fitted
from benchmarks.report.pictures import on_paper

WINDOW = (900, 420)  # CSS pixels; the panel covers the right third


@pytest.fixture(scope="module")
def player(tube_run: Path) -> Iterator[PlayServer]:
    with playing(tube_run) as player:
        yield player


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory, small_capture: Path) -> Iterator[PlayServer]:
    """A player of somebody whose truth can be rendered: a mannequin, learned from for a moment."""
    out = tmp_path_factory.mktemp("person")
    budget = {"preset": "ci", "training.steps": "20", "training.warmup_steps": "10", "training.fitted_steps": "3"}
    short = [word for name, value in budget.items() for word in (f"--{name}", value)]
    assert cli.main(["train", "ash", str(small_capture), *short, "--out", str(out)]) == cli.DONE
    with playing(out, motions=("walk",)) as player:
        yield player


def shot(tab: Any) -> np.ndarray:
    """What the window shows, `[h, w, 3]`."""
    return np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)


def picture_of(tab: Any, *, unlike: np.ndarray | None = None) -> np.ndarray:
    """The page left of the panel once it shows an avatar, or another picture than before."""
    end = time.perf_counter() + PATIENCE
    while time.perf_counter() < end:
        picture = shot(tab)[:, :500]
        if unlike is None and (np.ptp(picture.reshape(-1, 3), axis=0) > 60).any():
            return picture
        if unlike is not None and np.abs(picture - unlike).mean() > 0.5:
            return picture
        time.sleep(0.1)
    raise AssertionError("the picture is not there" if unlike is None else "the picture stays as it was")


@contextmanager
def standing(player: PlayServer, visit: Visitor, motion: str = "Novel pose") -> Iterator[Visit]:
    """A window that stands still in a motion, and nothing went wrong in it."""
    visited = visit(player.url, size=WINDOW)
    assert "token" not in visited.page.url
    visited.page.get_by_text(f"{motion}, frame").first.wait_for(timeout=1000 * PATIENCE)
    picture_of(visited.page)
    visited.page.keyboard.press(" ")
    wait_for(lambda: not state_of(player).playing)
    time.sleep(0.5)
    yield visited
    assert visited.errors == [] and visited.poor_contrast() == []


def test_mouse_and_keys_change_what_is_seen(player: PlayServer, visit: Visitor) -> None:
    """One window for all of it: to open one costs more than what is done in it."""
    with standing(player, visit) as visited:
        tab = visited.page
        check_keys_scrub_and_show_the_error(player, tab)
        check_a_chosen_camera_shows_its_view(player, tab)
        check_the_mouse_turns_and_a_key_switches(player, tab)


def check_keys_scrub_and_show_the_error(player: PlayServer, tab: Any) -> None:
    first, view = picture_of(tab), state_of(player).viewpoint.viewmat
    step = state_of(player).step
    tab.keyboard.press("ArrowRight")
    wait_for(lambda: state_of(player).step == (step + 1) % 2)
    tab.keyboard.press("e")
    wait_for(lambda: state_of(player).error)
    tab.keyboard.press("e")
    wait_for(lambda: not state_of(player).error)
    np.testing.assert_array_equal(state_of(player).viewpoint.viewmat, view, "keys are commands and move no camera")
    picture_of(tab, unlike=first)


def check_a_chosen_camera_shows_its_view(player: PlayServer, tab: Any) -> None:
    before, cameras = shot(tab)[:, :500], player.avatars.capture.cameras

    def is_chosen() -> bool:
        if state_of(player).camera not in cameras:  # A busy browser may drop a key.
            tab.keyboard.press("c")
            time.sleep(1.0)
        return state_of(player).camera in cameras

    wait_for(is_chosen, PATIENCE)
    name = state_of(player).camera
    wait_for(lambda: np.abs(state_of(player).viewpoint.viewmat - cameras[name].viewmat).max() < 1e-3, PATIENCE)
    picture_of(tab, unlike=before)
    state, through = state_of(player), resized(cameras[name], width=WINDOW[0], height=WINDOW[1])
    pose = player.renderer.pose(state.clip, state.step)
    wanted = quantise(player.avatars[state.left].avatar.render(pose, through, clock=StageClock()))
    wait_for(lambda: agreement(shot(tab)[:, :560], on_paper(wanted)[:, :560]) > 25, PATIENCE)


def check_the_mouse_turns_and_a_key_switches(player: PlayServer, tab: Any) -> None:
    before, view = picture_of(tab), state_of(player).viewpoint.viewmat
    tab.mouse.move(200, 200)
    tab.mouse.down()
    tab.mouse.move(230, 210, steps=5)
    tab.mouse.up()
    turned = picture_of(tab, unlike=before)
    assert np.abs(state_of(player).viewpoint.viewmat - view).max() > 0.05
    tab.keyboard.press("m")
    tab.get_by_text(f"{player.avatars.titles[1]} · Novel pose").first.wait_for(timeout=1000 * PATIENCE)
    picture_of(tab, unlike=turned)


def test_truth_is_rendered_where_nobody_ever_looked(person: PlayServer, visit: Visitor) -> None:
    """Of a motion that is not the capture's, a frame is chosen; the button renders, and the score appears."""
    with standing(person, visit, "Walk") as visited:
        tab = visited.page
        frame = tab.locator("xpath=//*[text()='Frame']/following::input[@inputmode][1]")
        frame.fill("7")
        frame.blur()
        wait_for(lambda: state_of(person).step == 7, PATIENCE)
        assert person.renderer.truth(state_of(person)) is None
        tab.get_by_role("tab", name="Compare").click()
        tab.get_by_role("button", name="Render truth here").click()
        tab.get_by_text("Truth: ").first.wait_for(timeout=1000 * PATIENCE)
        tab.get_by_text("Truth rendered in").wait_for(timeout=1000 * PATIENCE)
        tab.get_by_text("Against the truth").first.wait_for(timeout=1000 * PATIENCE)
        assert "dB, FLIP" in tab.get_by_text("Against the truth").first.inner_text()
        state = state_of(person)
        truth = person.renderer.truth(state)
        assert truth is not None and (truth.on_black[..., 3] > 128).mean() > 0.02
        wanted = fitted(on_paper(truth.on_black), truth.camera, state.viewpoint)
        half = slice(451, 575)  # Right of the divider, left of the panel.
        assert np.ptp(wanted[:, half].reshape(-1, 3), axis=0).max() > 60
        wait_for(lambda: agreement(shot(tab)[:, half], wanted[:, half]) > 25, PATIENCE)


def agreement(one: np.ndarray, other: np.ndarray) -> float:
    """PSNR of two pictures of bytes."""
    return psnr(one / 255, other / 255, np.ones(one.shape[:2]))
