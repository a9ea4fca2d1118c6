"""The command that checks a method against the rules: check-method."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from ash.files import InputError
from benchmarks.commands.arguments import DONE, FAILED, Count, Folder, Positional


@dataclass(frozen=True, kw_only=True)
class CheckMethodCommand:
    """Check that a method keeps the rules (docs/plugin.md)."""

    method: Positional[str]  # an entry point, or package.module:factory
    capture: Folder | None = None  # train on this capture; default: mannequin, size ci
    preset: str = "ci"  # budget of the method
    minutes: Count = 10  # limit of each of the four trials
    memory_mb: Count = 4096  # likewise
    workers: Count | None = None  # trials side by side; default: all cores
    data: Folder = Path("data")  # where captures are kept
    out: Folder | None = None  # keep the trials there; default: they are removed

    def __call__(self) -> int:
        """Whether a method keeps the rules of docs/plugin.md."""
        from benchmarks.cell.registry import find_method
        from benchmarks.provenance import cores
        from benchmarks.studies.conformance import check_method as check
        from benchmarks.studies.conformance import table
        from benchmarks.suites.captures import make_capture, require_intact
        from benchmarks.suites.engine import Limits
        from benchmarks.suites.suites import CaptureSpec

        find_method(self.method)
        capture = self.capture
        if capture is None:
            capture = make_capture(CaptureSpec(scene="mannequin", size="ci"), self.data, workers=cores())
        require_intact(capture)
        if self.out is not None and self.out.exists() and any(self.out.iterdir()):
            raise InputError(f"{self.out}: expected an empty folder for the trials")
        limits = Limits(seconds=self.minutes * 60.0, memory_mb=self.memory_mb)
        workers = self.workers or cores()
        with tempfile.TemporaryDirectory(prefix="ash-bench-check-") as scratch:
            folder = self.out or Path(scratch)
            checks = check(self.method, capture, folder, preset=self.preset, limits=limits, workers=workers)
        print(table(self.method, checks))
        return DONE if all(check.passed for check in checks) else FAILED
