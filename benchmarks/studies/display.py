"""`ash-bench display`: how fast a trained avatar is drawn by its own display, and how well that picture agrees."""

from dataclasses import dataclass

import numpy as np

from ash.capture.dataset import Capture, Pose
from ash.capture.formats import load_capture
from ash.files import InputError
from ash.protocol import Displayed, Drawn, StageClock
from benchmarks.cell import metrics
from benchmarks.cell.cells import Cell
from benchmarks.cell.process import load_avatar
from benchmarks.cell.timing import TIMED_FRAMES, WARM_UP_FRAMES, time_frames
from benchmarks.cell.views import View, evaluated_views, playback


@dataclass(frozen=True, kw_only=True, slots=True)
class DisplayTiming:
    """A cell's avatar by both ways to draw it. Milliseconds are medians; PSNR is that of the least alike image."""

    title: str
    trained_ms: float
    trained_draw_ms: float  # Stg.4 alone
    display_ms: float
    display_draw_ms: float
    agreement_db: float  # foreground


def show(cell: Cell, *, trust: bool = False) -> DisplayTiming:
    """Time both ways over the test motion, and compare their images; in this process, so ours or trusted ones only.

    Raises:
        InputError: the method has no display of its own, or this machine cannot draw without a screen.
    """
    capture = load_capture(cell.capture_folder)
    with load_avatar(cell, capture, trust=trust) as (avatar, _):
        if not isinstance(avatar, Displayed):
            raise InputError(f"{cell.folder}: {cell.config.method} has no display of its own")
        display = avatar.open_display()
        try:
            views = playback(evaluated_views(capture))[: WARM_UP_FRAMES + TIMED_FRAMES]
            trained, shown = (time_frames(way, capture, views) for way in (avatar, display))
            agreement = min(_agreement(capture, view, avatar, display) for view in views)
        finally:
            display.close()
    return DisplayTiming(
        title=cell.config.title,
        trained_ms=float(np.median(trained.frame_ms)),
        trained_draw_ms=float(np.median(trained.stage_ms["stg4"])),
        display_ms=float(np.median(shown.frame_ms)),
        display_draw_ms=float(np.median(shown.stage_ms["stg4"])),
        agreement_db=agreement,
    )


def _agreement(capture: Capture, view: View, avatar: Drawn, display: Drawn) -> float:
    camera, motion = capture.cameras[view.camera], capture.motion
    images = [
        metrics.quantise(way.render(Pose(motion, view.frame), camera, clock=StageClock())) for way in (avatar, display)
    ]
    return metrics.psnr(images[1][..., :3], images[0][..., :3], metrics.foreground(images[0]))
