"""Packs that somebody changed after they were made."""

import json
import zipfile
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

Files = dict[str, bytes]


def read_files(pack: Path) -> Files:
    """What an archive holds, by name."""
    with zipfile.ZipFile(pack) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_files(pack: Path, files: Files) -> None:
    """An archive of files."""
    with zipfile.ZipFile(pack, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def change(pack: Path, edit: Callable[[Files], object], *, hashes: bool = True) -> None:
    """Change a pack as its author could: with hashes that fit what is in it now, if `hashes`."""
    files = read_files(pack)
    edit(files)
    if hashes:
        index = json.loads(files["pack.json"])
        index["files"] = {name: sha256(files[name]).hexdigest() for name in files if name != "pack.json"}
        files["pack.json"] = json.dumps(index).encode()
    write_files(pack, files)


def change_json(suffix: str, edit: Callable[[dict], object]) -> Callable[[Files], None]:
    """An edit of the first file whose name ends so."""

    def apply(files: Files) -> None:
        name = next(name for name in files if name.endswith(suffix))
        content = json.loads(files[name])
        edit(content)
        files[name] = json.dumps(content).encode()

    return apply
