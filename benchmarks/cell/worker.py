"""A method's process: `python -m benchmarks.cell.worker REQUESTS REPLIES ORDER`, started by `benchmarks.cell.client`.

It does what it is asked, one request after another: import the factory, learn, save or load, draw. It knows no truth,
no score and no result; whatever it answers is checked by the host. Only the standard library is imported before the
sandbox is entered, and of the method nothing.
"""

import json
import os
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from benchmarks.cell import sandbox

LARGEST_HEADER = 1 << 16


def main(argv: list[str]) -> int:
    """Enter the sandbox, then answer until the requests end."""
    requests, replies, order = int(argv[0]), int(argv[1]), json.loads(argv[2])
    if order["sandbox"] is not None:
        try:
            sandbox.enter_sandbox(
                sandbox.SandboxSpec(**{name: _paths(value) for name, value in order["sandbox"].items()})
            )
        except sandbox.SandboxUnavailable as error:
            print(error, file=sys.stderr, flush=True)
            return sandbox.SANDBOX_UNAVAILABLE
    else:
        sandbox.end_with_parent()
    os.chdir(order["work"])
    _reply(replies, {"hello": True})
    answers = Handlers(order)
    with os.fdopen(requests, "rb") as lines:
        for line in lines:
            _reply(replies, *_answer(answers, json.loads(line)))
    sys.stdout.flush()
    os._exit(0)  # Whatever the method left for the end of the interpreter is not waited for.


