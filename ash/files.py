"""Files that survive crashes and inputs that cannot be trusted: atomic writes, hashes, checked reads."""

import contextlib
import errno
import fcntl
import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import Image

# What a file from elsewhere may hold at most; a reader that knows more of its file asks for less.
LIMITS = {
    "json bytes": 1 << 30,  # the manifest of a million images has 200 MB
    "npz bytes": 4 << 30,  # all arrays that are asked for, unpacked: the truth of 25,000 frames has 3.3 GB
    "motion bytes": 128 << 20,  # of motion.npz, unpacked: 25,000 frames of 100 joints have 60 MB
    "mesh bytes": 1 << 30,  # of template.npz, unpacked: 100,000 vertices and 100 joints have 90 MB
    "npz entries": 1 << 16,
    "npy header bytes": 1 << 16,
    "npy dimensions": 8,
    "image pixels": 1 << 26,
    "message characters": 1000,
}
PLAIN = re.compile(r"[\w][\w .:+=@-]{0,199}")
ARRAY_KINDS = "biufSU"  # no objects, records, dates or complex numbers
PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
SOURCE_SUFFIXES = frozenset({".py", ".cpp", ".h", ".inc", ".txt"})  # CMakeLists.txt decides how kernels are compiled.


class InputError(ValueError):
    """The user's input is wrong. The message says in one line what was expected and what came; the exit code is 2."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """A message as one line: what a file or a method put into it can neither steer a terminal nor fill it."""
    plain = "".join(c if c.isprintable() else " " for c in text[: 2 * LIMITS["message characters"]])
    most = LIMITS["message characters"]
    return plain if len(plain) <= most else f"{plain[: most - 4]} ..."


_UMASK = os.umask(0o022)
os.umask(_UMASK)


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old content or all of the new, never a part, even after a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(descriptor, 0o666 & ~_UMASK)  # Temporary files are private; reports and captures are shared.
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def source_files(*roots: Path, without: tuple[Path, ...] = ()) -> list[Path]:
    """Every file of source below the roots, but for those below `without`. A root may be a file."""
    paths = {path for root in roots for path in (root.rglob("*") if root.is_dir() else (root,))}
    return sorted(
        path
        for path in paths
        if path.suffix in SOURCE_SUFFIXES and not any(path.is_relative_to(folder) for folder in without)
    )


def hash_sources(*roots: Path, without: tuple[Path, ...] = ()) -> str:
    """SHA-256 over the names (from their root on) and bytes of `source_files`."""
    digest = hashlib.sha256()
    for root in roots:
        for path in source_files(root, without=without):
            name = path.relative_to(root.parent).as_posix()
            digest.update(f"{name} {path.stat().st_size}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def write_json(path: Path, value: Any) -> None:
    """Write JSON with sorted keys, so that equal values are equal bytes. NaN and infinity are refused."""
    write_atomic(path, (json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write named arrays as a compressed `.npz` whose bytes depend on the arrays alone (no time stamps)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in sorted(arrays):
            entry = io.BytesIO()
            np.lib.format.write_array(entry, np.asarray(arrays[name], order="C"), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, entry.getvalue())
    write_atomic(path, buffer.getvalue())


def write_image(path: Path, rgba: np.ndarray) -> None:
    """Write a uint8 `[h, w, 4]` or `[h, w, 3]` image as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(rgba).save(buffer, format="PNG", compress_level=4)
    write_atomic(path, buffer.getvalue())


def require_plain(name: Any, *, what: str, may_be_empty: bool = False) -> str:
    """A name that may become part of a path: letters, digits and a few signs, never a way up or out.

    Raises:
        ValueError: it is none.
    """
    if isinstance(name, str) and ((may_be_empty and not name) or PLAIN.fullmatch(name)) and ".." not in name:
        return name
    raise ValueError(f"expected a plain name for the {what}, got {name!r:.100}")


