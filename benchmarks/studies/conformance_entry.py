"""`python -m benchmarks.studies.conformance_entry FOLDER`: one trial of `check-method`, in a sandbox if possible.

FOLDER holds `sandbox.json`, what the process may see, or null. The sandbox is entered before anything but the standard
library is imported; then the trial begins (`benchmarks.studies.conformance_worker`).
"""

import json
import os
import sys
from pathlib import Path

from benchmarks.cell import sandbox


def main(argv: list[str]) -> int:
    """Enter the sandbox and do the trial; exit code 77 where this system allows none."""
    folder = Path(argv[0])
    spec = json.loads((folder / "sandbox.json").read_text())
    if spec is None:
        sandbox.end_with_parent()
    else:
        try:
            seen = {name: tuple(spec[name]) for name in ("readable", "writable", "hidden")}
            sandbox.enter_sandbox(sandbox.SandboxSpec(**seen, base=spec["base"]))
        except sandbox.SandboxUnavailable as error:
            print(error, file=sys.stderr, flush=True)
            return sandbox.SANDBOX_UNAVAILABLE
    os.chdir(folder)
    from benchmarks.studies.conformance_worker import main as do_trial

    return do_trial(folder)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
