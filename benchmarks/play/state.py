"""What one viewer looks at: plain data, replaced as a whole whenever something changes."""

from dataclasses import dataclass, field, replace

import numpy as np

from ash.capture.dataset import Camera
from benchmarks.play.joints import Angles

NOTHING, TRUTH = "nothing", "the truth"
NO_ERROR, ABSOLUTE, FLIP = "no", "absolute", "FLIP"
FREE, SPIRAL = "free", "spiral"


@dataclass(frozen=True, kw_only=True, slots=True)
class Eye:
    """Where a viewer's camera is, and how large the picture is on their screen."""

    viewmat: np.ndarray  # [4, 4] world to camera, OpenCV axes
    fov: float  # radians, from bottom to top
    width: int  # pixels
    height: int

    @property
    def position(self) -> np.ndarray:
        """Optical centre, `[3]` metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def camera(self, *, width: int, height: int) -> Camera:
        """The same view in other pixels of the same shape."""
        focal = height / 2 / np.tan(self.fov / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        return Camera(name=FREE, width=width, height=height, K=K, viewmat=self.viewmat)


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewState:
    """Everything that decides a viewer's picture."""

    act: int = 0
    step: int = 0  # of the act
    playing: bool = True
    speed: float = 1.0
    loop: bool = True
    left: str  # an avatar
    right: str = NOTHING  # nothing, the truth, or another avatar
    divider: float = 0.5  # share of the width that is the left one's
    error: str = NO_ERROR
    mesh: bool = False
    skeleton: bool = False
    ellipsoids: bool = False
    held: tuple[tuple[int, Angles], ...] = ()  # joints that the viewer turned, and their angles
    dark: bool = False
    camera: str = FREE  # or spiral, or one of the capture's
    angle: float = 0.0  # steps along the spiral
    eye: Eye | None = field(default=None, compare=False)  # None until the browser has told

    def with_held(self, joint: int, angles: Angles) -> "ViewState":
        """With one joint held at angles, in all frames."""
        return replace(self, held=tuple(sorted((dict(self.held) | {joint: angles}).items())))

    def without_held(self, joint: int | None) -> "ViewState":
        """With one joint as the motion has it again; None: with all."""
        return replace(self, held=tuple(each for each in self.held if joint is not None and each[0] != joint))

    def stepped(self, steps: int, length: int) -> "ViewState":
        """So many frames further; at the ends, around again or stopped, as `loop` says."""
        wanted = self.step + steps
        if self.loop:
            return replace(self, step=wanted % length)
        return replace(self, step=min(max(wanted, 0), length - 1), playing=self.playing and 0 <= wanted < length - 1)
