"""Novel poses: near, new and far."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.motion_files import amass_file

from ash.capture.novelty import novelty_deg
from ash.files import InputError
from synth import presets
from synth.cost import estimate
from synth.motion.clips import make_motion
from synth.person.mannequin import heads
from synth.posing import rotvec_to_rotmat
from synth.scene import Clip
from synth.skeleton import make_skeleton
from synth.views import splits, wanted_views

SKELETON = make_skeleton(heads())
# Soucie et al. 2011 (normal range of motion, adults) and the weight-bearing lunge for the ankle; degrees, rounded up.
PUBLISHED = {"shin": 145, "forearm": 155, "foot": 58, "spine": 45, "chest": 45, "neck": 50, "head": 50, "thigh": 130}


@pytest.mark.parametrize("subject", [0, 1, 2])
def test_far_is_farther_than_new_and_new_than_near(subject):
    scene = presets.scene("loose", size="quick", subject=subject)
    motion = make_motion(SKELETON, scene.clips, fps=scene.fps, seed=subject)
    parts = splits(scene)
    near, new, far = (
        novelty_deg(motion, train=parts["train"].frames, test=parts[name].frames)
        for name in ("near_pose", "novel_pose", "far_pose")
    )
    assert 1 < np.mean(near) < 0.6 * np.mean(new)
    assert np.mean(new) < np.mean(far) - 1
    assert np.max(far) > np.max(new) + 1
    assert novelty_deg(motion, train=parts["train"].frames, test=parts["novel_view"].frames) == [0.0] * 8


@pytest.mark.parametrize("name", ["arms_up", "deep_squat", "jump"])
@pytest.mark.parametrize("seed", range(4))
def test_far_motion_keeps_joints_in_published_ranges(name, seed):
    motion = make_motion(SKELETON, (Clip(generator=name, frames=13),), fps=12.0, seed=seed)
    angles = np.rad2deg(np.linalg.norm(motion.dofs[:, 3:].reshape(13, -1, 3), axis=-1)).max(axis=0)
    for joint, angle in zip(SKELETON.names, angles, strict=True):
        assert angle < PUBLISHED.get(joint.split("_")[0], 180), joint
    shin = rotvec_to_rotmat(motion.dofs[:, 3:].reshape(13, -1, 3)[:, SKELETON.names.index("shin_left")])
    assert (shin[:, 2, 1] > -0.1).all(), "a knee bends backwards"


def test_who_stands_does_not_move():
    still = make_motion(SKELETON, (Clip(generator="stand", frames=3),), fps=12.0, seed=0)
    np.testing.assert_allclose(still.dofs, still.dofs[[0, 0, 0]], atol=1e-12)


def test_quick_has_more_motion_for_less_rendering():
    scene = presets.scene("loose", size="quick")
    parts = splits(scene)
    train = parts["train"]
    assert len(train.frames) >= 100 and len(train.cameras) == 20 and estimate(scene).images <= 550
    used = [sum(name == camera for name, _ in train.views) for camera in train.cameras]
    assert max(used) - min(used) <= 1
    assert {len(train.seeing(frame)) for frame in train.frames} == {4}
    assert len(wanted_views(scene)) == sum(split.count for split in parts.values())


def test_only_some_frames_of_held_out_clips_have_images():
    scene = presets.scene("loose", size="quick")
    parts, first = splits(scene), 104
    new = tuple(first + 8 * clip + 4 * run + 3 for clip in range(5) for run in range(2))
    assert parts["novel_pose"].frames == new
    assert parts["near_pose"].frames == tuple(first + 40 + 5 * clip + frame for clip in range(4) for frame in (3, 4))
    far = tuple(first + 60 + 6 * clip + frame for clip in range(3) for frame in (2, 4))
    assert parts["far_pose"].frames == far and scene.frames == first + 78
    assert parts["near_pose"].cameras == parts["far_pose"].cameras == parts["novel_view"].cameras


@pytest.mark.parametrize("size", ["factor", "quick", "long", "table", "paper"])
@pytest.mark.parametrize("name", ["skinned", "tight", "loose"])
def test_test_motion_is_of_many_kinds_and_long(name: str, size: str):
    """New motion: five kinds that are not trained on, each spread over four seconds; views of all kinds trained on."""
    scene, trained = presets.scene(name, size=size), set()
    kinds = [clip.generator for clip in scene.test]
    assert len(set(kinds)) == len(kinds) >= 5 and not set(kinds) & {clip.generator for clip in scene.train}
    for clip in scene.test:
        first, last = clip.starts[0] + clip.shown[0], clip.starts[-1] + clip.shown[-1] - (clip.runs - 1) * clip.frames
        assert (last - first) / scene.fps >= 4
    ends = np.cumsum([clip.count for clip in scene.train])
    for frame in splits(scene)["novel_view"].frames:
        trained.add(scene.train[int(np.searchsorted(ends, frame, side="right"))].generator)
    assert trained == {clip.generator for clip in scene.train}
    assert len(splits(scene)["far_pose"].frames) >= 6


def test_size_paper_follows_the_paper():
    scene = presets.scene("loose", size="paper")
    parts = splits(scene)
    assert (scene.fps, len(parts["train"].frames)) == (25, 27_000)
    assert sum(clip.frames for clip in scene.test) == 7000 and len(parts["novel_pose"].frames) == 700
    assert set(np.diff(parts["novel_pose"].frames)) == {10}
    assert scene.rig.cameras == 120 and len(parts["novel_view"].cameras) == 4


def test_runs_are_parts_of_one_motion():
    runs = Clip(generator="dance", frames=4, runs=2, span=54, history=3)
    whole = make_motion(SKELETON, (Clip(generator="dance", frames=54),), fps=12.0, seed=3)
    parts = make_motion(SKELETON, (runs,), fps=12.0, seed=3)
    assert runs.starts == (0, 50) and runs.shown == (3, 7) and parts.sequence.tolist() == [0] * 4 + [1] * 4
    np.testing.assert_array_equal(parts.dofs, whole.dofs[[0, 1, 2, 3, 50, 51, 52, 53]])
    middle = Clip(generator="reach", frames=5, span=13, history=3)
    assert middle.starts == (4,) and middle.shown == (3, 4) and middle.count == 5


@pytest.mark.parametrize(
    "wrong",
    [
        {"runs": 2}, {"runs": 3, "span": 11}, {"history": 4}, {"stride": 0}, {"runs": 0}, {"span": 2},
        {"generator": "moonwalk"}, {"frames": 1}, {"frames": 10**9},
    ],
    ids=str,
)  # fmt: skip
def test_clips_that_cannot_be_are_refused(wrong: dict):
    with pytest.raises(InputError, match=r"expected|do not fit"):
        Clip(**{"generator": "dance", "frames": 4, **wrong})


def test_training_clips_have_images_of_all_frames():
    with pytest.raises(InputError, match="training clips"):
        scene = presets.scene("loose", size="ci")
        replace(scene, train=(Clip(generator="walk", frames=4, history=1),))


def test_motion_of_a_user_is_neither_near_nor_far(tmp_path: Path):
    path = amass_file(tmp_path / "walk.npz", mocap_framerate=np.array(12.0))
    scene = presets.scene("mannequin", size="ci")
    for changes in ({"train": path, "test": None}, {"train": None, "test": path}):
        moved = presets.with_motion(scene, SKELETON, **changes)
        assert set(splits(moved)) == {"train", "novel_view", "novel_pose"}


def test_a_scene_without_parts_and_kinds_is_called_as_before():
    still = presets.scene("still", size="ci").parameters
    assert not {"near", "far"} & set(still) and "part" not in still["rig"]
    assert {"near", "far"} < set(presets.scene("loose", size="quick").parameters)
