"""Pictures of the truth: the capture's own, and those that a process beside this one path-traces on request."""

import multiprocessing
import threading
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Capture, Pose, image_path
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.cell import metrics
from benchmarks.play.cameras import distance_between
from benchmarks.play.motions import MotionClip

CACHED_PICTURES = 64
SAME_VIEW_M, SAME_VIEW_RAD = 1e-3, 1e-3  # A browser repeats the numbers of a camera with such errors.
END_SECONDS = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TruthPicture:
    """The truth of one frame, seen by one camera. Equal only to itself, so that it can be a key."""

    camera: Camera
    on_black: np.ndarray  # uint8 [h, w, 4], as the protocol compares it


class TruthCache:
    """The known pictures of the truth. Read by the drawing thread, filled by any."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._captured = lru_cache(maxsize=CACHED_PICTURES)(self._read)
        self._rendered: deque[tuple[str, int, TruthPicture]] = deque(maxlen=CACHED_PICTURES)

    def put(self, clip: MotionClip, frame: int, picture: TruthPicture) -> None:
        """Add a rendered picture of a frame of a clip."""
        self._rendered.append((clip.name, frame, picture))

    def find(self, clip: MotionClip, frame: int, camera: Camera) -> TruthPicture | None:
        """The truth of a frame as a camera sees it, whatever the camera's size; None where it is not known."""
        captured = self._captured(frame, camera.name) if clip.captured else None
        if captured is not None:
            return captured
        for name, number, picture in reversed(tuple(self._rendered)):
            moved, rotated = distance_between(picture.camera.viewmat, camera.viewmat)
            if (name, number) == (clip.name, frame) and moved < SAME_VIEW_M and rotated < SAME_VIEW_RAD:
                return picture
        return None

    def _read(self, frame: int, name: str) -> TruthPicture | None:
        """The capture's own image of a frame of its motion."""
        own = self._capture.cameras.get(name)
        if own is None or not image_path(self._capture.folder, name, frame).is_file():
            return None
        return TruthPicture(camera=own, on_black=metrics.on_black(self._capture.image(name, frame)))


class TruthRenderer:
    """Renders one picture at a time, in a process that starts with the first and ends with `close` or its parent."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._busy = threading.Lock()

    @property
    def is_busy(self) -> bool:
        """Whether a picture is under way."""
        return self._busy.locked()

    def render(self, pose: Pose, camera: Camera, *, captured: bool) -> np.ndarray:
        """The picture on black, uint8 `[h, w, 4]`; waits for it. `captured`: the frame is the capture's own.

        Raises:
            InputError: it cannot be rendered; says why.
        """
        with self._busy:
            try:
                connection = self._started()
                connection.send((pose, camera, captured))
                straight = connection.recv()
            except (EOFError, OSError) as error:
                self.close()
                raise InputError(f"the truth's renderer ended ({type(error).__name__})") from error
        if isinstance(straight, str):
            raise InputError(straight)
        return metrics.on_black(straight)

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            process.join(END_SECONDS)
            process.close()

    def _started(self) -> Connection:
        if self._process is None or self._connection is None or not self._process.is_alive():
            context = multiprocessing.get_context("spawn")  # Neither torch's nor the server's threads are inherited.
            self._connection, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(self._folder, theirs), daemon=True, name="truth")
            self._process.start()
            theirs.close()
        return self._connection


def _serve(folder: Path, connection: Connection) -> None:
    """The process: answers with a picture or with what went wrong, until the pipe ends."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it ends us.
    from synth.truth.any_pose import PoseTruth

    truth: PoseTruth | None = None
    while True:
        try:
            pose, camera, captured = connection.recv()
        except EOFError:
            return
        try:
            truth = truth or PoseTruth(load_capture(folder))
            connection.send(truth.picture(pose, camera, captured=captured))
        except Exception as error:  # The player goes on, and its page says what went wrong.
            connection.send(f"{type(error).__name__}: {error}")
