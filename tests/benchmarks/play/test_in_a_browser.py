"""The player in a real browser: what people do with mouse, keys and fingers, and what they then see."""

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.browser import PHONE, Visit, Visitor
from helpers.scoring import psnr
from helpers.viewers import PATIENCE, state_of
from helpers.waiting import wait_for
from PIL import Image

from ash.capture.dataset import Pose
from ash.protocol import StageClock
from benchmarks import cli
from benchmarks.play.avatars import composite
from benchmarks.play.cameras import START, middle_of, resized
from benchmarks.play.player import PlayServer, playing
from benchmarks.play.rendering import LIGHT, fitted
from benchmarks.play.truth import TruthPicture

WINDOW = (900, 420)  # CSS pixels; the panel covers the right third


@pytest.fixture(scope="module")
def player(tube_run: Path) -> Iterator[PlayServer]:
    with playing(tube_run) as player:
        yield player


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory, small_capture: Path) -> Iterator[PlayServer]:
    """A player of somebody whose truth can be rendered: a mannequin, learned from for a moment."""
    out = tmp_path_factory.mktemp("person")
    short = [
        "--preset",
        "ci",
        "--training.steps",
        "20",
        "--training.warmup_steps",
        "10",
        "--training.fitted_steps",
        "3",
    ]
    assert cli.main(["train", "ash", str(small_capture), *short, "--out", str(out)]) == cli.DONE
    with playing(out) as player:
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
def standing(player: PlayServer, visit: Visitor) -> Iterator[Visit]:
    """A window that stands still in the held-out motion, and nothing went wrong in it."""
    visited = visit(player.url, size=WINDOW)
    assert "token" not in visited.page.url
    visited.page.get_by_text("Novel pose, frame").first.wait_for(timeout=1000 * PATIENCE)
    picture_of(visited.page)
    visited.page.keyboard.press(" ")
    wait_for(lambda: not state_of(player).playing)
    time.sleep(0.5)
    yield visited
    assert visited.errors == [] and visited.poor_contrast() == []


def test_mouse_keys_and_the_system_change_what_is_seen(player: PlayServer, visit: Visitor) -> None:
    """One window for all of it: to open one costs more than what is done in it."""
    with standing(player, visit) as visited:
        tab = visited.page
        check_keys_scrub_and_show_the_error(player, tab)
        check_a_chosen_camera_shows_its_view(player, tab)
        check_the_mouse_turns_and_a_key_switches(player, tab)
        check_light_and_dark_follow_the_system(player, visited)
        check_the_divider_is_dragged(player, tab)


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
    clip, state = player.clips[1], state_of(player)
    with torch.no_grad():
        through = resized(cameras[name], width=WINDOW[0], height=WINDOW[1])
        pose = Pose(clip.motion, clip.frames[state.step])
        wanted = player.avatars[state.left].avatar.render(pose, through, clock=StageClock())
    wait_for(lambda: agreement(shot(tab)[:, :560], composite(wanted, LIGHT)[:, :560]) > 25, PATIENCE)


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


def check_light_and_dark_follow_the_system(player: PlayServer, visited: Visit) -> None:
    tab = visited.page
    light = picture_of(tab)
    assert not state_of(player).dark
    tab.emulate_media(color_scheme="dark")
    wait_for(lambda: state_of(player).dark)
    dark = picture_of(tab, unlike=light)
    assert np.median(light[:, :40]) > 200 and np.median(dark[:, :40]) < 60
    assert visited.poor_contrast() == []
    tab.emulate_media(color_scheme="light")
    wait_for(lambda: not state_of(player).dark)


def check_the_divider_is_dragged(player: PlayServer, tab: Any) -> None:
    handle = tab.locator("#split")
    assert not handle.is_visible()
    tab.keyboard.press("t")
    handle.wait_for(state="visible", timeout=1000 * PATIENCE)
    box = handle.bounding_box()
    view = state_of(player).viewpoint.viewmat
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    assert abs(x - 450) < 3
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(225, y, steps=4)
    tab.mouse.up()
    wait_for(lambda: abs(state_of(player).divider - 0.25) < 0.01)
    np.testing.assert_array_equal(state_of(player).viewpoint.viewmat, view, "the person stays as it was")
    tab.keyboard.press("t")
    wait_for(lambda: state_of(player).right == "nothing")
    handle.wait_for(state="hidden", timeout=1000 * PATIENCE)


def test_truth_is_rendered_where_nobody_ever_looked(person: PlayServer, visit: Visitor) -> None:
    """An arm is raised and a frame chosen with the page's own controls; the button renders, and the score appears."""
    arm = person.avatars.capture.skeleton.names.index("upper_arm_left")
    with standing(person, visit) as visited:
        tab, step = visited.page, state_of(person).step
        frame = slider_named(tab, "Frame")
        frame.fill(str((step + 1) % 2))
        frame.blur()
        wait_for(lambda: state_of(person).step == (step + 1) % 2, PATIENCE)
        tab.get_by_role("tab", name="Pose").click()
        tab.locator("input:visible").first.click()
        tab.get_by_role("option", name="upper arm left", exact=True).click()
        number = slider_named(tab, "About z")
        number.wait_for(timeout=1000 * PATIENCE)
        number.fill("500")
        number.blur()
        wait_for(lambda: dict(state_of(person).turned).get(arm, (0, 0, 0))[1] == 90, PATIENCE)
        number.fill("60")
        number.blur()
        wait_for(lambda: dict(state_of(person).turned)[arm][1] == 60, PATIENCE)
        assert known_truth(person) is None
        tab.get_by_role("tab", name="Compare").click()
        tab.get_by_role("button", name="Render truth here").click()
        tab.get_by_role("progressbar").wait_for(timeout=1000 * PATIENCE)
        tab.get_by_text("Truth: ").first.wait_for(timeout=1000 * PATIENCE)
        tab.get_by_text("Truth rendered in").wait_for(timeout=1000 * PATIENCE)
        tab.get_by_role("progressbar").wait_for(state="hidden", timeout=1000 * PATIENCE)
        tab.get_by_text("Against the truth").first.wait_for(timeout=1000 * PATIENCE)
        assert "dB, FLIP" in tab.get_by_text("Against the truth").first.inner_text()
        state = state_of(person)
        truth = known_truth(person)
        assert truth is not None and (truth.on_black[..., 3] > 128).mean() > 0.02
        wanted = fitted(truth, state.viewpoint.camera(width=WINDOW[0], height=WINDOW[1]), state.background)
        half = slice(470, 575)  # Right of the divider, left of the panel: the raised arm is there.
        assert np.ptp(wanted[:, half].reshape(-1, 3), axis=0).max() > 60
        wait_for(lambda: agreement(shot(tab)[:, half], wanted[:, half]) > 25, PATIENCE)


