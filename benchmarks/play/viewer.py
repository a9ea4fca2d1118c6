"""One browser: what it looks at, when its next picture is due, and how large that may be."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import viser

from benchmarks.play import pace
from benchmarks.play.cameras import STEPS_PER_SECOND
from benchmarks.play.motions import Act
from benchmarks.play.picture import Painter, Painting
from benchmarks.play.state import SPIRAL, ViewState

Change = Callable[[ViewState], ViewState]
NEVER = float("inf")


class Viewer:
    """What it looks at, and when it is drawn. Changed from the server's threads, drawn from one other."""

    def __init__(
        self, client: viser.ClientHandle, acts: Sequence[Act], state: ViewState, wake: Callable[[], None]
    ) -> None:
        self.client, self.acts, self._wake = client, acts, wake
        self.pace = pace.Pace()
        self.served = 0.0  # when its last picture was sent
        self.show: Callable[[ViewState, Painting | None, str], None] = lambda state, drawn, words: None
        self._state, self._lock = state, threading.Lock()
        self._dirty, self._sharp = True, False
        self._touched = self._advanced = time.perf_counter()
        self._owed = 0.0  # frames of the motion that have not been shown yet, a fraction
        self._sent: deque[float] = deque(maxlen=30)

    @property
    def state(self) -> ViewState:
        """What it looks at now."""
        return self._state

    def change(self, change: Change) -> ViewState:
        """Replace the state; the next picture shows it, and what came between is never drawn."""
        with self._lock:
            self._state = change(self._state)
            self._dirty, self._sharp, self._touched = True, False, time.perf_counter()
        self._wake()
        return self._state

    def redraw(self) -> None:
        """Something else than the state changed: a truth was rendered."""
        self.change(lambda state: state)

    def due(self) -> float:
        """When the next picture is wanted, on `time.perf_counter`'s clock."""
        if self._state.eye is None:
            return NEVER
        if self._dirty or self._moves_by_itself:
            return self.served + (pace.FASTEST if self._dirty or self._state.camera == SPIRAL else self._frame_seconds)
        return NEVER if self._sharp else self._touched + pace.STILL_AFTER

    @property
    def _moves_by_itself(self) -> bool:
        return self._state.playing or self._state.camera == SPIRAL

    @property
    def _frame_seconds(self) -> float:
        return 1 / (self.acts[self._state.act].motion.fps * self._state.speed)

    def draw(self, painter: Painter, *, viewers: int) -> None:
        """Draw and send the picture of now. Whatever goes wrong is shown in the page."""
        start = time.perf_counter()
        state = self._advance(start)
        assert state.eye is not None
        moving = self._dirty or self._moves_by_itself
        with self._lock:
            self._dirty = False
        width, height = self.pace.size(width=state.eye.width, height=state.eye.height, sharp=not moving)
        resting = start - self._touched > pace.STILL_AFTER
        try:
            drawn = painter.draw(state, width=width, height=height, careful=not moving or (resting and viewers == 1))
        except Exception as error:  # A broken avatar, a pose it does not know: the player lives on.
            self.served, self._sharp = time.perf_counter(), True
            self._stop()
            with gone_is_fine(self.client):
                self.show(state, None, f"{type(error).__name__}: {error}")
            return
        quality = pace.MOVING_QUALITY if moving else pace.STILL_QUALITY
        with gone_is_fine(self.client):
            self.client.scene.set_background_image(drawn.pixels, format="jpeg", jpeg_quality=quality)
        self.served = time.perf_counter()
        ms = 1000 * (self.served - start)
        if moving:
            fps = 1 / self._frame_seconds if state.playing and resting and state.camera != SPIRAL else None
            self.pace.learn(drawn=width * height, ms=ms, allowed_ms=pace.allowed_ms(playing_fps=fps, viewers=viewers))
        else:
            self._sharp = not self._dirty
        self._sent.append(self.served)
        with gone_is_fine(self.client):
            self.show(state, drawn, self._words(drawn, ms, moving=moving))

    def _advance(self, now: float) -> ViewState:
        """Let the motion and the spiral go on by the time that has passed."""
        elapsed, self._advanced = min(now - self._advanced, 0.5), now
        with self._lock:
            state = self._state
            if state.camera == SPIRAL:
                state = replace(state, angle=state.angle + STEPS_PER_SECOND * elapsed)
            if state.playing:
                self._owed += elapsed / self._frame_seconds
                steps = int(self._owed + 0.25)  # The timer is a little early as often as late.
                self._owed -= steps
                state = state.stepped(steps, len(self.acts[state.act])) if steps else state
            self._state = state
        return state

    def _stop(self) -> None:
        with self._lock:
            self._state = replace(self._state, playing=False)

    def _words(self, drawn: Painting, ms: float, *, moving: bool) -> str:
        height, width = drawn.pixels.shape[:2]
        times = [t for t in self._sent if self.served - t < 1.5]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 2 else 0.0
        stages = " · ".join(
            f"{name.replace('stg', 'Stg.')} {value:.0f}" for name, value in sorted(drawn.stage_ms.items())
        )
        speed = f"{rate:.0f} pictures a second, " if moving and rate >= 2 else ""
        return f"{speed}{width} x {height}, {ms:.0f} ms" + (f" ({stages})" if stages else "")


@contextmanager
def gone_is_fine(client: viser.ClientHandle) -> Iterator[None]:
    """A browser may close while something is written to it; viser warns of that, which is for mistakes."""
    with client._websock_connection.get_message_buffer().sanctioned_dead_writes():
        yield


class Stream:
    """The one thread that draws: always for the viewer who has waited longest. The latest state wins."""

    def __init__(self, painter: Painter) -> None:
        self.painter = painter
        self._viewers: list[Viewer] = []
        self._condition = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="drawing", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._thread.start()

    def stop(self) -> None:
        """Finish the picture under way and end the thread."""
        with self._condition:
            self._ending = True
            self._condition.notify()
        self._thread.join()

    def add(self, viewer: Viewer) -> None:
        """Draw for one more."""
        with self._condition:
            self._viewers.append(viewer)
            self._condition.notify()

    def remove(self, viewer: Viewer) -> None:
        """Draw for it no more."""
        with self._condition:
            if viewer in self._viewers:
                self._viewers.remove(viewer)

    def wake(self) -> None:
        """Something changed."""
        with self._condition:
            self._condition.notify()

    def _run(self) -> None:
        while (next_one := self._wait()) is not None:
            viewer, viewers = next_one
            viewer.draw(self.painter, viewers=viewers)

    def _wait(self) -> tuple[Viewer, int] | None:
        """The next viewer and how many are being drawn for; None at the end."""
        with self._condition:
            while not self._ending:
                now = time.perf_counter()
                due = [viewer for viewer in self._viewers if viewer.due() <= now]
                if due:
                    busy = [viewer for viewer in self._viewers if viewer.due() < now + 0.2]
                    return min(due, key=lambda viewer: viewer.served), len(busy)
                soonest = min((viewer.due() for viewer in self._viewers), default=NEVER)
                self._condition.wait(None if soonest == NEVER else max(soonest - now, 0.0005))
        return None
