"""Methods that reach for truth, the score, the clock or others' results, and those that end a cell badly."""

import ctypes
import json
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from helpers.fakes import FakeAvatar

from ash.capture.dataset import Camera, Capture, Pose
from ash.files import InputError
from ash.protocol import StageClock

TRUTH = Path(os.environ.get("ASH_BENCH_TEST_TRUTH", "/nowhere"))  # A held-out image of the real capture.
OTHER = Path(os.environ.get("ASH_BENCH_TEST_OTHER", "/nowhere"))  # The result of another cell.


def _reads() -> dict[str, object]:
    """Ways to a file that Python's audit hook does not see, or sees too late; what each brought home."""

    def by_descriptor() -> bytes:
        root = os.open("/", os.O_RDONLY)
        return os.read(os.open(str(TRUTH)[1:], os.O_RDONLY, dir_fd=root), 8)

    def by_libc() -> bytes:
        libc = ctypes.CDLL(None)
        descriptor = libc.open(str(TRUTH).encode(), os.O_RDONLY)
        buffer = ctypes.create_string_buffer(8)
        return buffer.raw if libc.read(descriptor, buffer, 8) == 8 else b""

    def by_torch() -> bytes:
        import torch

        return torch.from_file(str(TRUTH), size=8, dtype=torch.uint8).numpy().tobytes()

    def by_shell() -> bytes:
        command = ["sh", "-c", 'head -c 8 "$ASH_BENCH_TEST_TRUTH"']
        return subprocess.run(command, capture_output=True, check=False).stdout

    def by_truncating() -> bytes:
        return b"x" if ctypes.CDLL(None).open(str(TRUTH).encode(), os.O_WRONLY | os.O_TRUNC) >= 0 else b""

    return {
        "shell": by_shell,
        "dir_fd": by_descriptor,
        "libc": by_libc,
        "torch": by_torch,
        "truncate": by_truncating,
        "parent's files": lambda: Path("/proc", str(os.getppid()), "root", *OTHER.parts[1:]).read_bytes()[:8],
        "other result": lambda: OTHER.read_bytes()[:8],
        "overwrite": lambda: b"x" if OTHER.exists() and OTHER.write_bytes(b"{}") else b"",
        "kernel settings": lambda: Path("/proc/sys/kernel/core_pattern").open("r+b").name,
        "generator": lambda: bytes(str(__import__("synth.presets")), "utf8"),
    }


def _try_all() -> dict[str, str]:
    loot = {}
    for name, attempt in _reads().items():
        try:
            loot[name] = repr(attempt() or "")  # type: ignore[operator]
        except Exception:
            loot[name] = ""
    return loot


AT_IMPORT = _try_all() if Path("/nowhere") != TRUTH and "benchmarks.cell.worker" in " ".join(sys.orig_argv) else {}


class Thief(FakeAvatar):
    """Tries everything, and paints over the scorer."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        from benchmarks.cell import metrics

        super().fit(capture, folder=folder)
        metrics.score_view = lambda *_: {("foreground", "psnr"): 99.0}  # type: ignore[assignment]
        (folder / "loot.json").write_text(json.dumps({"import": AT_IMPORT, "fit": _try_all()}))
        (folder / "result.json").write_text('{"status": "done"}')
        (folder.parent / "result.json").write_text('{"status": "done"}') if os.access(folder.parent, os.W_OK) else None


class Slow(FakeAvatar):
    """Draws in 30 ms and says that it took three."""

    def __init__(self, capture: Capture, **settings) -> None:
        super().__init__(capture, **settings)
        real = time.perf_counter
        time.perf_counter = lambda: real() / 10

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        start = time.monotonic()
        while time.monotonic() - start < 0.03:
            pass
        return super().render(pose, camera, clock=clock)


class PreparesElsewhere(FakeAvatar):
    """Works half a second in the factory, in `save` and when it is asked what it is, and nothing in `fit`.

    Draws in 30 ms, and a picture that it drew before in no time.
    """

    def __init__(self, capture: Capture, **settings) -> None:
        super().__init__(capture, **settings)
        self.drawn: dict[tuple[str, int], np.ndarray] = {}
        _work(0.5)

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        if (camera.name, pose.frame) not in self.drawn:
            time.sleep(0.03)
            self.drawn[camera.name, pose.frame] = super().render(pose, camera, clock=clock)
        return self.drawn[camera.name, pose.frame]

    def save(self, path: Path) -> None:
        _work(0.5)
        super().save(path)

    def parameter_count(self) -> int:
        _work(0.5)
        return super().parameter_count()


def _work(seconds: float) -> None:
    start = time.process_time()
    while time.process_time() - start < seconds:
        pass


class Warps(FakeAvatar):
    """Runs a kernel of Warp's on the CPU, writes down what was compiled before and after, and spoils it."""

    def fit(self, capture: Capture, *, folder: Path) -> None:
        import torch

        from ash.mesh.rasterizing import rasterize_by_warp

        super().fit(capture, folder=folder)
        corners = torch.tensor([[0.0, 0, 1], [8, 0, 1], [0, 8, 1]], dtype=torch.float64)
        before = _files(Path(os.environ["WARP_CACHE_PATH"]))
        seen = rasterize_by_warp(corners, torch.tensor([[0, 1, 2]], dtype=torch.int32), width=4, height=4, near=0.01)
        after = _files(Path(os.environ["WARP_CACHE_PATH"]))
        said = {"before": before, "after": after, "seen": int((seen.triangle == 0).sum())}
        (folder / "compiled.json").write_text(json.dumps(said))
        for name in after:
            (Path(os.environ["WARP_CACHE_PATH"]) / name).write_bytes(b"broken")


