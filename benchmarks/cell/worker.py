"""A method's process, and the harness's side of it: what is asked, and how every answer is checked.

`MethodClient` asks; `python -m benchmarks.cell.sandbox SPEC benchmarks.cell.worker REQUESTS REPLIES ORDER` answers with
`Handlers`, one request after another: import the factory, learn, save or load, draw. That process never knows a truth,
a score or a result. What it says is checked: arrays by type, shape and range, numbers by their range, its clock by
ours; its files are taken as files, not as links.
"""

import contextlib
import json
import math
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import psutil

from ash.capture.dataset import Camera, Capture, Pose
from ash.capture.formats import load_capture, read_cameras, read_motion, write_cameras, write_motion
from ash.capture.typed import from_json
from ash.files import InputError, require_plain
from ash.protocol import Displayed, LearnsTemplate, PosedGeometry, StageClock, TellsOutcome, TrainingOutcome
from benchmarks.cell.registry import OUR_PACKAGES, Method, located, make_avatar
from benchmarks.cell.sandbox import (
    BASE,
    ISOLATION,
    SANDBOX_UNAVAILABLE,
    TEST_VIEWS,
    WORK,
    SandboxSpec,
    SandboxUnavailable,
    add_method_paths,
    clean_environment,
    kill_process_tree,
    peak_memory_mb,
    relay_output,
    sandbox_for,
    sandboxed,
    watched_folders,
)
from benchmarks.cell.schema import (
    CHECKPOINT,
    Cell,
    DrawnBy,
    HarnessFailed,
    Killed,
    MethodFailed,
    Status,
    TrainingTime,
    View,
)

KEPT = (CHECKPOINT, "log.jsonl")
MOST_POINTS, MOST_COUNT = 10_000_000, 10**13
LOWEST, HIGHEST = -0.5, 2.0  # of a picture; rounding and overbright colours leave 0..1 a little, other units far
CLOCK_SLACK_MS, CLOCK_SLACK = 2.0, 0.1
CLOCK_LIE_MS, TRAINING_SLACK_S = 20.0, 5.0  # what a busy machine's scheduler may add
LARGEST_HEADER = 1 << 16  # bytes of a reply, besides its array
KERNELS = "kernels"  # In a cell's folder, while its method runs.


@dataclass(frozen=True, kw_only=True, slots=True)
class Timed:
    """Milliseconds of one frame by the method's clock, whole and by stage, and by ours."""

    inside_ms: float
    stage_ms: dict[str, float]
    outside_ms: float


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodInfo:
    """What a trained method says of itself."""

    params: int
    gaussians: int
    geometry: bool
    template_s: float | None
    training: TrainingOutcome | None


