"""Which images a capture has: its splits, and what is wanted of every frame."""

from dataclasses import dataclass

import numpy as np

from ash.capture.dataset import Split
from synth.camera.rig import held_out, rotation
from synth.camera.rig import names as camera_names
from synth.scene import Clip, Scene


@dataclass(frozen=True, kw_only=True, slots=True)
class WantedView:
    """One image to make."""

    camera: str
    frame: int


def splits(scene: Scene) -> dict[str, Split]:
    """Training views; novel views of some training frames; novel poses (near, new, far) from the novel-view cameras."""
    names = camera_names(scene.rig)
    apart = tuple(names[k] for k in held_out(scene.rig))
    training = sum(clip.count for clip in scene.train)
    tested = training + sum(clip.count for clip in scene.test)
    nearby = tested + sum(clip.count for clip in scene.near)
    held_out_frames = {
        "novel_view": tuple(range(scene.novel_view_stride // 2, training, scene.novel_view_stride)),
        "near_pose": _shown(scene.near, first=tested),
        "novel_pose": _shown(scene.test, first=training),
        "far_pose": _shown(scene.far, first=nearby),
    }
    parts = _parts(scene, training)
    used = {name for part in parts for name in part} or set(names) - set(apart)  # Few frames do not come to all.
    train = Split(cameras=tuple(n for n in names if n in used), frames=tuple(range(training)), parts=parts)
    return {"train": train} | {
        name: Split(cameras=apart, frames=frames) for name, frames in held_out_frames.items() if frames
    }


def _shown(clips: tuple[Clip, ...], *, first: int) -> tuple[int, ...]:
    """The frames of clips that have images, where the first clip begins at frame `first`."""
    starts = np.cumsum([first, *(clip.count for clip in clips)])[:-1]
    return tuple(int(start) + frame for start, clip in zip(starts, clips, strict=True) for frame in clip.shown)


def _parts(scene: Scene, frames: int) -> tuple[tuple[str, ...], ...]:
    """The names of the cameras that see each training frame; none where all do."""
    if not 0 < scene.rig.cameras_per_frame < scene.rig.cameras - scene.rig.held_out:
        return ()
    names = camera_names(scene.rig)
    return tuple(tuple(names[k] for k in sorted(part)) for part in rotation(scene.rig, frames))


def wanted_views(scene: Scene) -> list[WantedView]:
    """Every image of the capture, frame by frame."""
    pairs = {pair for split in splits(scene).values() for pair in split.views}
    return [
        WantedView(camera=camera, frame=frame) for camera, frame in sorted(pairs, key=lambda pair: (pair[1], pair[0]))
    ]


def is_scanned(scene: Scene, frame: int) -> bool:
    """Whether a frame is to have a scan: training frames, of a studio that has a scanner."""
    return scene.scanner.rms_mm > 0 and frame < sum(clip.frames for clip in scene.train)


def by_frame(views: list[WantedView]) -> list[list[WantedView]]:
    """The views of each frame."""
    frames: dict[int, list[WantedView]] = {}
    for view in views:
        frames.setdefault(view.frame, []).append(view)
    return list(frames.values())