def known_truth(player: PlayServer) -> TruthPicture | None:
    """The truth of what the only viewer looks at."""
    state = state_of(player)
    camera = player.renderer.camera(state, width=100, height=100)
    return player.truths.find(player.renderer.pose_key(state), player.clips[state.clip], camera)


def slider_named(tab: Any, label: str) -> Any:
    """The number box of a slider."""
    return tab.locator(f"xpath=//*[text()='{label}']/following::input[@inputmode][1]")


def agreement(one: np.ndarray, other: np.ndarray) -> float:
    """PSNR of two pictures of bytes."""
    return psnr(one / 255, other / 255, np.ones(one.shape[:2]))


class Fingers:
    """Touches as a browser gets them from a screen."""

    def __init__(self, tab: Any) -> None:
        self._wire = tab.context.new_cdp_session(tab)

    def drag(self, *paths: tuple[tuple[float, float], tuple[float, float]]) -> None:
        """Each finger from a point to a point, all at once."""
        self._send("touchStart", [start for start, _ in paths])
        for share in np.linspace(0, 1, 9)[1:]:
            self._send("touchMove", [tuple((1 - share) * np.array(a) + share * np.array(b)) for a, b in paths])
            time.sleep(0.03)
        self._send("touchEnd", [])

    def _send(self, kind: str, positions: list[tuple[float, float]]) -> None:
        points = [{"x": float(x), "y": float(y), "id": number} for number, (x, y) in enumerate(positions)]
        self._wire.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_on_a_phone_the_person_comes_first_and_fingers_move_view_and_divider(
    player: PlayServer, visit: Visitor
) -> None:
    visited = visit(player.url, size=PHONE, scheme="dark", touch=True)
    tab, fingers = visited.page, Fingers(visited.page)
    words = tab.get_by_text("Novel pose, frame").first
    words.wait_for(state="attached", timeout=1000 * PATIENCE)
    words.wait_for(state="hidden", timeout=1000 * PATIENCE)
    wait_for(lambda: state_of(player).dark)
    view, middle = state_of(player).viewpoint, middle_of(player.avatars.capture)
    seen_at, _ = view.camera(width=PHONE[0], height=PHONE[1]).project(middle)
    np.testing.assert_allclose(seen_at, np.array(PHONE) / 2, atol=2, err_msg="it looks at the person's middle")
    ahead = (view.position - middle) / np.linalg.norm(view.position - middle)
    assert ahead @ np.array(START) > 0.99, "from the front"
    picture_of(tab)
    tab.keyboard.press(" ")
    wait_for(lambda: not state_of(player).playing)
    time.sleep(0.5)
    first, view = picture_of(tab), state_of(player).viewpoint
    target = np.array([0.0, 0.5, 0.0])  # the tube's middle
    fingers.drag(((100, 300), (220, 300)))
    picture_of(tab, unlike=first)
    turned = state_of(player).viewpoint
    reach, now = (np.linalg.norm(each.position - target) for each in (view, turned))
    assert np.linalg.norm(turned.position - view.position) > 0.2 and abs(now / reach - 1) < 0.05, "around the person"
    fingers.drag(((170, 300), (110, 300)), ((220, 300), (280, 300)))
    wait_for(lambda: np.linalg.norm(state_of(player).viewpoint.position - target) < 0.97 * reach, PATIENCE)
    tab.keyboard.press("t")
    handle = tab.locator("#split")
    handle.wait_for(state="visible", timeout=1000 * PATIENCE)
    time.sleep(0.5)
    box, view = handle.bounding_box(), state_of(player).viewpoint
    y = box["y"] + box["height"] / 2
    fingers.drag(((PHONE[0] / 2, y), (0.25 * PHONE[0], y)))
    wait_for(lambda: abs(state_of(player).divider - 0.25) < 0.01, PATIENCE)
    np.testing.assert_array_equal(state_of(player).viewpoint.viewmat, view.viewmat, "the person stays as it was")
    box = handle.bounding_box()
    assert abs(box["x"] + box["width"] / 2 - 0.25 * PHONE[0]) < 3
    tab.keyboard.press("t")
    handle.wait_for(state="hidden", timeout=1000 * PATIENCE)
    tab.get_by_text("ash-bench play", exact=True).locator("visible=true").tap()
    words.wait_for(state="visible", timeout=1000 * PATIENCE)
    assert visited.too_wide() == [] and visited.errors == [] and visited.poor_contrast() == []