class MethodClient:
    """A method's process, and what it may be asked."""

    def __init__(self, process: subprocess.Popen[bytes], requests: int, replies: int, *, isolated: bool) -> None:
        self.isolated = isolated
        self._process, self._requests, self._replies = process, requests, replies
        self._start = TrainingTime(wall_s=0.0, cpu_s=0.0)

    def make(self) -> TrainingTime:
        """Import the factory and build the avatar. Returns what that took; the time of training begins here."""
        self._start = TrainingTime(wall_s=time.perf_counter(), cpu_s=self._cpu_seconds())
        self._ask("make")
        return self.spent()

    def fit(self) -> None:
        """Learn."""
        start = time.perf_counter()
        header, _ = self._ask("fit")
        seconds = time.perf_counter() - start
        inside = _number(header.get("seconds"), "seconds of training")
        if abs(seconds - inside) > TRAINING_SLACK_S + CLOCK_SLACK * seconds:
            raise MethodFailed("crashed", f"its clock says {inside:.1f} s of training, ours {seconds:.1f} s")

    def spent(self) -> TrainingTime:
        """Time since `make` began, of every request and of what the process does between them.

        Read before the first picture, this is the training: no work that prepares pictures is left out.
        """
        assert self._start.cpu_s is not None
        return TrainingTime(
            wall_s=time.perf_counter() - self._start.wall_s, cpu_s=self._cpu_seconds() - self._start.cpu_s
        )

    def save(self) -> None:
        """Write the weights."""
        self._ask("save", name=CHECKPOINT)

    def load(self, name: str = CHECKPOINT) -> None:
        """Read the weights, or others that it left in its folder."""
        self._ask("load", name=name)

    def load_test_views(self, folder: Path, capture: Capture) -> None:
        """Show the cameras and motion that are to be drawn; only after training."""
        write_test_views(folder, capture)
        self._ask("load_test_views", folder=str(folder))

    def open_display(self) -> DrawnBy:
        """Have what is timed from now on drawn by the method's display, where it has one that opens here."""
        answer: Any = self._ask("display")[0].get("drawn_by")
        if answer not in get_args(DrawnBy):
            raise MethodFailed("crashed", f"expected who draws timed frames, got {answer!r}")
        return answer  # type: ignore[no-any-return]

    def draw(self, view: View, camera: Camera, what: Literal["draw", "shown"] = "draw") -> np.ndarray:
        """One picture, float32 `[h, w, 4]`, finite; "shown": the one that was timed last."""
        expected = (camera.height, camera.width, 4)
        header, payload = self._ask(what, most=4 * math.prod(expected), camera=view.camera, frame=view.frame)
        if header.get("dtype") != "<f4" or header.get("shape") != list(expected):
            got = f"{header.get('dtype')} {header.get('shape')}"
            raise MethodFailed("crashed", f"expected an image float32 {expected}, got {got}")
        image = np.frombuffer(payload, dtype=np.float32).reshape(expected)
        if not np.isfinite(image).all():
            raise MethodFailed("diverged", "the rendered image holds NaN or infinity")
        if image.min() < LOWEST or image.max() > HIGHEST:
            span = f"{image.min():.3g} to {image.max():.3g}"
            raise MethodFailed("crashed", f"values of an image run from {span}, expected 0 to 1")
        return image

    def time(self, view: View) -> Timed:
        """Draw a picture for its time alone."""
        start = time.perf_counter()
        header, _ = self._ask("time", camera=view.camera, frame=view.frame)
        outside = (time.perf_counter() - start) * 1e3
        stages = header.get("stages")
        if not isinstance(stages, dict) or len(stages) > 20 or not all(_is_plain(name) for name in stages):
            raise MethodFailed("crashed", "expected at most 20 stages with plain names")
        inside = _number(header.get("ms"), "milliseconds of a frame")
        known = {name: _number(ms, f"milliseconds of {name}") for name, ms in stages.items()}
        return Timed(inside_ms=inside, stage_ms=known, outside_ms=outside)

    def geometry(self, what: str, frame: int) -> np.ndarray:
        """`vertices` or `means` of a frame, float64 `[n, 3]` metres."""
        header, payload = self._ask(what, most=8 * 3 * MOST_POINTS, frame=frame)
        shape = header.get("shape")
        if not isinstance(shape, list) or len(shape) != 2 or shape[1] != 3 or header.get("dtype") not in ("<f4", "<f8"):
            raise MethodFailed("crashed", f"{what}: expected floats [n, 3], got {header.get('dtype')} {shape}")
        points = np.frombuffer(payload, dtype=header["dtype"])
        if len(points) != 3 * shape[0] or not np.isfinite(points).all():
            raise MethodFailed("crashed", f"{what}: expected {shape[0]} finite points")
        return points.reshape(-1, 3).astype(np.float64)

    def describe(self) -> MethodInfo:
        """Counts, and what it offers."""
        header, _ = self._ask("describe")
        for name in ("params", "gaussians"):
            count = header.get(name)
            if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MOST_COUNT:
                raise MethodFailed("crashed", f"{name}: {count!r}, expected a whole number, 0 or more")
        seconds = header.get("template_s")
        return MethodInfo(
            params=header["params"],
            gaussians=header["gaussians"],
            geometry=header.get("geometry") is True,
            template_s=None if seconds is None else _number(seconds, "seconds for the template"),
            training=_outcome(header.get("training")),
        )

    def peak_memory_mb(self) -> float:
        """The largest resident memory that one of the method's processes had so far, MiB."""
        return peak_memory_mb(self._process.pid)

    def _cpu_seconds(self) -> float:
        """What the method's processes, and those of theirs that ended, have used of processors so far."""
        whole = psutil.Process(self._process.pid)
        used = 0.0
        for member in (whole, *whole.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                times = member.cpu_times()
                used += times.user + times.system + times.children_user + times.children_system
        return float(used)

    def _ask(self, what: str, *, most: int = 0, **arguments: Any) -> tuple[dict[str, Any], bytes]:
        """Send a request and read the checked reply: a header, and at most `most` bytes besides."""
        try:
            os.write(self._requests, json.dumps({"do": what, **arguments}).encode() + b"\n")
        except BrokenPipeError:
            raise self._gone() from None
        return self._receive(most)

    def _receive(self, most: int) -> tuple[dict[str, Any], bytes]:
        length = int.from_bytes(self._read(4), "big")
        if length > LARGEST_HEADER:
            raise MethodFailed("crashed", "its process answered nonsense")
        try:
            header = json.loads(self._read(length))
            size = header["bytes"]
            if not isinstance(size, int) or not size >= 0:
                raise ValueError(size)
        except (ValueError, TypeError, KeyError, RecursionError):
            raise MethodFailed("crashed", "its process answered nonsense") from None
        if header.get("error") == "harness":
            raise HarnessFailed(f"before the method began: {header.get('message')}")
        if "error" in header:
            statuses: dict[str, Status] = {"diverged": "diverged", "memory": "out of memory"}
            raise MethodFailed(statuses.get(str(header["error"]), "crashed"), str(header.get("message")))
        if size > most:
            raise MethodFailed("crashed", f"it answered with {size} bytes, expected at most {most}: a wrong shape")
        return header, self._read(size)

    def _read(self, size: int) -> bytes:
        parts, left = [], size
        while left:
            part = os.read(self._replies, min(left, 1 << 20))
            if not part:
                raise self._gone()
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _gone(self) -> Exception:
        """Why the process does not answer any more."""
        try:
            code = self._process.wait(5)
        except subprocess.TimeoutExpired:
            return MethodFailed("crashed", "its process closed the connection")
        if code == SANDBOX_UNAVAILABLE:
            return SandboxUnavailable("no sandbox")
        if code == -signal.SIGKILL:
            return Killed()
        name = signal.Signals(-code).name if code < 0 and -code in list(signal.Signals) else f"exit code {code}"
        # SIGABRT does not end the first process of a namespace; the trap after it does, as SIGSEGV.
        if self.isolated and name == "SIGSEGV":
            name = "SIGSEGV or SIGABRT"
        return MethodFailed("crashed", f"the method's process ended with {name}")


def write_test_views(folder: Path, capture: Capture) -> None:
    """Write the cameras and the motion that are to be drawn."""
    write_cameras(folder / "cameras.json", list(capture.cameras.values()))
    write_motion(folder / "motion.npz", capture.motion)


@contextlib.contextmanager
def open_client(
    cell: Cell, capture: Capture, seen: Capture, method: Method, *, oracle: bool, secret: tuple[Path, ...] = ()
) -> Iterator[MethodClient]:
    """A process for the method, in a sandbox where this system allows one; whatever it started ends with it.

    `secret`: folders besides the capture's that it must not see.
    """
    place, work = cell.folder.resolve(), cell.folder.resolve() / WORK
    for name in (WORK, TEST_VIEWS, BASE):
        (place / name).mkdir(parents=True, exist_ok=True)
    store = seen.store if oracle or method.target.split(".")[0] in OUR_PACKAGES else work / "templates"
    order: dict[str, Any] = {
        "work": str(work),
        "input": str(seen.folder.resolve()),
        "closed": [] if oracle else [str(capture.folder.resolve())],
        "store": "" if store is None else str(store.resolve()),
        "target": method.target,
        "seed": cell.config.seed,
        "preset": cell.config.preset,
        "changes": cell.config.changes,
    }
    kernels = copy_kernel_cache(cell.config.device, place)
    spec = None
    if not oracle and os.environ.get(ISOLATION) != "off":
        if store is not None:
            store.mkdir(parents=True, exist_ok=True)
        spec = sandbox_for(place, capture, seen, method, store, secret=secret)
        spec = replace(spec, writable=(*spec.writable, str(kernels)))
    client, pump = _start(order, kernels, spec)
    try:
        try:
            client._receive(0)
        except SandboxUnavailable:
            kill_process_tree(client._process)
            client, pump = _start(order, kernels, None)
            client._receive(0)
        except MethodFailed as error:
            raise HarnessFailed(f"before the method began: {error}") from error
        yield client
    finally:
        kill_process_tree(client._process)
        for descriptor in (client._requests, client._replies):
            os.close(descriptor)
        pump.join(5)
        for name in (TEST_VIEWS, BASE, KERNELS):
            shutil.rmtree(place / name, ignore_errors=True)


def stage_out(cell: Cell) -> None:
    """Move what a method leaves to be kept into the cell's folder: regular files only."""
    for name in KEPT:
        source = cell.folder / WORK / name
        with contextlib.suppress(FileNotFoundError):
            if stat.S_ISREG(source.lstat().st_mode):
                source.replace(cell.folder / name)
    if not (cell.folder / CHECKPOINT).is_file():
        raise MethodFailed("crashed", f"save wrote no file {CHECKPOINT}")


def stage_in(cell: Cell) -> None:
    """Put a trained cell's weights where its method finds them again."""
    (cell.folder / WORK).mkdir(parents=True, exist_ok=True)
    target = cell.folder / WORK / CHECKPOINT
    target.unlink(missing_ok=True)
    shutil.copyfile(cell.folder / CHECKPOINT, target)


def frame_times_ms(frames: list[Timed]) -> tuple[float, ...]:
    """Milliseconds of each frame: the method's, or the host's if the exchange between the processes takes long.

    If it does, host time is used, so that a method cannot under-report.

    Raises:
        MethodFailed: the two clocks differ by more than the exchange between processes can take.
    """
    exchange = min(frame.outside_ms - frame.inside_ms for frame in frames)
    shortest = min(frames, key=lambda frame: frame.outside_ms)
    inside, outside = shortest.inside_ms, shortest.outside_ms
    if exchange < -0.5 or exchange > CLOCK_LIE_MS + CLOCK_SLACK * outside:
        raise MethodFailed("crashed", f"its clock says {inside:.1f} ms for a frame, ours {outside:.1f} ms")
    if exchange > CLOCK_SLACK_MS + CLOCK_SLACK * outside:
        print(f"frames are timed from outside: {outside:.1f} ms, by the method {inside:.1f} ms", file=sys.stderr)
        return tuple(frame.outside_ms for frame in frames)
    return tuple(frame.inside_ms for frame in frames)


def _start(order: dict[str, Any], kernels: Path, spec: SandboxSpec | None) -> tuple[MethodClient, threading.Thread]:
    theirs, requests = os.pipe()
    replies, answers = os.pipe()
    command = sandboxed(spec, "benchmarks.cell.worker", str(theirs), str(answers), json.dumps(order))
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        pass_fds=(theirs, answers),
        env=clean_environment() | {"WARP_CACHE_PATH": str(kernels)},
    )
    os.close(theirs)
    os.close(answers)
    assert process.stdout is not None
    pump = threading.Thread(target=relay_output, args=(process.stdout,), daemon=True)
    pump.start()
    return MethodClient(process, requests, replies, isolated=spec is not None), pump


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
        raise MethodFailed("crashed", f"{what}: {value!r}, expected a number, 0 or more")
    return float(value)


