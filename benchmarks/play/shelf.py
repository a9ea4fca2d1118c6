"""Pictures of the truth that a player can show: the capture's own, and those that were rendered while it ran."""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from ash.capture.dataset import Camera, Capture
from benchmarks.cell import metrics
from benchmarks.play.cameras import apart
from benchmarks.play.film import capture_image
from benchmarks.play.motions import Act
from benchmarks.play.state import ViewState

KEPT = 64
SAME_PLACE_M = 1e-3
SAME_TURN = 1e-3  # radians


@dataclass(frozen=True, kw_only=True, slots=True)
class TruthPicture:
    """The truth of one pose, seen by one camera."""

    camera: Camera
    on_black: np.ndarray  # uint8 [h, w, 4]

    @property
    def key(self) -> str:
        """Different for different pixels."""
        return hashlib.sha256(self.on_black.tobytes()).hexdigest()


class TruthShelf:
    """Finds the truth of what a viewer looks at. Used from the drawing thread, filled from any."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self._rendered: OrderedDict[tuple, list[TruthPicture]] = OrderedDict()

    def put(self, act: Act, state: ViewState, picture: TruthPicture) -> None:
        """Keep a rendered picture of the pose that the state shows."""
        self._rendered.setdefault(_pose_key(act, state), []).append(picture)
        while len(self._rendered) > KEPT:
            self._rendered.popitem(last=False)

    def find(self, act: Act, state: ViewState) -> TruthPicture | None:
        """The truth of this pose as this camera sees it, if it is known."""
        frame = act.frames[state.step]
        own = self.capture.cameras.get(state.camera)
        if own is not None and not state.held:
            image = capture_image(self.capture, act, frame, own)
            if image is not None:
                return TruthPicture(camera=own, on_black=image)
        wanted = own.viewmat if own is not None else state.eye.viewmat if state.eye is not None else None
        for picture in reversed(self._rendered.get(_pose_key(act, state), [])):
            if wanted is not None and same_view(picture.camera.viewmat, wanted):
                return picture
        return None


def same_view(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two cameras `[4, 4]` stand and look alike, as far as a browser repeats what it was told."""
    moved, turned = apart(one, other)
    return moved < SAME_PLACE_M and turned < SAME_TURN


def truth_from(camera: Camera, straight: np.ndarray) -> TruthPicture:
    """A rendered picture, straight alpha, as the protocol compares it."""
    return TruthPicture(camera=camera, on_black=metrics.on_black(straight))


def _pose_key(act: Act, state: ViewState) -> tuple:
    return act.name, act.frames[state.step], state.held
