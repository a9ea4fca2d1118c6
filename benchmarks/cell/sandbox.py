"""What a method may see and do: its process can read libraries, its own folder and training data, and nothing else.

`python -m benchmarks.cell.sandbox SPEC MODULE ARGUMENT...` enters a sandbox and then runs `MODULE.main(ARGUMENTS)`.

On Linux, where the kernel lets a user make namespaces: a user namespace without capabilities, a file system of its own
that holds what `sandbox_for` lists, no network, and a process tree that ends with its first process. Before it is
entered nothing but the standard library and psutil is imported: the kernel refuses a new user namespace to a process
that has threads, and NumPy starts some.

A method is given a copy of the training part of a capture: training cameras, motion, images, scans where there are any,
and no truth. Without namespaces an audit hook of Python watches instead (`watched_folders`): opening or listing what
lies in the original is refused, and so is writing to the copy. It stops mistakes and ordinary cheating; a library that
opens files by itself, in C, is not noticed.
"""

import contextlib
import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    from ash.capture.dataset import Capture
    from benchmarks.cell.registry import Method

CLONE_NEWNS, CLONE_NEWIPC, CLONE_NEWUSER, CLONE_NEWPID, CLONE_NEWNET = 1 << 17, 1 << 27, 1 << 28, 1 << 29, 1 << 30
MS_RDONLY, MS_REMOUNT, MS_BIND, MS_REC, MS_PRIVATE = 1, 1 << 5, 1 << 12, 1 << 14, 1 << 18
LOCKED_FLAGS = 2 | 4 | 8 | 1024 | 2048  # nosuid, nodev, noexec, noatime, nodiratime: the kernel locks them
MNT_DETACH = 2
PR_SET_PDEATHSIG, PR_CAPBSET_DROP, PR_SET_NO_NEW_PRIVS, PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL = 1, 24, 38, 47, 4
PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}
MOUNT_SETATTR, AT_FDCWD, AT_RECURSIVE, ATTR_RDONLY = 442, -100, 0x8000, 1
CAPSET_VERSION = 0x20080522

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/etc", "/opt", "/sys", "/nix")
EMPTY = ("/tmp", "/var/tmp", "/dev/shm", "/run", "/root", "/home")
# Folders in a cell's folder: the method's own, the cameras and poses to render, the root of its file system.
WORK, TEST_VIEWS, BASE = "work", "test_views", "sandbox"
ISOLATION = "ASH_BENCH_ISOLATION"  # "off": do without namespaces, as where the kernel has none
SANDBOX_UNAVAILABLE = 77  # exit code of a process that could not enter its sandbox; standard error says why
COPIED = ("skeleton.json", "template.npz", "body.npz")
READING = ("open", "os.listdir", "os.scandir")
CHANGING = ("os.remove", "os.rename", "os.rmdir", "os.truncate", "os.chmod")
# What could make the closed folder seen under another name, or let another program look into it.
NAMING = ("os.link", "os.symlink")
STARTING = ("subprocess.Popen", "os.exec", "os.posix_spawn", "os.system", "ctypes.dlopen")
WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
METHOD_PATH = "ASH_BENCH_METHOD_PATH"  # folders of users' methods, as in PATH
LOUDEST, LAST_WORDS = 1 << 20, 1 << 14  # bytes of printing that are kept: the first of them, and the last


@dataclass(frozen=True, kw_only=True, slots=True)
class SandboxSpec:
    """What a method's process sees besides the system: absolute paths."""

    readable: tuple[str, ...]  # its input, libraries, its own sources
    writable: tuple[str, ...]  # its own folder
    hidden: tuple[str, ...]  # whatever lies above or below: empty folders stand there instead
    base: str  # an empty folder on which the new file system is put together


class SandboxUnavailable(OSError):
    """This kernel, or its settings, do not let us have a namespace."""


def enter_sandbox(spec: SandboxSpec) -> None:
    """Return in a process inside the sandbox; the calling process stays outside, waits, and ends as that one does.

    Raises:
        SandboxUnavailable: this system allows none; nothing has changed for the caller then.
    """
    if not sys.platform.startswith("linux") or os.uname().machine not in PIVOT_ROOT:
        raise SandboxUnavailable("namespaces are Linux's")
    uid, gid = os.getuid(), os.getgid()
    _call("unshare", CLONE_NEWUSER | CLONE_NEWPID | CLONE_NEWNET | CLONE_NEWIPC)
    _write("/proc/self/setgroups", "deny")
    _write("/proc/self/uid_map", f"{uid} {uid} 1")
    _write("/proc/self/gid_map", f"{gid} {gid} 1")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    first = os.fork()
    if first:
        _end_as(first)
    _die_with_parent()
    try:
        _mount_filesystem(spec)
        _drop_capabilities()
    except OSError as error:
        print(f"{error}", file=sys.stderr, flush=True)
        os._exit(SANDBOX_UNAVAILABLE)


