"""A method's process, and those that it starts: what they print, how much memory they take, and how they all end."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

import psutil

METHOD_PATH = "ASH_BENCH_METHOD_PATH"  # folders of users' methods, as in PATH
LOUDEST, LAST_WORDS = 1 << 20, 1 << 14  # bytes of printing that are kept: the first of them, and the last


def relay_output(output: IO[bytes]) -> None:
    """Print what the method prints: the first megabyte of it, and its last words."""
    kept, left_out, last = 0, 0, b""
    while part := os.read(output.fileno(), 1 << 16):
        now = part[: max(0, LOUDEST - kept)]
        os.write(2, now)
        kept += len(now)
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
