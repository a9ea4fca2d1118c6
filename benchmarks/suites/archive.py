"""Runs as one file, written here and read as hostile input.

`cells.zip` holds every number of every cell, without avatars and pictures, for a repository. A pack also holds the
pictures that were scored and `pack.json`: SHA-256 of every file and of the checkpoints, which are not in it. Either is
a run again, of which `report`, `compare`, `claims` and `leaderboard` read all that is there.
"""

import contextlib
import json
import os
import re
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from ash.capture.typed import from_json
from ash.files import PACKED, PLAIN, InputError, disk_problem, open_regular, read_json, sha256_of
from benchmarks.cell.metrics import IMAGE_SPLITS, PROTOCOL
from benchmarks.cell.schema import CHECKPOINT, prediction_path, result_of
from benchmarks.provenance import commit, machine, versions
from benchmarks.suites.runs import RUN_FILE, Run, description_of, read_run

PACK_FILE = "pack.json"
PACK_SCHEMA = 1
WHEN = (1980, 1, 1, 0, 0, 0)  # of every entry, so that equal runs are equal bytes
CELL_FILES = rf"(?:config\.json|result\.json|images/(?:{'|'.join(IMAGE_SPLITS)})/{PLAIN.pattern}/\d{{6,9}}\.png)"
ENTRY = re.compile(rf"run\.json|pack\.json|cells/[0-9a-f]{{16}}/{CELL_FILES}")
# What an archive may hold at most. No zip64: 65,535 files and 4 GiB.
LARGEST_ARCHIVE, LARGEST_UNPACKED = (1 << 32) - 1, 1 << 32  # bytes
LARGEST_JSON, LARGEST_PICTURE, LARGEST_INDEX = 1 << 25, 1 << 26, 1 << 25  # bytes
MOST_RATIO = 200  # bytes unpacked from one; our JSON shrinks to a twentieth


@dataclass(frozen=True, kw_only=True, slots=True)
class PackFile:
    """`pack.json`. Whoever makes a pack can make these hashes too: they show damage, not who made it."""

    schema: int
    protocol: str
    files: dict[str, str]  # SHA-256 of every other file of the pack
    checkpoints: dict[str, str] = field(default_factory=dict)  # SHA-256 of the avatar, by the cell's key
    commit: str = ""  # of the program that packed; results name the one that made them
    machine: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)


def write_archive(run: Run, path: Path) -> None:
    """Write `run.json` and the `config.json` and `result.json` of every finished cell into a zip file."""
    _write(path, numbers_of(run))


def write_pack(run: Run, path: Path) -> PackFile:
    """Write what `write_archive` does, the scored pictures, and hashes of all and of the checkpoints.

    Raises:
        InputError: no cell is finished, a picture is missing, or the pack would be larger than 4 GiB.
    """
    done = [(cell, result) for cell in run.cells if (result := result_of(cell)) is not None]
    if not done:
        raise InputError(f"{run.folder}: no cell is finished, so there is nothing to pack")
    trained = {cell.config.key: cell.folder / CHECKPOINT for cell, _ in done if (cell.folder / CHECKPOINT).is_file()}
    checkpoints = {key: sha256_of(file) for key, file in trained.items()}
    about: dict[str, Any] = {"commit": commit(), "machine": machine(), "versions": versions()}
    pack = PackFile(schema=PACK_SCHEMA, protocol=PROTOCOL, files={}, checkpoints=checkpoints, **about)

    def entries() -> Iterator[tuple[str, bytes]]:
        yield from numbers_of(run)
        for cell, result in done:
            for view in result.views:
                with open_regular(prediction_path(cell.folder, view), most=LARGEST_PICTURE) as file:
                    yield prediction_path(Path("cells") / result.config.key, view).as_posix(), file.read()

    def hashed() -> Iterator[tuple[str, bytes]]:
        for name, content in entries():
            pack.files[name] = sha256(content).hexdigest()
            yield name, content
        yield PACK_FILE, json.dumps(asdict(pack), sort_keys=True).encode()

    _write(path, hashed())
    return pack


def numbers_of(run: Run) -> Iterator[tuple[str, bytes]]:
    """Name and content of `run.json` and of each finished cell's `config.json` and `result.json`.

    Of a capture's folder only the name is kept, of brought pictures none, and of other absolute paths what
    `without_places` leaves: where they lay says nothing to others.
    """
    keys: list[str] = []
    for cell in run.cells:
        if (cell.folder / "result.json").exists():
            config = read_json(cell.folder / "config.json")  # A gathered run may call the scene by another name.
            keys.append(config["key"])
            config = {name: value for name, value in config.items() if name not in ("predictions", "info")}
            name = re.sub(r"[^\w .:+=@-]", "_", cell.capture_folder.name)
            yield f"cells/{keys[-1]}/config.json", _json(config | {"capture_folder": name})
            yield f"cells/{keys[-1]}/result.json", _json(read_json(cell.folder / "result.json"))
    told = {"about": without_places(run.about), "command": without_places(run.command)}
    yield RUN_FILE, _json(description_of(run) | {"cells": keys} | told)


def without_places(text: str) -> str:
    """A command or a page whose absolute paths keep their last two names: `data/loose` of `/home/me/data/loose`."""
    return re.sub(r"(?<![\w.:/])/(?:[^/\s,;'\"]+/)+(?=[^/\s,;'\"]+/[^/\s,;'\"]+)", "", text)


def _json(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True, allow_nan=False).encode()


