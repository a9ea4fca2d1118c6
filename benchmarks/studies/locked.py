"""`python -m benchmarks.studies.locked FOLDER`: one trial of `check-method`, in a room of its own where there is one.

FOLDER holds `room.json`, what the process may see, or null. The room is entered before anything but the standard
library is imported; then the trial begins (`benchmarks.studies.trial`).
"""

import json
import os
import sys
from pathlib import Path

from benchmarks.cell import isolation


def main(argv: list[str]) -> int:
    """Enter the room and do the trial; exit code 77 where this system has no such rooms."""
    folder = Path(argv[0])
    room = json.loads((folder / "room.json").read_text())
    if room is None:
        isolation.end_with_parent()
    else:
        try:
            seen = {name: tuple(room[name]) for name in ("readable", "writable", "hidden")}
            isolation.enter(isolation.Room(**seen, base=room["base"]))
        except isolation.Refused as error:
            print(error, file=sys.stderr, flush=True)
            return isolation.REFUSED
    os.chdir(folder)
    from benchmarks.studies.trial import main as do_trial

    return do_trial(folder)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