def _outcome(answer: Any) -> TrainingOutcome | None:
    try:
        outcome: TrainingOutcome | None = from_json(TrainingOutcome | None, answer, place="outcome")
        if outcome is not None:
            require_plain(outcome.ended_by, what="end of training")
    except ValueError as error:
        raise MethodFailed("crashed", f"how training ended: {error}") from error
    return outcome


def _is_plain(name: str) -> bool:
    return 0 < len(name) <= 40 and name.replace("_", "").isalnum() and name.isascii()


def runs_kernels(device: str) -> bool:
    """Whether a cell learns on one of Warp's devices; the CPU has kernels of its own."""
    return device != "cpu"


def copy_kernel_cache(device: str, place: Path) -> Path:
    """A fresh folder `KERNELS` in `place`; in it what the device runs, compiled now where it never was.

    It stays empty on the CPU, where nothing is run from it, and where the device cannot be used: the method says that.
    A process of its own compiles, so that this one takes no part of the GPU.
    """
    folder = place / KERNELS
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if runs_kernels(device):
        subprocess.run(
            [sys.executable, "-P", "-m", "ash.warp.compiling", device, str(folder)],
            env=clean_environment(),
            check=False,
        )
    return folder


def main(argv: list[str]) -> int:
    """Answer until the requests end."""
    requests, replies, order = int(argv[0]), int(argv[1]), json.loads(argv[2])
    os.chdir(order["work"])
    _reply(replies, {"hello": True})
    handlers = Handlers(order)
    with os.fdopen(requests, "rb") as lines:
        for line in lines:
            _reply(replies, *_answer(handlers, json.loads(line)))
    sys.stdout.flush()
    os._exit(0)  # Whatever the method left for the end of the interpreter is not waited for.


