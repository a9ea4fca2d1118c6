"""Cameras that see the training frames by turns."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from ash.files import InputError
from synth import presets
from synth.camera.rig import held_out, place, rotation
from synth.scene import Rig
from synth.views import splits


@pytest.mark.parametrize(
    "rig", [presets.ROTATING, Rig(kind="ring", cameras=20, held_out=4, cameras_per_frame=8), Rig(cameras_per_frame=1)]
)
def test_every_camera_is_used_once_in_every_round(rig):
    training = set(range(rig.cameras)) - set(held_out(rig))
    length = len(training) // rig.cameras_per_frame
    parts = rotation(rig, 3 * length + 1)
    for first in range(0, 3 * length, length):
        used = [camera for part in parts[first : first + length] for camera in part]
        assert sorted(used) == sorted(training)
    assert len(parts[-1]) == rig.cameras_per_frame


def test_the_cameras_of_a_frame_stand_all_around():
    rig = presets.ROTATING
    x, _, z = (place(rig) - place(rig).mean(axis=0)).T
    for part in rotation(rig, 40):
        around = np.sort(np.rad2deg(np.arctan2(x, z))[part])
        gaps = np.diff([*around, around[0] + 360])
        assert gaps.max() < 175, "somebody's back is seen by nobody"


def test_cameras_meet_in_other_parts_from_round_to_round():
    rig = presets.ROTATING
    parts = [frozenset(part) for part in rotation(rig, 25)]
    assert len(set(parts)) == 25
    pairs = Counter(frozenset((a, b)) for part in parts for a in part for b in part if a < b)
    assert max(pairs.values()) <= 6  # of 25


@pytest.mark.parametrize(("cameras", "part"), [(16, 5), (24, 7), (9, 4)])
def test_where_sectors_differ_by_a_camera_all_are_used_nearly_alike(cameras, part):
    rig = Rig(cameras=cameras, cameras_per_frame=part)
    training, frames = set(range(cameras)) - set(held_out(rig)), 60
    parts = rotation(rig, frames)
    assert all(len(set(seen)) == part for seen in parts)
    uses = Counter(camera for seen in parts for camera in seen)
    assert set(uses) == training
    assert max(uses.values()) <= 1.5 * frames * part / len(training)


def test_a_part_of_all_cameras_or_more_is_all_of_them():
    scene = replace(presets.scene("loose", size="quick"), rig=Rig(cameras=8, held_out=4, cameras_per_frame=4))
    assert splits(scene)["train"].parts == ()
    with pytest.raises(InputError, match="expected 1 or more, or 0 for all"):
        Rig(cameras_per_frame=-1)
