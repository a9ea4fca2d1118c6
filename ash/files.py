"""Files that survive crashes and inputs that cannot be trusted: atomic writes, hashes, checked reads."""

import hashlib
import io
import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

MAX_ARRAY_BYTES = 8 << 30
MAX_IMAGE_PIXELS = 1 << 26


class InputError(ValueError):
    """The user's input is wrong. The message says what was expected and what came; the exit code is 2."""


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


def read_json(path: Path) -> Any:
    """Read JSON, or raise an InputError that names the file."""
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: expected a JSON file ({error.strerror})") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error


def read_arrays(path: Path, *, expected: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read the named arrays of an `.npz`.

    Pickled objects are refused, and so is an array whose header promises more bytes than the archive holds.

    Raises:
        InputError: the file is missing, damaged, lacks a name, or holds NaN or infinity.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in expected:
                arrays[name] = _read_array(archive, name)
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zipfile.zlib.error) as error:  # type: ignore[attr-defined]
        raise InputError(f"{path}: expected an .npz archive with {', '.join(expected)} ({error})") from error
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: {name} holds NaN or infinity, expected finite numbers")
    return arrays


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as entry:
        version = np.lib.format.read_magic(entry)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(entry)
    promised = int(np.prod(shape, dtype=np.float64)) * dtype.itemsize
    if promised > min(info.file_size, MAX_ARRAY_BYTES):
        raise ValueError(f"{name} promises {promised} bytes and the archive holds {info.file_size}")
    with archive.open(info) as entry:
        return np.lib.format.read_array(entry, allow_pickle=False)


def read_image(path: Path, *, shape: tuple[int, ...]) -> np.ndarray:
    """Read a PNG as uint8 of exactly `shape`, or raise an InputError that names the file."""
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise InputError(f"{path}: {image.width}x{image.height} is larger than any image of ours")
            pixels = np.array(image)
    except (OSError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a PNG image of shape {shape} ({error})") from error
    if pixels.shape != shape or pixels.dtype != np.uint8:
        raise InputError(f"{path}: expected a uint8 image of shape {shape}, got {pixels.dtype} {pixels.shape}")
    return pixels


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_of(value: Any) -> str:
    """Hex SHA-256 of a JSON-able value: the identity of a config, a cell or a random stream."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, allow_nan=False).encode()).hexdigest()
