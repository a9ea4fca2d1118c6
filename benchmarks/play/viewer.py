"""One browser: when its next picture is due, and how many pixels it may have."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import viser

from benchmarks.play.motions import MotionClip
from benchmarks.play.rendering import RenderedView, ViewRenderer, ViewState

SMOOTH_MS = 27.0  # per picture while a viewer moves: above thirty a second, with what the browser needs
PLAYING_SHARE = 0.5  # of the time between two frames of the motion that drawing may take
MIN_PIXELS, MAX_PIXELS = 144 * 144, 1_200_000
STILL_SECONDS = 0.15  # without a change; then the picture becomes sharp
MIN_INTERVAL = 1 / 32  # seconds between two pictures for one viewer
MOVING_QUALITY, STILL_QUALITY = 45, 80  # of JPEG
NEVER = float("inf")


class Viewer:
    """What a browser looks at, and when it is drawn. Changed from the server's threads, drawn from one other.

    While something moves, a picture has as many pixels as can be drawn in time; once all stands still, it is sharp.
    """

    def __init__(
        self, client: viser.ClientHandle, clips: Sequence[MotionClip], state: ViewState, wake: Callable[[], None]
    ) -> None:
        self.client, self._clips, self._wake = client, clips, wake
        self.served = 0.0  # when its last picture was sent
        self.show: Callable[[ViewState, RenderedView | None, str], None] = lambda state, drawn, message: None
        self._pixels = 384.0 * 384.0  # of a picture while something moves
        self._state, self._lock = state, threading.Lock()
        self._dirty, self._sharp = True, False
        self._changed = self._advanced = time.perf_counter()
        self._owed = 0.0  # frames of the motion that are not shown yet, a fraction

    @property
    def state(self) -> ViewState:
        """What it looks at now."""
        return self._state

    def change(self, change: Callable[[ViewState], ViewState]) -> ViewState:
        """Replace the state; the next picture shows it, and states in between are never drawn."""
        with self._lock:
            self._state = change(self._state)
            self._dirty, self._sharp, self._changed = True, False, time.perf_counter()
        self._wake()
        return self._state

    def due(self) -> float:
        """When the next picture is wanted, on `time.perf_counter`'s clock."""
        if self._state.viewpoint is None:
            return NEVER
        if self._dirty:
            return self.served + MIN_INTERVAL
        if self._state.playing:
            return self.served + self._frame_seconds
        return NEVER if self._sharp else self._changed + STILL_SECONDS

    @property
    def _frame_seconds(self) -> float:
        return 1 / (self._clips[self._state.clip].motion.fps * self._state.speed)

    def draw(self, renderer: ViewRenderer, *, viewers: int) -> None:
        """Draw and send the current picture. An exception is shown in the page."""
        start = time.perf_counter()
        state = self._advance(start)
        assert state.viewpoint is not None
        with self._lock:
            moving, self._dirty = self._dirty or state.playing, False
        resting = start - self._changed > STILL_SECONDS  # Apart from the motion, if that is played.
        window = state.viewpoint
        scale = min(1.0, math.sqrt((self._pixels if moving else MAX_PIXELS) / (window.width * window.height)))
        width, height = max(2, round(window.width * scale)), max(2, round(window.height * scale))
        with_scores = not moving or (resting and viewers == 1)
        try:
            drawn = renderer.render(state, width=width, height=height, with_scores=with_scores)
        except Exception as error:  # A broken avatar, a pose that it does not know: the player goes on.
            self.served, self._sharp = time.perf_counter(), True
            with self._lock:
                self._state = replace(self._state, playing=False)
            with may_be_closed(self.client):
                self.show(state, None, f"{type(error).__name__}: {error}")
            return
        quality = MOVING_QUALITY if moving else STILL_QUALITY
        with may_be_closed(self.client):
            self.client.scene.set_background_image(drawn.pixels, format="jpeg", jpeg_quality=quality)
        self.served = time.perf_counter()
        ms = 1000 * (self.served - start)
        if moving:
            alone = (
                max(SMOOTH_MS, PLAYING_SHARE * 1000 * self._frame_seconds) if state.playing and resting else SMOOTH_MS
            )
            allowed_ms = max(8.0, alone / viewers)
            # By small steps, so that a single slow picture does not show.
            pixels = width * height * min(1.25, max(0.5, allowed_ms / ms))
            self._pixels = min(max(pixels, MIN_PIXELS), MAX_PIXELS)
        else:
            self._sharp = not self._dirty
        with may_be_closed(self.client):
            self.show(state, drawn, f"{width} x {height}, {ms:.0f} ms")

    def _advance(self, now: float) -> ViewState:
        """Advance the motion by the time that has passed."""
        elapsed, self._advanced = min(now - self._advanced, 0.5), now
        with self._lock:
            if self._state.playing:
                self._owed += elapsed / self._frame_seconds
                steps = int(self._owed + 0.25)  # The timer is a little early as often as late.
                self._owed -= steps
                step = (self._state.step + steps) % len(self._clips[self._state.clip])
                self._state = replace(self._state, step=step)
            return self._state


@contextmanager
def may_be_closed(client: viser.ClientHandle) -> Iterator[None]:
    """A browser may close while something is written to it; viser warns of that."""
    with client._websock_connection.get_message_buffer().sanctioned_dead_writes():
        yield


class DrawingThread:
    """The one thread that draws, always for the viewer who has waited longest; of its states the latest."""

    def __init__(self, renderer: ViewRenderer) -> None:
        self._renderer = renderer
        self.viewers: list[Viewer] = []
        self._changed, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="drawing", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Something changed."""
        self._changed.set()

    def stop(self) -> None:
        """Finish the picture under way and end the thread."""
        self._ending.set()
        self.wake()
        self._thread.join()

    def _run(self) -> None:
        while not self._ending.is_set():
            now, viewers = time.perf_counter(), list(self.viewers)
            due = [viewer for viewer in viewers if viewer.due() <= now]
            if due:
                busy = sum(viewer.due() < now + 0.2 for viewer in viewers)
                min(due, key=lambda viewer: viewer.served).draw(self._renderer, viewers=busy)
                continue
            soonest = min((viewer.due() for viewer in viewers), default=NEVER)
            self._changed.wait(None if soonest == NEVER else max(soonest - now, 0.0005))
            self._changed.clear()
