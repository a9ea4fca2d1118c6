"""Splits whose frames are seen by a part of the cameras."""

import numpy as np
import pytest
from helpers.captures import write_tube_capture

from ash import presets
from ash.capture.dataset import fewer_views
from ash.capture.formats import load_capture
from ash.capture.manifest import Manifest, Split, read_manifest
from ash.files import InputError, read_json, write_json
from ash.training.batches import sampled
from ash.training.images import load_training_images, reserved_views

WHOLE = Split(cameras=("a", "b"), frames=(3, 4))
PARTS = Split(cameras=("a", "b", "c"), frames=(3, 4, 7), parts=(("a", "c"), ("b",), ("b", "c")))


def test_a_frame_has_the_images_of_its_part():
    assert PARTS.views == [("a", 3), ("c", 3), ("b", 4), ("b", 7), ("c", 7)]
    assert (PARTS.count, PARTS.seeing(7)) == (5, ("b", "c"))
    assert WHOLE.views == [("a", 3), ("b", 3), ("a", 4), ("b", 4)]
    assert (WHOLE.count, WHOLE.seeing(4)) == (4, ("a", "b"))


def test_a_choice_keeps_what_was_seen_and_drops_what_nobody_saw():
    assert PARTS.only(cameras=["a", "c"]).views == [("a", 3), ("c", 3), ("c", 7)]
    assert PARTS.only(cameras=["a", "c"]).frames == (3, 7)
    assert PARTS.only(frames=[4]) == Split(cameras=("b",), frames=(4,), parts=(("b",),))
    assert WHOLE.only(cameras=["b"], frames=[4]) == Split(cameras=("b",), frames=(4,))
    with pytest.raises(InputError, match="none together"):
        PARTS.only(cameras=["a"], frames=[4])


def test_parts_survive_the_manifest_and_whole_splits_do_not_mention_them(tmp_path):
    made = Manifest(scene="tube", seed=0, splits={"train": PARTS, "far_pose": WHOLE}, files={})
    made.write(tmp_path)
    assert read_manifest(tmp_path) == made
    assert read_json(tmp_path / "manifest.json")["splits"]["far_pose"] == {"cameras": ["a", "b"], "frames": [3, 4]}


@pytest.mark.parametrize(
    ("parts", "complaint"),
    [
        ([["a"], ["b"]], "parts of 2 frames, expected 3"),
        ([["a", "c"], [], ["b"]], "in every part"),
        ([["a", "a"], ["b"], ["c"]], "in every part"),
        ([["a", "d"], ["b"], ["c"]], "in every part"),
        ([["a"], ["b"], ["b"]], "a camera stands in no part"),
    ],
)
def test_damaged_parts_are_refused(tmp_path, parts, complaint):
    Manifest(scene="tube", seed=0, splits={"train": PARTS}, files={}).write(tmp_path)
    told = read_json(tmp_path / "manifest.json")
    told["splits"]["train"]["parts"] = parts
    write_json(tmp_path / "manifest.json", told)
    with pytest.raises(InputError, match=complaint):
        read_manifest(tmp_path)


@pytest.fixture
def capture(tmp_path):
    """The tube's capture, as if two of its four cameras had seen each frame; the images that nobody took are gone."""
    whole = write_tube_capture(tmp_path / "tube")
    names = whole.splits["train"].cameras
    parts = [[names[frame % 2], names[2 + frame // 2]] for frame in whole.splits["train"].frames]
    told = read_json(whole.folder / "manifest.json")
    told["splits"]["train"]["parts"] = parts
    for frame, part in enumerate(parts):
        for name in set(names) - set(part):
            (whole.folder / f"frames/{name}/{frame:06d}.png").unlink()
            del told["files"][f"frames/{name}/{frame:06d}.png"]
    write_json(whole.folder / "manifest.json", told)
    return load_capture(whole.folder)


def test_training_sees_the_pairs_and_nothing_else(capture):
    images = load_training_images(capture)
    assert {(name, frame) for frame in images.frames for name in images.seeing(frame)} == set(
        capture.splits["train"].views
    )
    for step in range(20):
        drawn = sampled(images, presets.plus("ci").training, 0, step)
        assert set(drawn.views) <= set(capture.splits["train"].views) - set(images.reserved)


def test_fewer_cameras_use_their_own_pairs(capture):
    fewer = fewer_views(capture, cameras=0.5).splits["train"]
    assert len(fewer.cameras) == 2
    assert set(fewer.views) == {view for view in capture.splits["train"].views if view[0] in fewer.cameras}


def test_reserved_views_of_parts_leave_every_frame_a_camera():
    names = tuple(f"cam{i:02}" for i in range(20))
    parts = tuple(tuple(names[(frame + 5 * k) % 20] for k in range(4)) for frame in range(100))
    train = Split(cameras=names, frames=tuple(range(100)), parts=parts)
    for split, count in ((train, 24), (train.only(cameras=names[::2]), 24)):
        reserved = reserved_views(split)
        assert len(set(reserved)) == len(reserved) == count
        assert set(reserved) < set(split.views)
        left = [frame for name, frame in split.views if (name, frame) not in reserved]
        assert set(left) == set(split.frames)
        assert len({name for name, _ in reserved}) >= len(split.cameras) / 2
    assert np.ptp([frame for _, frame in reserved_views(train)]) > 80
    assert reserved_views(train.only(cameras=names[:1])) == ()