def problem() -> str | None:
    """Why methods cannot be isolated on this machine, in one line; None where they can."""
    return f"{ISOLATION}=off" if os.environ.get(ISOLATION) == "off" else _kernel_problem()


@cache
def _kernel_problem() -> str | None:
    """What the kernel says when an empty file system of its own is asked for: tried in a process without threads."""
    with tempfile.TemporaryDirectory() as base:
        empty = SandboxSpec(readable=libraries(), writable=(), hidden=(), base=base)
        command = sandboxed(empty)
        tried = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    lines = tried.stderr.strip().splitlines()
    return None if tried.returncode == 0 else lines[-1] if lines else f"the trial ended with {tried.returncode}"


def libraries() -> tuple[str, ...]:
    """Where this interpreter and what it imports lie: read by every process of ours."""
    places = {sys.prefix, sys.base_prefix, str(Path(sys.executable).resolve().parent.parent)}
    places |= {str(Path(place).resolve()) for place in sys.path if place and place != os.getcwd()}
    places |= {place for place in os.environ.get("LD_LIBRARY_PATH", "").split(":") if place}
    home = Path.home() / ".cache"
    places |= {str(home / name) for name in ("torch", "huggingface")}
    return tuple(sorted(place for place in places if place.startswith("/") and os.path.exists(place)))


def _end_as(child: int) -> None:
    """Wait for a child and end as it did."""
    _die_with_parent()
    code = _exit_code(os.waitpid(child, 0)[1])
    if code > 128:
        signal.signal(code - 128, signal.SIG_DFL) if code - 128 not in (signal.SIGKILL, signal.SIGSTOP) else None
        os.kill(os.getpid(), code - 128)
    os._exit(code)


def _exit_code(status: int) -> int:
    return 128 + os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)


