"""What a run came to as one small file for a repository: every number of every cell, without avatars and pictures.

Unpacked, it is a run again, of which `report` and `compare` read all but pictures: a suite can be made in several
sittings, and on machines that keep nothing, and be reported as one.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

from ash.files import read_json, write_atomic
from benchmarks.suites.runs import RUN_FILE, Run, description_of

WHEN = (1980, 1, 1, 0, 0, 0)  # of every entry, so that equal runs are equal bytes


def write_archive(run: Run, path: Path) -> None:
    """Write `run.json` and the `config.json` and `result.json` of every finished cell into a zip file.

    Of a capture's folder only the name is kept, of brought pictures none: where they lay says nothing to others.
    """
    keys: list[str] = []
    entries: dict[str, Any] = {}
    for cell in run.cells:
        if (cell.folder / "result.json").exists():
            config = read_json(cell.folder / "config.json")  # A gathered run may call the scene by another name.
            keys.append(config["key"])
            config = {name: value for name, value in config.items() if name not in ("predictions", "info")}
            entries[f"cells/{keys[-1]}/config.json"] = config | {"capture_folder": cell.capture_folder.name}
            entries[f"cells/{keys[-1]}/result.json"] = read_json(cell.folder / "result.json")
    entries[RUN_FILE] = description_of(run) | {"cells": keys}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in entries.items():
            info = zipfile.ZipInfo(name, date_time=WHEN)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, json.dumps(content, sort_keys=True, allow_nan=False))
    write_atomic(path, buffer.getvalue())
