"""What a method sees of a capture: a copy with the training part alone, and no way back to the rest by opening files.

The copy is a capture of its own: training cameras, training motion, training images, scans where there are any, and no
truth. While the method's code runs, opening or listing anything inside the original is refused and remembered, and so
is writing to the copy. The watch is Python's audit hook: it sees what Python opens, whatever library asks it to,
and stops mistakes and ordinary cheating. It is no prison: a library that opens files by itself, in C, is not seen.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ash.capture.dataset import Capture, background_path, image_path, scan_path
from ash.capture.formats import load_capture, write_cameras, write_motion
from ash.capture.manifest import Manifest, files_below
from ash.files import sha256_of

KEPT_AS_THEY_ARE = ("skeleton.json", "template.npz", "body.npz")
READING = ("open", "os.listdir", "os.scandir")
CHANGING = ("os.remove", "os.rename", "os.rmdir", "os.truncate", "os.chmod")
# What could make the closed folder seen under another name, or let another program look into it.
NAMING = ("os.link", "os.symlink")
STARTING = ("subprocess.Popen", "os.exec", "os.posix_spawn", "os.system", "ctypes.dlopen")
WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class TruthAccessError(RuntimeError):
    """A method opened what it must not see."""


class InputModifiedError(TruthAccessError):
    """A method changed what it must not touch."""


def training_copy(capture: Capture, folder: Path) -> Capture:
    """A capture in `folder` (made anew) that holds the training part of `capture` and nothing else.

    Images are copies: what a method does to one never reaches the capture.
    """
    shutil.rmtree(folder, ignore_errors=True)
    seen = capture.training_only()
    for name in KEPT_AS_THEY_ARE:
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
def seen_by_method(capture: Capture, folder: Path, *, oracle: bool, store: Path | None = None) -> Iterator[Capture]:
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
def watched(capture: Capture, seen: Capture) -> Iterator[None]:
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
