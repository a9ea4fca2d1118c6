"""A sandbox for a method: a process that can read libraries, its own folder and training data, and nothing else.

On Linux, where the kernel lets a user make namespaces: a user namespace without capabilities, a file system of its own
that holds what is listed below, no network, and a process tree that ends with its first process. Only the standard
library is used here: the kernel refuses a new user namespace to a process that has threads, and NumPy starts some.
"""

import ctypes
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

CLONE_NEWNS, CLONE_NEWIPC, CLONE_NEWUSER, CLONE_NEWPID, CLONE_NEWNET = 1 << 17, 1 << 27, 1 << 28, 1 << 29, 1 << 30
MS_RDONLY, MS_REMOUNT, MS_BIND, MS_REC, MS_PRIVATE = 1, 1 << 5, 1 << 12, 1 << 14, 1 << 18
KEPT_FLAGS = 2 | 4 | 8 | 1024 | 2048  # nosuid, nodev, noexec, noatime, nodiratime: the kernel locks them
MNT_DETACH = 2
PR_SET_PDEATHSIG, PR_CAPBSET_DROP, PR_SET_NO_NEW_PRIVS, PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL = 1, 24, 38, 47, 4
PIVOT_ROOT = {"x86_64": 155, "aarch64": 41}
MOUNT_SETATTR, AT_FDCWD, AT_RECURSIVE, ATTR_RDONLY = 442, -100, 0x8000, 1
CAPSET_VERSION = 0x20080522

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/etc", "/opt", "/sys", "/nix")
EMPTY = ("/tmp", "/var/tmp", "/dev/shm", "/run", "/root", "/home")
ISOLATION = "ASH_BENCH_ISOLATION"  # "off": do without namespaces, as where the kernel has none
SANDBOX_UNAVAILABLE = 77  # exit code of a process that could not enter its sandbox; standard error says why


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
    # The first process of a process namespace is deaf to signals from inside: it only waits for the one that works.
    worker = os.fork()
    if worker:
        os._exit(_exit_code(os.waitpid(worker, 0)[1]))
    _die_with_parent()


def problem() -> str | None:
    """Why methods cannot be isolated on this machine, in one line; None where they can."""
    return f"{ISOLATION}=off" if os.environ.get(ISOLATION) == "off" else _kernel_problem()


@cache
def _kernel_problem() -> str | None:
    """What the kernel says when an empty file system of its own is asked for: tried in a process without threads."""
    with tempfile.TemporaryDirectory() as base:
        command = [sys.executable, "-P", "-m", "benchmarks.cell.sandbox", base]
        tried = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    lines = tried.stderr.strip().splitlines()
    return None if tried.returncode == 0 else lines[-1] if lines else f"the trial ended with {tried.returncode}"


def end_with_parent() -> None:
    """Without a sandbox: end when the parent ends, whatever ends it."""
    if sys.platform.startswith("linux"):
        _die_with_parent()


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
    found: list[str] = []
    for place in sorted(set(places)):
        if not any(place == above or place.startswith(above + "/") for above in (*found, "/usr", "/lib", "/opt")):
            found.append(place)
    return found


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
        kept = os.statvfs(target).f_flag & KEPT_FLAGS
        _mount("none", target, None, MS_REMOUNT | MS_BIND | MS_RDONLY | kept)


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


if __name__ == "__main__":
    try:
        enter_sandbox(SandboxSpec(readable=libraries(), writable=(), hidden=(), base=sys.argv[1]))
    except SandboxUnavailable as error:
        print(error, file=sys.stderr, flush=True)
        sys.exit(SANDBOX_UNAVAILABLE)