def _files(folder: Path) -> dict[str, int]:
    """Files below, with the times at which they were written."""
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in sorted(folder.rglob("*")) if p.is_file()}


class Screen:
    """A display that draws what the avatar draws, or a black picture in no time."""

    def __init__(self, avatar: FakeAvatar, *, decoy: bool) -> None:
        self.avatar, self.decoy = avatar, decoy

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        if self.decoy:
            return np.zeros((camera.height, camera.width, 4), np.float32)
        return self.avatar.render(pose, camera, clock=clock)

    def close(self) -> None:
        pass


class Shown(FakeAvatar):
    """Has a display of its own; `how` says which."""

    def __init__(self, capture: Capture, *, how: str, **settings) -> None:
        super().__init__(capture, **settings)
        self.how = how

    def open_display(self) -> Screen:
        if self.how == "screenless":
            raise InputError("no screen here")
        return Screen(self, decoy=self.how == "decoy")


class Ends(FakeAvatar):
    """Ends in the way that `how` says."""

    def __init__(self, capture: Capture, *, how: str, **settings) -> None:
        super().__init__(capture, **settings)
        self.how = how

    def fit(self, capture: Capture, *, folder: Path) -> None:
        super().fit(capture, folder=folder)
        match self.how:
            case "exit_2":
                os._exit(2)
            case "exit_0":
                (folder / "result.json").write_text("{}")
                os._exit(0)
            case "os_error":
                raise OSError(28, "No space left on device", "/nowhere")
            case "input_error":
                raise InputError("the method's own refusal")
            case "keyboard":
                raise KeyboardInterrupt
            case "loud":
                program = "import os, time; os.setsid(); open('/dev/shm/x', 'w'); time.sleep(600)"
                subprocess.Popen([sys.executable, "-c", program, "left-behind-by-a-method"], start_new_session=True)
                for _ in range(300):
                    print("x" * (1 << 16), flush=True)
                print("last words", flush=True)
            case "resumes":
                from ash.checkpoints import read_safetensors

                if (kept := folder / "checkpoint.safetensors").exists():
                    read_safetensors(kept)
            case "spoils":
                libc = ctypes.CDLL(None)
                libc.write(libc.open(str(TRUTH).encode(), os.O_WRONLY), b"broken", 6)
            case "overwrites":
                for path in folder.parents[1].glob("*/result.json"):
                    ctypes.CDLL(None).truncate(str(path).encode(), 10)
            case "fills":
                for number in range(40):
                    (folder / f"{number}.bin").write_bytes(b"\0" * (1 << 22))
                time.sleep(60)
            case "forks":
                program = "import os, time\nwhile True: os.fork() or os.setsid(); time.sleep(600)"
                subprocess.Popen([sys.executable, "-c", program, "left-behind-by-a-method"], start_new_session=True)
                hoard = bytearray(1 << 30)
                time.sleep(60 + len(hoard) % 2)
            case "sleeps":
                time.sleep(1.2)
            case "works":
                program = "import time\nwhile time.process_time() < 1: pass"
                subprocess.run([sys.executable, "-c", program], check=True)
            case "waits":
                (folder / "waits").touch()
                time.sleep(600)


HOW = (
    "exit_2", "exit_0", "os_error", "input_error", "keyboard", "loud", "waits", "resumes", "sleeps", "spoils", "works",
    "overwrites", "fills", "forks",
)  # fmt: skip
SHOWN = ("shown", "decoy", "screenless")
METHODS = {
    "thief": "Thief", "clock": "Slow", "warps": "Warps", "prepares_elsewhere": "PreparesElsewhere",
    **{how: how for how in (*HOW, *SHOWN)},
}  # fmt: skip
globals().update({how: partial(kind, how=how) for kind, hows in ((Ends, HOW), (Shown, SHOWN)) for how in hows})
