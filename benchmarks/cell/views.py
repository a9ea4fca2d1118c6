"""Which images of a capture the protocol scores. Part of the protocol: other images of a split are a new version.

Captures from before motion was held out near and far lack these splits, and are scored as ever.
"""

from dataclasses import dataclass

import numpy as np

from ash.capture.dataset import Capture
from benchmarks.cell.metrics import IMAGE_SPLITS

TRAIN_VIEWS = 12
VIEW_FRAMES = 12
POSE_FRAMES = 24


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """One image to score."""

    split: str
    camera: str
    frame: int


def evaluated_views(capture: Capture) -> tuple[View, ...]:
    """The images that are scored, in a fixed order.

    - train_view: 12 training images, spread evenly over all.
    - novel_view: held-out cameras in at most 12 training frames, spread evenly.
    - novel_pose: held-out cameras in the first 24 test frames, which follow each other, so that flicker can be seen.
    - near_pose, far_pose: held-out cameras in at most 24 frames each, spread evenly over all clips.
    """
    pairs: dict[str, list[tuple[str, int]]] = {split: [] for split in IMAGE_SPLITS}
    train = capture.splits["train"].views
    pairs["train_view"] = [train[i] for i in spread(len(train), TRAIN_VIEWS)]
    if "novel_view" in capture.splits:
        split = capture.splits["novel_view"]
        frames = [split.frames[i] for i in spread(len(split.frames), VIEW_FRAMES)]
        pairs["novel_view"] = [(camera, frame) for camera in split.cameras for frame in frames]
    if "novel_pose" in capture.splits:
        split = capture.splits["novel_pose"]
        pairs["novel_pose"] = [(camera, frame) for camera in split.cameras for frame in split.frames[:POSE_FRAMES]]
    for name in ("near_pose", "far_pose"):
        if name in capture.splits:
            split = capture.splits[name]
            frames = [split.frames[i] for i in spread(len(split.frames), POSE_FRAMES)]
            pairs[name] = [(camera, frame) for camera in split.cameras for frame in frames]
    return tuple(View(split=s, camera=camera, frame=frame) for s in IMAGE_SPLITS for camera, frame in pairs[s])


def playback(views: tuple[View, ...]) -> list[View]:
    """The views in the order in which they are timed: first motion that is not training's, as near to it as there is.

    A method that does less in poses far from training's, because it trusts what it learned less there, is timed where
    it does all. Camera by camera, frames follow each other.
    """
    order = ("near_pose", "novel_pose", "far_pose", "novel_view", "train_view")
    return sorted(views, key=lambda view: order.index(view.split))


def spread(count: int, at_most: int) -> list[int]:
    """At most `at_most` different indices below `count`, evenly spread, ends included."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, at_most))})
