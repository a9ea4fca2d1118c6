"""Truth for what was never rendered: a process beside the player path-traces it, and says how far it is."""

import multiprocessing
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Motion, Pose
from ash.capture.formats import load_capture
from ash.files import InputError

END_SECONDS = 5.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Wanted:
    """One picture of the truth."""

    motion: Motion
    frame: int
    camera: Camera
    captured: bool  # the frame is the capture's own


Heard = Callable[[str], None]
Shown = Callable[[np.ndarray | None, str], None]  # The picture, or None and what went wrong.


class TruthStudio:
    """Renders one picture at a time, in a process that starts with the first and ends with `close` or its parent."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: multiprocessing.process.BaseProcess | None = None
        self._ours: Connection | None = None
        self._busy = threading.Lock()

    def ask(self, wanted: Wanted, *, heard: Heard, shown: Shown) -> bool:
        """Begin a picture and return; False where another is under way. Both are called from another thread."""
        if not self._busy.acquire(blocking=False):
            return False
        threading.Thread(target=self._follow, args=(wanted, heard, shown), daemon=True, name="truth").start()
        return True

    def render(self, wanted: Wanted, heard: Heard) -> np.ndarray:
        """The picture, straight RGBA uint8 `[h, w, 4]`; waits for it.

        Raises:
            InputError: it cannot be rendered; says why.
        """
        with self._busy:
            return self._exchange(wanted, heard)

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            process.join(END_SECONDS)
            process.close()

    def _follow(self, wanted: Wanted, heard: Heard, shown: Shown) -> None:
        try:
            shown(self._exchange(wanted, heard), "")
        except InputError as error:
            shown(None, str(error))
        finally:
            self._busy.release()

    def _exchange(self, wanted: Wanted, heard: Heard) -> np.ndarray:
        connection = self._started()
        try:
            connection.send(wanted)
            while True:
                kind, content = connection.recv()
                if kind == "picture":
                    return np.asarray(content)
                if kind == "error":
                    raise InputError(str(content))
                heard(str(content))
        except (EOFError, OSError) as error:
            self.close()
            raise InputError(f"the truth's renderer ended ({type(error).__name__})") from error

    def _started(self) -> Connection:
        if self._process is None or self._ours is None or not self._process.is_alive():
            context = multiprocessing.get_context("spawn")  # Neither torch's nor the server's threads are inherited.
            self._ours, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(self.folder, theirs), daemon=True, name="truth")
            self._process.start()
            theirs.close()
        return self._ours


def _serve(folder: Path, connection: Connection) -> None:
    """The process: renders what comes through the pipe until the pipe ends."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it ends us.
    from synth.readers.any_pose import PoseTruth

    studio: PoseTruth | None = None
    while True:
        try:
            wanted = connection.recv()
        except EOFError:
            return
        try:
            if studio is None:
                connection.send(("stage", "starting the renderer"))
                studio = PoseTruth(load_capture(folder))
            picture = studio.picture(
                Pose(wanted.motion, wanted.frame),
                wanted.camera,
                captured=wanted.captured,
                tell=lambda text: connection.send(("stage", text)),
            )
            connection.send(("picture", picture))
        except Exception as error:  # The player lives on, and its page says what went wrong.
            connection.send(("error", f"{type(error).__name__}: {error}"))
