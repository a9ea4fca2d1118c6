"""Pictures of the truth: the capture's own, and those that a process beside the player path-traces on request."""

import hashlib
import multiprocessing
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ash.capture.dataset import Camera, Capture, Motion, Pose, image_path
from ash.capture.formats import load_capture
from ash.files import InputError
from benchmarks.cell import metrics
from benchmarks.play.cameras import distance_between
from benchmarks.play.motions import MotionClip

CACHED_POSES = 64
SAME_VIEW_M, SAME_VIEW_RAD = 1e-3, 1e-3  # A browser repeats the numbers of a camera with such errors.
END_SECONDS = 5.0

PoseKey = tuple  # name of the clip, frame, angles of joints that a viewer turned


@dataclass(frozen=True, kw_only=True)
class TruthPicture:
    """The truth of one pose, seen by one camera."""

    camera: Camera
    on_black: np.ndarray  # uint8 [h, w, 4], as the protocol compares it

    @cached_property
    def key(self) -> str:
        """Different for different pixels."""
        return hashlib.sha256(self.on_black.tobytes()).hexdigest()


class TruthCache:
    """The known pictures of the truth. Read by the drawing thread, filled by any."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._rendered: OrderedDict[PoseKey, list[TruthPicture]] = OrderedDict()

    def put(self, pose: PoseKey, picture: TruthPicture) -> None:
        """Add a rendered picture of a pose."""
        self._rendered.setdefault(pose, []).append(picture)
        while len(self._rendered) > CACHED_POSES:
            self._rendered.popitem(last=False)

    def find(self, pose: PoseKey, clip: MotionClip, camera: Camera) -> TruthPicture | None:
        """The truth of a pose as a camera sees it, whatever the camera's size; None where it is not known."""
        _, frame, turned = pose
        own = self._capture.cameras.get(camera.name)
        image = None if own is None or turned else capture_image(self._capture, clip, frame, own)
        if own is not None and image is not None:
            return TruthPicture(camera=own, on_black=image)
        for picture in reversed(self._rendered.get(pose, [])):
            moved, rotated = distance_between(picture.camera.viewmat, camera.viewmat)
            if moved < SAME_VIEW_M and rotated < SAME_VIEW_RAD:
                return picture
        return None


def capture_image(capture: Capture, clip: MotionClip, frame: int, camera: Camera) -> np.ndarray | None:
    """The capture's own image of this view on black, None where it has none or of another size."""
    own = capture.cameras.get(camera.name)
    if not clip.captured or own is None or (own.width, own.height) != (camera.width, camera.height):
        return None
    if not (np.array_equal(own.K, camera.K) and np.array_equal(own.viewmat, camera.viewmat)):
        return None
    if not image_path(capture.folder, camera.name, frame).is_file():
        return None
    return metrics.on_black(capture.image(camera.name, frame))


@dataclass(frozen=True, kw_only=True, slots=True)
class TruthRequest:
    """One picture of the truth."""

    motion: Motion
    frame: int
    camera: Camera
    captured: bool  # the frame is the capture's own


OnProgress = Callable[[str], None]
OnDone = Callable[[np.ndarray | None, str], None]  # The picture, or None and what went wrong.


class TruthRenderer:
    """Renders one picture at a time, in a process that starts with the first and ends with `close` or its parent."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._busy = threading.Lock()

    def start(self, request: TruthRequest, *, on_progress: OnProgress, on_done: OnDone) -> bool:
        """Begin a picture and return; False where another is under way. Both are called from another thread."""
        if not self._busy.acquire(blocking=False):
            return False

        def follow() -> None:
            try:
                on_done(self._exchange(request, on_progress), "")
            except InputError as error:
                on_done(None, str(error))
            finally:
                self._busy.release()

        threading.Thread(target=follow, daemon=True, name="truth").start()
        return True

    def render(self, request: TruthRequest, on_progress: OnProgress = lambda _: None) -> np.ndarray:
        """The picture, straight RGBA uint8 `[h, w, 4]`; waits for it.

        Raises:
            InputError: it cannot be rendered; says why.
        """
        with self._busy:
            return self._exchange(request, on_progress)

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            process.join(END_SECONDS)
            process.close()

    def _exchange(self, request: TruthRequest, on_progress: OnProgress) -> np.ndarray:
        try:
            connection = self._started()
            connection.send(request)
            while True:
                kind, content = connection.recv()
                if kind == "picture":
                    return np.asarray(content)
                if kind == "error":
                    raise InputError(str(content))
                on_progress(str(content))
        except (EOFError, OSError) as error:
            self.close()
            raise InputError(f"the truth's renderer ended ({type(error).__name__})") from error

    def _started(self) -> Connection:
        if self._process is None or self._connection is None or not self._process.is_alive():
            context = multiprocessing.get_context("spawn")  # Neither torch's nor the server's threads are inherited.
            self._connection, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(self._folder, theirs), daemon=True, name="truth")
            self._process.start()
            theirs.close()
        return self._connection


def _serve(folder: Path, connection: Connection) -> None:
    """The process: renders what comes through the pipe until the pipe ends."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it ends us.
    from synth.truth.any_pose import PoseTruth

    truth: PoseTruth | None = None
    while True:
        try:
            request = connection.recv()
        except EOFError:
            return
        try:
            if truth is None:
                connection.send(("progress", "starting the renderer"))
                truth = PoseTruth(load_capture(folder))
            pose = Pose(request.motion, request.frame)
            tell = lambda text: connection.send(("progress", text))  # noqa: E731
            connection.send(("picture", truth.picture(pose, request.camera, captured=request.captured, tell=tell)))
        except Exception as error:  # The player goes on, and its page says what went wrong.
            connection.send(("error", f"{type(error).__name__}: {error}"))