def _answer(handlers: "Handlers", request: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    """The reply to a request: what was asked for, or what went wrong."""
    try:
        with handlers.watched():
            return getattr(handlers, f"do_{request.pop('do')}")(**request)
    except BaseException as error:  # Whatever a method raises is the host's to judge.
        import traceback

        traceback.print_exc()
        if not handlers.begun:
            return {"error": "harness", "message": f"{type(error).__name__}: {error}"[:2000]}, b""
        kind = "memory" if isinstance(error, MemoryError) else "crashed"
        kind = "diverged" if isinstance(error, FloatingPointError) else kind
        said = located(error, handlers.order["target"]) if isinstance(error, Exception) else type(error).__name__
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
        return watched_folders(self.order["closed"], Path(self.order["input"]))

    def do_make(self) -> tuple[dict[str, Any], bytes]:
        """Load the capture, import the factory, build the avatar."""
        add_method_paths()
        store = Path(self.order["store"]) if self.order["store"] else None
        self.capture = replace(load_capture(Path(self.order["input"])), store=store)
        self.begun = True
        factory = Method(name="", target=self.order["target"], distribution="").load()
        self.avatar = make_avatar(
            factory,
            self.capture,
            of=self.order["target"],
            seed=self.order["seed"],
            preset=self.order["preset"],
            changes=self.order["changes"],
        )
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
        self.cameras = read_cameras(Path(folder) / "cameras.json")
        self.motion = read_motion(Path(folder) / "motion.npz", joints=len(self.capture.skeleton.names))
        return {}, b""

    def do_draw(self, camera: str, frame: int) -> tuple[dict[str, Any], bytes]:
        """One picture."""
        return _array(self._render(camera, frame, self.avatar)[0])

    def do_display(self) -> tuple[dict[str, Any], bytes]:
        """Open the display of an avatar that has one of its own: what is timed from now on is drawn by it."""
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
        return Pose(self.motion, frame)

    def _render(self, camera: str, frame: int, drawer: Any) -> tuple[Any, float, dict[str, float]]:
        clock, pose = StageClock(), self._pose(frame)
        start = time.perf_counter()
        image = drawer.render(pose, self.cameras[camera], clock=clock)
        return image, (time.perf_counter() - start) * 1e3, {name: float(ms) for name, ms in clock.ms.items()}


def _array(values: Any) -> tuple[dict[str, Any], bytes]:
    array = np.ascontiguousarray(values)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"expected an array of numbers, got {array.dtype}")
    return {"dtype": array.dtype.str, "shape": list(array.shape)}, array.tobytes()


def _whole(count: Any) -> Any:
    """A whole number as JSON has it; what is none goes as it is, for the host to refuse."""
    return int(count) if hasattr(count, "__index__") and not isinstance(count, bool) else repr(count)[:100]
