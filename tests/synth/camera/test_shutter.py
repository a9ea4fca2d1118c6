from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import small_scene
from helpers.squares import camera, squares, studio

from ash.files import InputError
from synth.camera.shutter import POSES, shutter_poses
from synth.presets import scene
from synth.scene import Rig

VIEW = replace(camera(160, 96, fx=150.0, fy=150.0))
STEP = 0.24  # metres between frames: 12 pixels at 3 m


def _moving(frames: int = 5) -> np.ndarray:
    return np.stack([squares(np.array([[STEP * (k - 2), 0.0, 0.0]]), 0.5) for k in range(frames)])


def test_a_closed_shutter_shows_the_frame_itself():
    frames = _moving()
    poses = shutter_poses(frames, 2, shutter=0.0)
    assert len(poses) == 1 and poses[0] is not None
    np.testing.assert_array_equal(poses[0], frames[2])
    assert scene("loose", size="quick").rig.shutter == 0


@pytest.mark.parametrize("at", [0, 2, 4])
def test_uniform_motion_is_followed_exactly_also_at_the_ends(at: int):
    frames = _moving()
    poses = shutter_poses(frames, at, shutter=0.5)
    expected = STEP * (at - 2 + 0.5 * ((np.arange(POSES) + 0.5) / POSES - 0.5))
    np.testing.assert_allclose([pose[:, 0].mean() for pose in poses], expected, atol=1e-12)


def test_curved_motion_passes_through_the_frames():
    angle = 0.4 * np.arange(5)
    frames = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)[:, None]
    poses = shutter_poses(frames, 2, shutter=1.0, count=101)
    np.testing.assert_allclose(poses[50], frames[2], atol=1e-12)
    radius = np.linalg.norm(np.stack(poses)[:, 0], axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=2e-3)  # A chord would come 20 times as near.


@pytest.mark.parametrize("shutter", [0.25, 0.5, 1.0])
def test_a_blurred_edge_is_as_wide_as_the_way_the_edge_goes(shutter: float):
    """Vertical edges move by 12 pixels a frame: their ramp is 12 times the shutter wide, horizontal ones stay sharp."""
    frames = _moving()
    poses = shutter_poses(frames, 2, shutter=shutter)
    still, moved = (
        studio(1).shoot(frames[2], [VIEW], samples=64, seeds=[3], during=during)[0] for during in (None, poses)
    )
    np.testing.assert_array_equal(still.triangle, moved.triangle)  # Truth is that of the frame.
    middle = slice(44, 52)
    assert _ramp(still.rgba[middle, :80, 3].mean(axis=0)) < 1.1
    expected = 12.0 * shutter
    assert abs(_ramp(moved.rgba[middle, :80, 3].mean(axis=0)) - expected) < 0.12 * expected + 0.5
    assert _ramp(moved.rgba[:48, 70:90, 3].mean(axis=1)) < 1.1
    total = [picture.rgba[..., 3].sum() / 255 for picture in (still, moved)]
    assert total[0] == pytest.approx(total[1], rel=2e-3)


def _ramp(alpha: np.ndarray) -> float:
    """Width in pixels of a straight ramp from 0 to 255 with the variance of this one's slope.

    A sharp edge anywhere in a pixel has a variance of 1/6 on average.
    """
    slope = np.diff(alpha.astype(float)) / 255
    place = np.arange(len(slope))
    mean = (slope * place).sum()
    return float(np.sqrt(max(12 * ((slope * (place - mean) ** 2).sum() - 1 / 6), 0)))


def test_shutters_are_checked_and_change_the_scene():
    with pytest.raises(InputError, match="shutter"):
        Rig(shutter=1.5)
    open_, closed = (replace(small_scene(), rig=replace(small_scene().rig, shutter=s)) for s in (0.5, 0.0))
    assert open_.identity != closed.identity == small_scene().identity