def _die_with_parent() -> None:
    parent = os.getppid()
    _call("prctl", PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def _mount_filesystem(spec: SandboxSpec) -> None:
    """Put the new file system together and make it the root."""
    _call("unshare", CLONE_NEWNS)
    _mount("none", "/", None, MS_REC | MS_PRIVATE)
    _mount("tmpfs", spec.base, "tmpfs", 0, "mode=755")
    for place in SYSTEM:
        if os.path.islink(place):
            os.symlink(os.readlink(place), spec.base + place)
        elif os.path.isdir(place):
            _bind(spec.base, place, read_only=True)
    _bind(spec.base, "/dev", read_only=False)
    os.makedirs(spec.base + "/proc", exist_ok=True)
    try:
        _mount("proc", spec.base + "/proc", "proc", 0)
    except SandboxUnavailable:  # In a container whose /proc is masked in part.
        _mount("/proc", spec.base + "/proc", None, MS_BIND | MS_REC)
    for settings in ("/proc/sys", "/proc/sysrq-trigger"):  # Of the machine; root outside may write them.
        if os.path.exists(spec.base + settings):
            _mount(spec.base + settings, spec.base + settings, None, MS_BIND | MS_REC)
            _make_read_only(spec.base + settings)
    for place in EMPTY:
        if os.path.isdir(place) or place == "/tmp":
            _empty(spec.base + place)
    for place in _outermost(spec.readable):
        _bind(spec.base, place, read_only=True)
    for place in spec.hidden:
        if os.path.isdir(spec.base + place):
            _empty(spec.base + place)
    for place in sorted(set(spec.readable)):  # What lies inside a hidden folder is put back.
        if not os.path.exists(spec.base + place):
            _bind(spec.base, place, read_only=True)
    for place in spec.writable:
        _bind(spec.base, place, read_only=False)
    os.chdir(spec.base)
    _syscall("pivot_root", PIVOT_ROOT[os.uname().machine], b".", b".")
    _call("umount2", b".", MNT_DETACH)
    os.chdir("/")


def _outermost(places: Iterable[str]) -> list[str]:
    """Those that lie in no other, and not in what the system gives."""
    outermost: list[str] = []
    for place in sorted(set(places)):
        if not any(place == above or place.startswith(above + "/") for above in (*outermost, "/usr", "/lib", "/opt")):
            outermost.append(place)
    return outermost


def _bind(base: str, place: str, *, read_only: bool) -> None:
    target = base + place
    if os.path.isdir(place):
        os.makedirs(target, exist_ok=True)
    elif not os.path.exists(target):
        os.makedirs(os.path.dirname(target), exist_ok=True)
        open(target, "x").close()
    _mount(place, target, None, MS_BIND | MS_REC)
    if read_only:
        _make_read_only(target)


def _make_read_only(target: str) -> None:
    attributes = (ctypes.c_uint64 * 4)(ATTR_RDONLY, 0, 0, 0)
    try:
        _syscall("mount_setattr", MOUNT_SETATTR, AT_FDCWD, target.encode(), AT_RECURSIVE, attributes, 32)
    except SandboxUnavailable:  # A kernel before 5.12: the folder itself, not what is mounted below.
        flags = os.statvfs(target).f_flag & LOCKED_FLAGS
        _mount("none", target, None, MS_REMOUNT | MS_BIND | MS_RDONLY | flags)


def _empty(target: str) -> None:
    os.makedirs(target, exist_ok=True)
    _mount("tmpfs", target, "tmpfs", 0, "mode=1777")


def _drop_capabilities() -> None:
    for capability in range(64):
        _libc().prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # Those that this kernel does not know are refused.
    _libc().prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL, 0, 0, 0)
    _call("prctl", PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    header, nothing = (ctypes.c_uint32 * 2)(CAPSET_VERSION, 0), (ctypes.c_uint32 * 6)()
    _call("capset", header, nothing)


def _mount(source: str, target: str, kind: str | None, flags: int, data: str = "") -> None:
    encoded = [value.encode() if value is not None else None for value in (source, target, kind)]
    _call("mount", *encoded, ctypes.c_ulong(flags), data.encode() or None, about=target)


def _write(path: str, text: str) -> None:
    try:
        with open(path, "w") as file:
            file.write(text)
    except OSError as error:
        raise SandboxUnavailable(error.errno, f"{path}: {error.strerror}") from error


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _call(name: str, *arguments: object, about: str = "") -> None:
    if getattr(_libc(), name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise SandboxUnavailable(number, f"{name}{about and ' ' + about}: {os.strerror(number)}")


def _syscall(name: str, number: int, *arguments: object) -> None:
    if _libc().syscall(ctypes.c_long(number), *arguments) != 0:
        error = ctypes.get_errno()
        raise SandboxUnavailable(error, f"{name}: {os.strerror(error)}")


def sandbox_for(
    place: Path,
    capture: "Capture",
    seen: "Capture",
    method: "Method",
    store: Path | None,
    *,
    secret: tuple[Path, ...] = (),
) -> SandboxSpec:
    """What a method sees: libraries, its own sources, its input; it writes to `place / WORK` alone."""
    from benchmarks.cell.registry import editable_folder, package_files

    packages = {folder for name in ("ash", "baselines", "benchmarks") for folder in _package_folders(name)}
    own = _package_folders(method.target) or {str(path.resolve()) for path in package_files(method.target)}
    with contextlib.suppress(PackageNotFoundError):
        if method.distribution and (project := editable_folder(distribution(method.distribution.rpartition(" ")[0]))):
            own.add(str(project.resolve()))
    readable = {*libraries(), *packages, *own, str(seen.folder.resolve()), str(place / TEST_VIEWS)}
    data = capture.folder.resolve()
    # The generator of truth is none of a method's business either.
    closed = {data, data.parent, place, place.parent, *(folder.resolve() for folder in secret)}
    hidden = {*map(str, closed), *_package_folders("synth")}
    return SandboxSpec(
        readable=tuple(sorted(readable)),
        writable=(str(place / WORK), *((str(store.resolve()),) if store is not None else ())),
        hidden=tuple(sorted(hidden - readable)),
        base=str(place / BASE),
    )


def _package_folders(target: str) -> set[str]:
    """Where the top-level package of `package.module:function` lies; nowhere for a single file."""
    spec = find_spec(target.partition(":")[0].split(".")[0])
    if spec is None or spec.submodule_search_locations is None:
        return set()
    # An editable installation lists an empty folder among its places; the package is where its first file is.
    places = {Path(spec.origin).parent} if spec.origin else {Path(place) for place in spec.submodule_search_locations}
    return {str(place.resolve()) for place in places}


class TruthAccessError(RuntimeError):
    """A method opened what it must not see."""


class InputModifiedError(TruthAccessError):
    """A method changed what it must not touch."""


def training_copy(capture: "Capture", folder: Path) -> "Capture":
    """A capture in `folder` (made anew) that holds the training part of `capture` and nothing else.

    Images are copies: what a method does to one never reaches the capture.
    """
    from ash.capture.dataset import background_path, image_path, scan_path
    from ash.capture.formats import load_capture, write_cameras, write_motion
    from ash.capture.manifest import Manifest, files_below
    from ash.files import sha256_of

    shutil.rmtree(folder, ignore_errors=True)
    seen = capture.training_only()
    for name in COPIED:
        if (capture.folder / name).exists():
            copy(capture.folder / name, folder / name)
    write_cameras(folder / "cameras.json", list(seen.cameras.values()))
    write_motion(folder / "motion.npz", seen.motion)
    for camera, frame in seen.splits["train"].views:
        copy(image_path(capture.folder, camera, frame), image_path(folder, camera, frame))
    for camera in seen.cameras:
        if background_path(capture.folder, camera).exists():
            copy(background_path(capture.folder, camera), background_path(folder, camera))
    for frame in seen.splits["train"].frames:
        if scan_path(capture.folder, frame).exists():
            copy(scan_path(capture.folder, frame), scan_path(folder, frame))
    made = {"cameras.json", "motion.npz"}
    known = {name: digest for name, digest in capture.manifest.files.items() if name not in made}
    files = {name: known.get(name) or sha256_of(folder / name) for name in files_below(folder)}
    Manifest(scene=capture.scene, seed=capture.manifest.seed, splits=seen.splits, files=files).write(folder)
    return load_capture(folder)


def copy(source: Path, target: Path) -> None:
    """Copy a file's bytes, making the folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


@contextmanager
def seen_by_method(capture: "Capture", folder: Path, *, oracle: bool, store: Path | None = None) -> Iterator["Capture"]:
    """The capture that a method gets: its training copy, kept in `folder` as long as the body runs.

    `store` outlives it: there methods keep what they derive from a capture for each other, such as the template.

    Oracles, which stand for a bound and no method, get a view of everything; so their numbers are no competitors'.
    """
    if oracle:
        yield replace(capture, store=store)
        return
    try:
        yield replace(training_copy(capture, folder), store=store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def watched(capture: "Capture", seen: "Capture") -> Iterator[None]:
    """While the body runs, a method's code: what lies in `capture` cannot be opened, what lies in `seen` not changed.

    An oracle, which sees the capture itself, is not watched.

    Raises:
        TruthAccessError: at the forbidden call, and again at the end in case that the method swallowed it.
    """
    with watched_folders([] if seen.folder == capture.folder else [str(capture.folder)], seen.folder):
        yield


@contextmanager
def watched_folders(closed: list[str], untouchable: Path) -> Iterator[None]:
    """As `watched`, by folders; nothing is watched where none is closed."""
    if not closed:
        yield
        return
    _install()
    _watch.closed, _watch.untouchable = os.path.realpath(closed[0]), os.path.realpath(untouchable)
    _watch.caught = None
    try:
        yield
    except BaseException as error:
        if _watch.caught is None or error is _watch.caught:
            raise
        raise _watch.caught from error
    finally:
        _watch.closed = _watch.untouchable = ""
    if _watch.caught:
        raise _watch.caught


class _Watch:
    """What is forbidden now. Python's audit hooks cannot be removed, so one is installed and reads this."""

    installed = False
    closed = ""
    untouchable = ""
    caught: TruthAccessError | None = None


_watch = _Watch()


def _install() -> None:
    if not _watch.installed:
        sys.addaudithook(_audit)
        _watch.installed = True


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watch.closed or not arguments:
        return
    if event in STARTING and _watch.closed in repr(arguments):
        _refuse(TruthAccessError(f"the method started {arguments[0]!r} on held-out views or truth"))
    if event not in (*READING, *CHANGING, *NAMING):
        return
    if not isinstance(arguments[0], (str, bytes, os.PathLike)):
        return  # A descriptor: whatever it belongs to was opened before.
    path = os.path.realpath(os.fsdecode(arguments[0]))
    if _inside(path, _watch.closed):
        _refuse(TruthAccessError(f"the method opened {path}: held-out views or truth"))
    changes = event in CHANGING or (event == "open" and bool((arguments[2] or 0) & WRITE_FLAGS))
    if changes and _inside(path, _watch.untouchable):
        _refuse(InputModifiedError(f"the method changed its input: {path}"))


def _inside(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + os.sep)


def _refuse(error: TruthAccessError) -> None:
    _watch.caught = _watch.caught or error
    raise error


def relay_output(output: IO[bytes]) -> None:
    """Print what the method prints: the first megabyte of it, and its last words."""
    printed, left_out, last = 0, 0, b""
    while part := os.read(output.fileno(), 1 << 16):
        now = part[: max(0, LOUDEST - printed)]
        os.write(2, now)
        printed += len(now)
        rest = part[len(now) :]
        left_out += len(rest)
        last = (last + rest)[-LAST_WORDS:]
    if left_out:
        os.write(2, f"\n({left_out - len(last)} bytes left out)\n".encode() + last)
    output.close()


def kill_process_tree(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and all its descendants, also those that left its process group or lost their parents.

    The tree is stopped first, until no new member is found: a process that was stopped starts no other. In a cell's
    process, which adopts what a method leaves behind (`adopt_orphans`), the orphans are killed as well.
    """
    stopped: dict[psutil.Process, None] = {}
    with contextlib.suppress(psutil.Error):
        root = psutil.Process(process.pid)
        while new := [member for member in (root, *root.children(recursive=True)) if member not in stopped]:
            for member in new:
                stopped[member] = None
                with contextlib.suppress(psutil.Error):
                    member.suspend()
    for member in reversed(stopped):  # The root last: it adopts the children of those that end before it.
        with contextlib.suppress(psutil.Error):
            member.kill()
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    process.wait()
    deadline = time.monotonic() + 5
    while (orphans := _orphans()) and time.monotonic() < deadline:
        for orphan in orphans:
            with contextlib.suppress(psutil.Error):
                for member in (*orphan.children(recursive=True), orphan):
                    member.kill()
        _reap()


def clean_environment() -> dict[str, str]:
    """Our environment for a child process, without what makes Python import the user's modules in place of ours."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}


def add_method_paths() -> None:
    """Append the folders of `--method-path` to `sys.path`: behind the libraries, so that they can replace none."""
    for path in os.environ.get(METHOD_PATH, "").split(os.pathsep):
        if path and path not in sys.path:
            sys.path.append(path)


def adopt_orphans() -> None:
    """Let what a method leaves behind become this process's child, so that it can be ended with the cell."""
    if sys.platform.startswith("linux"):
        import ctypes

        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def _orphans() -> list[psutil.Process]:
    if not _adopting():
        return []
    return psutil.Process().children()


def _adopting() -> bool:
    return os.environ.get("ASH_BENCH_CELL_PROCESS") == str(os.getpid())


def _reap() -> None:
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    time.sleep(0.02)


def peak_memory_mb(pid: int) -> float:
    """The largest resident memory that a process, or one that it started, had so far, MiB."""
    peaks = [0.0]
    with contextlib.suppress(psutil.Error):
        whole = psutil.Process(pid)
        peaks += [_peak_mb(member) for member in (whole, *whole.children(recursive=True))]
    return max(peaks)


def _peak_mb(process: psutil.Process) -> float:
    status = Path(f"/proc/{process.pid}/status")
    if status.exists():
        lines = [line for line in status.read_text().splitlines() if line.startswith("VmHWM")]
        return int(lines[0].split()[1]) / 1024 if lines else 0.0
    return float(process.memory_info().rss / 2**20)


def sandboxed(spec: SandboxSpec | None, *call: str) -> list[str]:
    """The command that runs `call` (a module, its arguments) in a sandbox; None: in none, but ended with its parent."""
    described = json.dumps(None if spec is None else asdict(spec))
    return [sys.executable, "-P", "-m", "benchmarks.cell.sandbox", described, *call]


def _enter_and_run(spec: dict[str, Any] | None, call: list[str]) -> int:
    if spec is None:
        if sys.platform.startswith("linux"):
            _die_with_parent()
    else:
        try:
            places = {name: tuple(spec[name]) for name in ("readable", "writable", "hidden")}
            enter_sandbox(SandboxSpec(**places, base=spec["base"]))
        except SandboxUnavailable as error:
            print(error, file=sys.stderr, flush=True)
            return SANDBOX_UNAVAILABLE
    code: int = import_module(call[0]).main(call[1:]) if call else 0
    return code


if __name__ == "__main__":
    sys.exit(_enter_and_run(json.loads(sys.argv[1]), sys.argv[2:]))