def _write(path: Path, entries: Iterable[tuple[str, bytes]]) -> None:
    """Write a zip file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".pack-") as folder:
        part = Path(folder) / "zip"
        try:
            with zipfile.ZipFile(part, "w", allowZip64=False) as archive:
                for name, content in entries:
                    info = zipfile.ZipInfo(name, date_time=WHEN)
                    info.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
                    archive.writestr(info, content)
        except zipfile.LargeZipFile as error:
            raise InputError(f"{path}: would be larger than 4 GiB or 65,535 files; pack fewer cells") from error
        with part.open("rb") as whole:
            os.fsync(whole.fileno())
        part.replace(path)


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The folder of a run that a pack or a `cells.zip` holds, for as long as the block lasts.

    Names, kinds and sizes of all entries are checked before one of them is unpacked.

    Raises:
        InputError: damaged, too large, or an entry that a pack does not have; errors of the block name the archive.
    """
    with tempfile.TemporaryDirectory(prefix="ash-bench-pack-") as name:
        try:
            with open_regular(path, most=LARGEST_ARCHIVE) as file:
                _require_small_index(file)
                with zipfile.ZipFile(file) as archive:
                    _unpack(archive, Path(name))
        except InputError:
            raise
        except Exception as error:  # zipfile meets damage with a dozen kinds of errors.
            if isinstance(error, OSError) and disk_problem(error) is not None:
                raise
            raise InputError(f"{path}: expected a pack, as `ash-bench pack` writes it ({error})") from error
        try:
            yield Path(name)
        except InputError as error:
            raise InputError(str(error).replace(name, str(path))) from error


@contextlib.contextmanager
def opened(paths: Sequence[Path]) -> Iterator[list[Run]]:
    """The runs of folders, of single cells' folders, of packs and of `cells.zip`, for as long as the block lasts.

    Each is called as it was given (`Run.folder`), also where its cells lie in a temporary folder.

    Raises:
        InputError: see `read_run` and `unpacked`.
    """
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(unpacked(path)) if path.is_file() else path for path in paths]
        yield [replace(read_run(folder), folder=path) for folder, path in zip(folders, paths, strict=True)]


def folder_of(path: Path) -> Path:
    """The folder of a run, or the one that its archive lies in: where its pages are."""
    return path.parent if path.is_file() else path


def _require_small_index(file: Any) -> None:
    """Refuse what zipfile would read into memory unasked: an index of any size."""
    size = file.seek(0, 2)
    file.seek(max(0, size - 42))
    end = file.read().rjust(42, b"\0")  # a zip64 locator where there is one, and the end record
    if end[20:24] != b"PK\5\6" or end[:4] == b"PK\6\7":
        raise ValueError("no plain end of a zip file")
    index, start = struct.unpack("<II", end[32:40])
    if index > LARGEST_INDEX or index + start > size:
        raise ValueError(f"an index of {index} bytes")


def _unpack(archive: zipfile.ZipFile, folder: Path) -> None:
    entries = archive.infolist()
    for entry in entries:
        _require_entry(entry)
    if len({entry.filename for entry in entries}) < len(entries):
        raise ValueError("a name stands there twice")
    total = sum(entry.file_size for entry in entries)
    if total > min(LARGEST_UNPACKED, shutil.disk_usage(folder).free):
        raise ValueError(f"{total} bytes unpacked, expected at most {LARGEST_UNPACKED} and room on the disk")
    for entry in entries:
        target = folder / entry.filename
        target.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(entry) as source, target.open("xb") as sink:
            shutil.copyfileobj(source, sink)


def _require_entry(entry: zipfile.ZipInfo) -> None:
    name = entry.filename
    if entry.orig_filename != name or ENTRY.fullmatch(name) is None:
        raise ValueError(f"an entry {entry.orig_filename!r:.120} has no place in a pack")
    if (entry.external_attr >> 28) not in (0, 0o10):  # the kind of file, of Unix
        raise ValueError(f"{name} is no regular file")
    if entry.flag_bits & 1 or entry.compress_type not in PACKED:
        raise ValueError(f"{name} is encrypted or packed by method {entry.compress_type}, expected deflate or none")
    most = LARGEST_PICTURE if name.endswith(".png") else LARGEST_JSON
    if entry.file_size > most or entry.file_size > MOST_RATIO * entry.compress_size + 1000:
        raise ValueError(f"{name} unpacks from {entry.compress_size} to {entry.file_size} bytes")


def read_pack(folder: Path) -> PackFile:
    """Read and check `pack.json` of an unpacked pack.

    Raises:
        InputError: it is missing or damaged, of another protocol, or not of the files that are there.
    """
    path = folder / PACK_FILE
    if not path.exists():
        raise InputError(f"{folder}: expected a pack, as `ash-bench pack` writes it; {PACK_FILE} is missing")
    try:
        pack: PackFile = from_json(PackFile, read_json(path, most=LARGEST_JSON))
    except ValueError as error:
        raise InputError(str(error) if isinstance(error, InputError) else f"{path}: {error}") from error
    if (pack.schema, pack.protocol) != (PACK_SCHEMA, PROTOCOL):
        got = f"{pack.schema!s:.20} and {pack.protocol:.20}"
        raise InputError(f"{path}: expected schema {PACK_SCHEMA} and protocol {PROTOCOL}, got {got}")
    files = {each.relative_to(folder).as_posix(): each for each in folder.rglob("*") if each.is_file()}
    del files[PACK_FILE]
    for name in sorted(files.keys() ^ pack.files.keys()):
        raise InputError(f"{folder / name}: {'not in pack.json' if name in files else 'missing'}")
    for name, file in files.items():
        if sha256_of(file) != pack.files[name]:
            raise InputError(f"{folder / name}: altered (SHA-256 differs from pack.json)")
    return pack
