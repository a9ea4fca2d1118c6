"""What is drawn besides avatars."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import write_tube_capture

from benchmarks.play.avatars import open_avatars
from benchmarks.play.cameras import resized
from benchmarks.play.motions import motion_clips
from benchmarks.play.rendering import TRUTH, UNKNOWN_TRUTH, ViewRenderer, ViewState, fitted
from benchmarks.play.truth import TruthCache
from benchmarks.report.pictures import PAPER, on_paper


def test_a_truth_in_other_pixels_has_no_fringe(tmp_path: Path) -> None:
    """A soft disc in the colour of what is behind it cannot be seen; in another colour it can."""
    own = write_tube_capture(tmp_path / "capture").cameras["cam0"]
    rows, columns = np.mgrid[: own.height, : own.width] + 0.5
    alpha = np.clip(15 - np.hypot(rows - own.height / 2, columns - own.width / 2), 0, 1)[..., None]
    camera = resized(own, width=150, height=130)
    for grey, is_seen in ((PAPER, False), (24, True)):
        disc = np.rint(alpha * np.array([grey, grey, grey, 255])).astype(np.uint8)
        shown = fitted(on_paper(disc), own, camera).astype(int)
        assert shown.shape == (130, 150, 3)
        assert np.abs(shown - PAPER).max() > 100 if is_seen else np.abs(shown - PAPER).max() <= 3


@pytest.fixture(scope="module")
def renderer(tube_run: Path) -> Iterator[ViewRenderer]:
    with open_avatars(tube_run) as avatars:
        yield ViewRenderer(avatars, motion_clips(avatars.capture), TruthCache(avatars.capture))


def drawn(renderer: ViewRenderer, state: ViewState, side: int = 96) -> np.ndarray:
    return renderer.render(state, width=side, height=side, with_scores=True).pixels.astype(int)


@pytest.fixture
def plain(renderer: ViewRenderer) -> ViewState:
    """The first avatar in the held-out motion, through the held-out camera: there the truth is known."""
    return ViewState(left=renderer.avatars.titles[0], clip=1, camera="cam0")


def test_two_avatars_and_the_truth_lie_side_by_side(renderer: ViewRenderer, plain: ViewState) -> None:
    left, other = drawn(renderer, plain), drawn(renderer, replace(plain, left=renderer.avatars.titles[1]))
    own = renderer.avatars.capture
    image = own.image("cam0", renderer.clips[1].frames[0]).astype(float)
    alpha = image[..., 3:] / 255
    truth = alpha * image[..., :3] + (1 - alpha) * PAPER
    for right, wanted in ((renderer.avatars.titles[1], other), (TRUTH, truth)):
        side = own.cameras["cam0"].width if right == TRUTH else 96
        split = drawn(renderer, replace(plain, right=right, divider=0.25), side)
        names = round(0.7 * side)  # below are the names
        column = side // 4
        alone = left if side == 96 else drawn(renderer, plain, side)
        np.testing.assert_array_equal(split[:names, : column - 1], alone[:names, : column - 1])
        assert np.abs(split[:names, column + 2 :] - wanted[:names, column + 2 :]).max() <= 2
        assert np.abs(split[:names, column + 2 :] - alone[:names, column + 2 :]).max() > 40


def test_errors_are_shown_where_the_truth_is_known(renderer: ViewRenderer, plain: ViewState) -> None:
    flip = drawn(renderer, replace(plain, error=True))
    assert np.abs(flip - drawn(renderer, plain)).max() > 40
    other = drawn(renderer, replace(plain, left=renderer.avatars.titles[1], error=True))
    assert np.abs(other - flip).max() > 40, "another avatar is wrong elsewhere"
    known = renderer.render(replace(plain, error=True), width=96, height=96, with_scores=True)
    assert "dB, FLIP" in known.score and known.note == ""
    for asked in ({"error": True}, {"right": TRUTH}):
        elsewhere = renderer.render(replace(plain, camera="cam2", **asked), width=96, height=96, with_scores=True)
        assert elsewhere.note == UNKNOWN_TRUTH and elsewhere.score == ""
