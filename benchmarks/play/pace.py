"""How many pixels a picture may have: few enough to keep motion smooth, all of them for a viewer who stands still."""

import math

SMOOTH_MS = 27.0  # per picture while a viewer moves: above thirty a second, with what the browser needs
PLAYING_SHARE = 0.5  # of the time between two frames of the motion that drawing may take
LEAST_PIXELS = 144 * 144
MOST_PIXELS = 1_200_000
STILL_AFTER = 0.15  # seconds without a change; then the picture becomes sharp
FASTEST = 1 / 32  # seconds between two pictures for one viewer
MOVING_QUALITY, STILL_QUALITY = 45, 80  # of JPEG


class Pace:
    """What drawing cost so far, of one viewer. Sizes change by small steps: a single slow picture does not show."""

    def __init__(self) -> None:
        self.pixels = 384.0 * 384.0

    def size(self, *, width: int, height: int, sharp: bool) -> tuple[int, int]:
        """Width and height for a screen of that size."""
        wanted = min(width * height, MOST_PIXELS if sharp else self.pixels)
        scale = math.sqrt(wanted / (width * height))
        return max(2, round(width * scale)), max(2, round(height * scale))

    def learn(self, *, drawn: int, ms: float, allowed_ms: float) -> None:
        """A picture of so many pixels took so long, and might have taken so much."""
        wanted = drawn * min(1.25, max(0.5, allowed_ms / ms))
        self.pixels = min(max(wanted, LEAST_PIXELS), MOST_PIXELS)


def allowed_ms(*, playing_fps: float | None, viewers: int) -> float:
    """Milliseconds that a picture may take, while so many viewers are being drawn for."""
    alone = SMOOTH_MS if playing_fps is None else max(SMOOTH_MS, PLAYING_SHARE * 1000 / playing_fps)
    return max(8.0, alone / viewers)