def open_regular(path: Path, *, most: int) -> BinaryIO:
    """Open a file for reading: a regular one of at most `most` bytes. A pipe or a device would never end.

    Raises:
        InputError: no such file, no regular file, or too large.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and status.st_size <= most:
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: {status.st_size} bytes, expected at most {most}")
    raise InputError(f"{path}: expected a regular file")


def read_json(path: Path, *, most: int = LIMITS["json bytes"]) -> Any:
    """Read JSON of finite numbers, or raise an InputError that names the file."""
    with open_regular(path, most=most) as file:
        content = file.read()
    try:
        return json.loads(content, parse_constant=_refuse_constant, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word}, expected finite numbers")


def _finite(word: str) -> float:
    if not math.isfinite(value := float(word)):
        raise ValueError(f"{word[:40]}, expected finite numbers")
    return value


def read_arrays(path: Path, *, expected: tuple[str, ...], most: int = LIMITS["npz bytes"]) -> dict[str, np.ndarray]:
    """Read the named arrays of an `.npz`, together of at most `most` bytes: numbers, booleans or text.

    Shapes are known from the headers before memory is taken.

    Raises:
        InputError: the file is missing, damaged, too large, lacks a name, or holds NaN, infinity or objects.
    """
    try:
        with open_regular(path, most=most) as file, zipfile.ZipFile(file) as archive:
            if len(archive.filelist) > LIMITS["npz entries"]:
                raise ValueError(f"{len(archive.filelist)} entries, expected at most {LIMITS['npz entries']}")
            promised = {name: _promised_bytes(archive, name) for name in expected}
            if sum(promised.values()) > most:
                raise ValueError(f"{sum(promised.values())} bytes unpacked, expected at most {most}")
            arrays = {name: _read_array(archive, name) for name in expected}
    except InputError:
        raise
    except Exception as error:  # NumPy and zipfile meet damage with a dozen kinds of errors.
        raise InputError(f"{path}: expected an .npz archive with {', '.join(expected)} ({error})") from error
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: {name} holds NaN or infinity, expected finite numbers")
    return arrays


def array_names(path: Path, *, most: int = LIMITS["npz bytes"]) -> list[str]:
    """The names of the arrays in an `.npz`.

    Raises:
        InputError: the file is missing, damaged or too large.
    """
    try:
        with open_regular(path, most=most) as file, zipfile.ZipFile(file) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()[: LIMITS["npz entries"]]]
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: expected an .npz archive ({error})") from error


def _promised_bytes(archive: zipfile.ZipFile, name: str) -> int:
    """How large an array is, by its header alone."""
    info = archive.getinfo(f"{name}.npy")
    if info.compress_type not in PACKED:
        raise ValueError(f"{name} is packed by method {info.compress_type}, expected deflate or none")
    with archive.open(info) as entry:
        magic = entry.read(8)
        version, width = tuple(magic[6:8]), 2 if magic[6:7] == b"\x01" else 4
        length = entry.read(width)
        if magic[:6] != b"\x93NUMPY" or version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"{name} is no array")
        if (size := int.from_bytes(length, "little")) > LIMITS["npy header bytes"]:
            raise ValueError(f"{name} has a header of {size} bytes, expected at most {LIMITS['npy header bytes']}")
        header = io.BytesIO(length + entry.read(size))
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(header)
    if dtype.kind not in ARRAY_KINDS or len(shape) > LIMITS["npy dimensions"] or any(n < 0 for n in shape):
        raise ValueError(f"{name} is of {dtype} {shape}, expected numbers")
    promised = math.prod(int(n) for n in shape) * dtype.itemsize
    if promised > info.file_size:
        raise ValueError(f"{name} promises {promised} bytes and the archive holds {info.file_size}")
    return promised


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(f"{name}.npy") as entry:
        return np.lib.format.read_array(entry, allow_pickle=False)


def read_image(path: Path, *, shape: tuple[int, ...]) -> np.ndarray:
    """Read a PNG as uint8 of exactly `shape`, or raise an InputError that names the file."""
    expected = f"a PNG image of shape {shape}, uint8"
    try:
        with open_regular(path, most=16 * LIMITS["image pixels"]) as file:
            content = io.BytesIO(file.read())  # Pillow asks a file for as many bytes as a chunk claims to have.
        with Image.open(content, formats=["PNG"]) as image:
            size, bands = (image.height, image.width), image.getbands()
            if size != shape[:2] or size[0] * size[1] > LIMITS["image pixels"] or len(bands) != (*shape, 1)[2]:
                raise InputError(f"{path}: expected {expected}, got {image.mode} {size}")
            pixels = np.array(image)
    except InputError:
        raise
    except Exception as error:  # Pillow meets damage with a dozen kinds of errors.
        raise InputError(f"{path}: expected {expected} ({error})") from error
    if pixels.shape != shape or pixels.dtype != np.uint8:
        raise InputError(f"{path}: expected {expected}, got {pixels.dtype} {pixels.shape}")
    return pixels


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_of(value: Any) -> str:
    """Hex SHA-256 of a JSON-able value: the identity of a config, a cell or a random stream."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()


MENDABLE = {
    errno.ENOSPC: "no space left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file would be larger than the system allows",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
    errno.ENOTDIR: "a part of the path is a file, expected a folder",
    errno.EEXIST: "expected a folder, got a file",
    errno.EISDIR: "expected a file, got a folder",
    errno.ENOENT: "no such file or folder",
    errno.ENAMETOOLONG: "the name is too long",
}


def disk_problem(error: OSError) -> str | None:
    """One line about an error of the file system that a user can mend, or None for any other error."""
    if error.errno not in MENDABLE:
        return None
    where = error.filename2 or error.filename
    return f"{where}: {MENDABLE[error.errno]}" if where else MENDABLE[error.errno]


@contextlib.contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the lock ends with the process, however that ends.

    Raises:
        InputError: another process holds it.
    """
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder}: another ash-bench is at work there; wait for it or choose another --out"
            ) from None
        yield


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or a copy where it lies on another disk."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another disk
        shutil.copyfile(source, target)


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold the right to make a file; the lock goes with the process that holds it, however that ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