def _paths(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _answer(answers: "Handlers", request: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """The reply to a request: what was asked for, or what went wrong."""
    try:
        with answers.watched():
            return getattr(answers, f"do_{request.pop('do')}")(**request)
    except BaseException as error:  # Whatever a method raises is the host's to judge.
        import traceback

        traceback.print_exc()
        if not answers.begun:
            return {"error": "harness", "message": f"{type(error).__name__}: {error}"[:2000]}, b""
        kind = "memory" if isinstance(error, MemoryError) else "crashed"
        kind = "diverged" if isinstance(error, FloatingPointError) else kind
        from benchmarks.cell.registry import located

        said = located(error, answers.order["target"]) if isinstance(error, Exception) else type(error).__name__
        return {"error": kind, "message": said[:2000]}, b""


def _reply(descriptor: int, header: dict[str, Any], payload: bytes = b"") -> None:
    text = json.dumps(header | {"bytes": len(payload)}).encode()
    for content in (len(text).to_bytes(4, "big") + text, payload):
        view = memoryview(content)
        while view:
            view = view[os.write(descriptor, view) :]


class Handlers:
    """The method, and what it can be asked."""

    def __init__(self, order: dict[str, Any]) -> None:
        self.order = order
        self.begun = False  # Whether any code of the method was run.
        self.avatar: Any = None
        self.drawer: Any = None  # the avatar's display
        self.picture: Any = None  # the one that was timed last
        self.capture: Any = None
        self.motion: Any = None
        self.cameras: Any = None

    def watched(self) -> AbstractContextManager[None]:
        """Without a sandbox, Python's audit hook watches instead."""
        if not self.order["closed"]:
            return nullcontext()
        from benchmarks.cell.access_guard import watched_folders

        return watched_folders(self.order["closed"], Path(self.order["input"]))

    def do_make(self) -> tuple[dict[str, Any], bytes]:
        """Load the capture, import the factory, build the avatar."""
        from dataclasses import replace

        from ash.capture.formats import load_capture
        from benchmarks.cell.children import add_method_paths
        from benchmarks.cell.registry import Method, configured

        add_method_paths()
        store = Path(self.order["store"]) if self.order["store"] else None
        self.capture = replace(load_capture(Path(self.order["input"])), store=store)
        self.begun = True
        factory = Method(name="", target=self.order["target"], distribution="").load()
        wanted = {"seed": self.order["seed"], "preset": self.order["preset"]}
        if self.order["changes"]:
            wanted["config"] = configured(self.order["target"], self.order["preset"], self.order["changes"])
        self.avatar = factory(self.capture, **wanted)
        return {}, b""

    def do_fit(self) -> tuple[dict[str, Any], bytes]:
        """Learn."""
        start = time.perf_counter()
        self.avatar.fit(self.capture, folder=Path(self.order["work"]))
        return {"seconds": time.perf_counter() - start}, b""

    def do_save(self, name: str) -> tuple[dict[str, Any], bytes]:
        """Write the weights."""
        self.avatar.save(Path(self.order["work"]) / name)
        return {}, b""

    def do_load(self, name: str) -> tuple[dict[str, Any], bytes]:
        """Read the weights."""
        self.avatar.load(Path(self.order["work"]) / name)
        return {}, b""

    def do_load_test_views(self, folder: str) -> tuple[dict[str, Any], bytes]:
        """Get to know the cameras and the motion that are to be drawn."""
        from ash.capture.formats import read_cameras, read_motion

        self.cameras = read_cameras(Path(folder) / "cameras.json")
        self.motion = read_motion(Path(folder) / "motion.npz", joints=len(self.capture.skeleton.names))
        return {}, b""

    def do_draw(self, camera: str, frame: int) -> tuple[dict[str, Any], bytes]:
        """One picture."""
        return _array(self._render(camera, frame, self.avatar)[0])

    def do_display(self) -> tuple[dict[str, Any], bytes]:
        """Open the display of an avatar that has one of its own: what is timed from now on is drawn by it."""
        from ash.files import InputError
        from ash.protocol import Displayed

        if not isinstance(self.avatar, Displayed):
            return {"drawn_by": "method"}, b""
        try:
            self.drawer = self.avatar.open_display()
        except InputError:  # This machine has no OpenGL.
            return {"drawn_by": "trainer"}, b""
        return {"drawn_by": "display"}, b""

    def do_time(self, camera: str, frame: int) -> tuple[dict[str, Any], bytes]:
        """One picture, of which only the milliseconds are told."""
        self.picture, milliseconds, stages = self._render(camera, frame, self.drawer or self.avatar)
        return {"ms": milliseconds, "stages": stages}, b""

    def do_shown(self, camera: str, frame: int) -> tuple[dict[str, Any], bytes]:
        """The picture that was timed last."""
        return _array(self.picture)

    def do_vertices(self, frame: int) -> tuple[dict[str, Any], bytes]:
        """The posed template."""
        return _array(self.avatar.template_vertices(self._pose(frame)))

    def do_means(self, frame: int) -> tuple[dict[str, Any], bytes]:
        """The centres of the posed Gaussians."""
        return _array(self.avatar.gaussian_means(self._pose(frame)))

    def do_describe(self) -> tuple[dict[str, Any], bytes]:
        """Counts, and what the avatar offers besides the protocol."""
        from dataclasses import asdict

        from ash.protocol import LearnsTemplate, PosedGeometry, TellsOutcome

        learns = isinstance(self.avatar, LearnsTemplate)
        seconds = self.avatar.template_seconds() if learns else None
        outcome = self.avatar.outcome() if isinstance(self.avatar, TellsOutcome) else None
        described = {
            "params": _whole(self.avatar.parameter_count()),
            "gaussians": _whole(self.avatar.gaussian_count()),
            "geometry": isinstance(self.avatar, PosedGeometry),
            "template_s": None if seconds is None else float(seconds),
            "training": None if outcome is None else asdict(outcome),
        }
        return described, b""

    def _pose(self, frame: int) -> Any:
        from ash.capture.dataset import Pose

        return Pose(self.motion, frame)

    def _render(self, camera: str, frame: int, drawer: Any) -> tuple[Any, float, dict[str, float]]:
        from ash.protocol import StageClock

        clock, pose = StageClock(), self._pose(frame)
        start = time.perf_counter()
        image = drawer.render(pose, self.cameras[camera], clock=clock)
        return image, (time.perf_counter() - start) * 1e3, {name: float(ms) for name, ms in clock.ms.items()}


def _array(values: Any) -> tuple[dict[str, Any], bytes]:
    import numpy as np

    array = np.ascontiguousarray(values)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"expected an array of numbers, got {array.dtype}")
    return {"dtype": array.dtype.str, "shape": list(array.shape)}, array.tobytes()


def _whole(count: Any) -> Any:
    """A whole number as JSON has it; what is none goes as it is, for the host to refuse."""
    return int(count) if hasattr(count, "__index__") and not isinstance(count, bool) else repr(count)[:100]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
