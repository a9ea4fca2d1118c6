from dataclasses import replace

import pytest
from helpers.captures import write_tube_capture

from ash.capture.formats import load_capture
from ash.capture.manifest import Split
from benchmarks.cell.evaluation import evaluated_views, playback
from benchmarks.cell.schema import View


@pytest.fixture(scope="module")
def capture(shared):
    return load_capture(shared("tube_capture", write_tube_capture))


def test_near_and_far_motion_is_scored_where_a_capture_has_it_and_changes_nothing_else(capture):
    before = evaluated_views(capture)
    assert {view.split for view in before} == {"train_view", "novel_view", "novel_pose"}
    near, far = Split(cameras=("cam0",), frames=(4,)), Split(cameras=("cam0", "cam1"), frames=tuple(range(100, 150)))
    views = evaluated_views(replace(capture, splits=capture.splits | {"near_pose": near, "far_pose": far}))
    assert [view for view in views if view.split not in ("near_pose", "far_pose")] == list(before)
    near_view = View(split="near_pose", camera="cam0", frame=4)
    assert [view for view in views if view.split == "near_pose"] == [near_view]
    frames = [view.frame for view in views if view.split == "far_pose" and view.camera == "cam1"]
    assert len(frames) == 24 and (frames[0], frames[-1]) == (100, 149)
    assert playback(before)[0].split == "novel_pose" and playback(views)[0] == near_view
    assert sorted(playback(views), key=str) == sorted(views, key=str)


def test_training_views_are_pairs_that_have_an_image(capture):
    train = capture.splits["train"]
    parts = tuple((train.cameras[frame % 2],) for frame in train.frames)
    rotating = replace(train, cameras=train.cameras[:2], parts=parts)
    views = evaluated_views(replace(capture, splits=capture.splits | {"train": rotating}))
    seen = {(view.camera, view.frame) for view in views if view.split == "train_view"}
    assert seen == set(rotating.views)
