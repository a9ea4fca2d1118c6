"""What is drawn besides avatars."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.captures import write_tube_capture
from helpers.figures import tube_motion, tube_skeleton

from ash.capture.dataset import Camera
from benchmarks.play.avatars import open_avatars
from benchmarks.play.cameras import resized
from benchmarks.play.motions import angles_of, motion_clips, with_angles
from benchmarks.play.rendering import (
    DARK,
    JOINT,
    LIGHT,
    MESH,
    TRUTH,
    TURNED_JOINT,
    UNKNOWN_TRUTH,
    ViewRenderer,
    ViewState,
    fitted,
    with_mesh,
)
from benchmarks.play.truth import TruthCache, TruthPicture
from synth.posing import bone_frames, rotvec_to_rotmat


def test_a_truth_in_other_pixels_has_no_fringe(tmp_path: Path) -> None:
    """A soft disc in the colour of what is behind it cannot be seen; in another colour it can."""
    own = write_tube_capture(tmp_path / "capture").cameras["cam0"]
    rows, columns = np.mgrid[: own.height, : own.width] + 0.5
    alpha = np.clip(15 - np.hypot(rows - own.height / 2, columns - own.width / 2), 0, 1)
    for dark, colour in ((False, LIGHT), (True, DARK)):
        premultiplied = alpha[..., None] * np.array([*colour, 255])
        truth = TruthPicture(camera=own, on_black=np.rint(premultiplied).astype(np.uint8))
        camera = resized(own, width=150, height=130)
        shown = fitted(truth, camera, ViewState(left="", dark=dark).background).astype(int)
        assert shown.shape == (130, 150, 3) and np.abs(shown - np.array(colour)).max() <= 3
        assert np.abs(fitted(truth, camera, ViewState(left="", dark=not dark).background) - shown).max() > 100


def before_a_camera(side: int) -> Camera:
    """It looks along z at the square from 0 to 1, at depth 1, which fills the picture."""
    K = np.array([[side, 0, 0], [0, side, 0], [0, 0, 1.0]])
    return Camera(name="flat", width=side, height=side, K=K, viewmat=np.eye(4))


def grid(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A square of twice so many triangles a row: vertices and faces."""
    y, x = np.mgrid[: cells + 1, : cells + 1] / cells
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, below = corner + 1, corner + cells + 1
    faces = np.concatenate([np.stack([corner, right, below], 1), np.stack([right, below + 1, below], 1)])
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1), faces


def lines(cells: int, side: int) -> np.ndarray:
    """How opaque the outlines of a grid are drawn, `[h, w]`."""
    white = np.full((side, side, 3), 255, dtype=np.uint8)
    drawn = with_mesh(white, *grid(cells), before_a_camera(side))
    return (255 - drawn[..., 0].astype(float)) / (255 - MESH[0])


def test_outlines_of_triangles_are_a_pixel_wide_and_soft() -> None:
    opaque = lines(4, 160)
    np.testing.assert_allclose(opaque[70, 36:44], [0, 0, 0, 0.5, 0.5, 0, 0, 0], atol=0.02)  # Straight down at x = 40.
    diagonal = opaque[70, 45:53]
    assert np.isclose(diagonal.sum(), 2**0.5, atol=0.2) and ((diagonal > 0.2) & (diagonal < 0.8)).sum() == 2
    assert (opaque < 0.01).mean() > 0.8


def test_outlines_of_triangles_smaller_than_pixels_are_no_speckle() -> None:
    for cells in (90, 170, 333):
        opaque = lines(cells, 160)[8:-8, 8:-8]
        assert opaque.std() < 0.12 and opaque.max() < 0.5, cells


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
    truth = alpha * image[..., :3] + (1 - alpha) * np.array(LIGHT)
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


def test_mesh_and_skeleton_lie_where_the_avatar_is(renderer: ViewRenderer, plain: ViewState) -> None:
    bare = drawn(renderer, plain, 240)
    inside = np.abs(bare - np.array(LIGHT)).max(axis=-1) > 30
    with_mesh = drawn(renderer, replace(plain, mesh=True), 240)
    changed = np.abs(with_mesh - bare).max(axis=-1) > 40
    assert 0.02 < changed[inside].mean() < 0.6 and changed[~inside].mean() < 0.02
    strongest = with_mesh[changed][np.abs(with_mesh[changed] - np.array(MESH)).sum(axis=-1).argmin()]
    assert np.abs(strongest - np.array(MESH)).max() < 30
    state = replace(plain, skeleton=True, turned=((1, (20.0, 0.0, 0.0)),))
    skeleton = drawn(renderer, state, 240)
    camera = renderer.camera(state, width=240, height=240)
    positions = renderer.joint_positions(renderer.pose(state))
    for (x, y), colour in zip(camera.project(positions)[0], (JOINT, TURNED_JOINT), strict=True):
        np.testing.assert_array_equal(skeleton[round(y - 0.5), round(x - 0.5)], colour)


def test_a_motion_begins_anew_or_ends_as_loop_says() -> None:
    state = ViewState(left="", step=3)
    assert state.advanced(3, 5).step == 1 and state.advanced(3, 5).playing
    once = replace(state, loop=False)
    assert once.advanced(3, 5).step == 4 and not once.advanced(3, 5).playing
    assert once.advanced(-7, 5).step == 0


def test_a_joint_turns_about_the_axes_that_its_sliders_name() -> None:
    skeleton, motion = tube_skeleton(), tube_motion(6)
    end = skeleton.names.index("bend")
    for number, axis in enumerate("xzy"):
        angles = tuple(30.0 if i == number else 0.0 for i in range(3))
        turned = with_angles(motion, {end: angles})
        assert angles_of(turned, 3, end) == pytest.approx(angles)
        frames = bone_frames(skeleton, turned.dofs)
        local = np.swapaxes(frames[:, skeleton.parents[end], :3, :3], 1, 2) @ frames[:, end, :3, :3]
        wanted = rotvec_to_rotmat(np.deg2rad(30) * np.eye(3)["xyz".index(axis)])
        np.testing.assert_allclose(local, np.broadcast_to(wanted, local.shape), atol=1e-9)
    np.testing.assert_array_equal(turned.dofs[:, :6], motion.dofs[:, :6], "the other joints go on moving")
