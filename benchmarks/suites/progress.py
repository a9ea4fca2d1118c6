"""Live progress: how much is done, what runs, how long it will still take."""

import io
import os
import sys
import time
from collections.abc import Sequence
from typing import TextIO


class Progress:
    """Counts finished pieces of work and tells the time left.

    On a terminal one line is kept up to date; elsewhere (a log, CI) each finished piece gets a line of its own.
    Times come from a monotonic clock: the wall clock may jump.
    """

    def __init__(
        self, what: str, total: int, *, expected_s: float, workers: int, stream: io.TextIOBase | None = None
    ) -> None:
        self.what, self.total, self.expected_s, self.workers = what, total, expected_s, max(1, workers)
        self.stream: TextIO | io.TextIOBase = stream or sys.stderr
        self.live = self.stream.isatty()
        self.finished = self.failed = 0
        self.start = time.monotonic()
        self._drawn = ""
        self._skipped = 0

    def finish(self, title: str, *, status: str = "done") -> None:
        """One piece is finished."""
        self.finished += 1
        self.failed += status != "done"
        if not self.live:
            note = "" if status == "done" else f": {status}"
            self.say(f"[{self.finished}/{self.total}] {title}{note} ({_left(self.seconds_left())} left)")
        elif status != "done":
            self.say(f"{title}: {status}")

    def advance(self, finished: int, total: int) -> None:
        """`finished` of `total` pieces are done, for work that counts for itself; a log hears of every tenth."""
        tenth = max(1, total // 10)
        news = finished // tenth != self.finished // tenth
        if self.total == 0 and finished < total:  # What was there before says nothing about the pace.
            self.start, self._skipped = time.monotonic(), finished
        self.finished, self.total = finished, total
        if self.live:
            self.tick()
        elif news and finished < total:
            self.say(f"{self.what} {finished}/{total} ({_left(self.seconds_left())} left)")

    def say(self, line: str) -> None:
        """Print a line of its own above the live line."""
        if self.live:
            self._draw("")
            line = f"\r{line}"
        self._print(f"{line}\n")

    def tick(self, *, running: Sequence[str] = ()) -> None:
        """Redraw the line on a terminal."""
        if self.live:
            failed = f", {self.failed} failed" if self.failed else ""
            names = f"  {' | '.join(running)}" if running else ""
            state = f"{self.what} {self.finished}/{self.total}{failed}, {_left(self.seconds_left())} left{names}"
            self._draw(state)

    def close(self) -> None:
        """End the live line."""
        if self.live and self._drawn:
            self.tick()
            self._print("\n")

    def seconds_left(self) -> float:
        """Estimate: from the pace so far, or from the expectation while nothing is finished."""
        elapsed = time.monotonic() - self.start
        worked = self.finished - self._skipped
        if worked <= 0:
            return max(0.0, self.expected_s * self.total / min(self.workers, max(1, self.total)) - elapsed)
        return elapsed / worked * (self.total - self.finished)

    def _draw(self, text: str) -> None:
        text = text[:118]
        if text != self._drawn:
            self._print(f"\r{text}\x1b[K")
            self._drawn = text

    def _print(self, text: str) -> None:
        try:
            self.stream.write(text)
            self.stream.flush()
        except BrokenPipeError:  # Whoever read along has left; the work goes on.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())


def _left(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
