"""Which images a capture has: its splits, and what is wanted of every frame."""

from dataclasses import dataclass

from ash.capture.dataset import Split
from synth.camera.rig import held_out
from synth.camera.rig import names as camera_names
from synth.scene import Scene


@dataclass(frozen=True, kw_only=True, slots=True)
class WantedView:
    """One image to make."""

    camera: str
    frame: int


def splits(scene: Scene) -> dict[str, Split]:
    """Training views; held-out cameras on some training frames; held-out cameras on the test motion."""
    names = camera_names(scene.rig)
    apart = tuple(names[k] for k in held_out(scene.rig))
    training = sum(clip.frames for clip in scene.train)
    return {
        "train": Split(cameras=tuple(name for name in names if name not in apart), frames=tuple(range(training))),
        "novel_view": Split(
            cameras=apart, frames=tuple(range(scene.novel_view_stride // 2, training, scene.novel_view_stride))
        ),
        "novel_pose": Split(cameras=apart, frames=tuple(range(training, scene.frames))),
    }


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
