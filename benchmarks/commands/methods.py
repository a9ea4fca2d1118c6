"""Commands that look at single methods: check-method, display, retarget."""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ash.files import InputError
from benchmarks.commands.arguments import DONE, FAILED, Count, CountIfAny, File, Folder, Trust


@dataclass(frozen=True, kw_only=True)
class CheckMethodCommand:
    """Check that a method keeps the rules (docs/plugin.md)."""

    method: Positional[str]  # an entry point, or package.module:factory
    capture: Folder | None = None  # train on this capture; default: mannequin, size ci
    preset: str = "ci"  # budget of the method
    minutes: Count = 10  # limit of each of the four trials
    memory_mb: Count = 4096  # likewise
    workers: CountIfAny = None  # trials side by side; default: all cores
    data: Folder = Path("data")  # where captures are kept
    out: Folder | None = None  # keep the trials there; default: they are removed

    def __call__(self) -> int:
        """Whether a method keeps the rules of docs/plugin.md."""
        from benchmarks.cell.methods import find_method
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
        return DONE if all(check.kept for check in checks) else FAILED


@dataclass(frozen=True, kw_only=True)
class DisplayCommand:
    """Time a trained mesh avatar's OpenGL display, and compare its picture."""

    run: Positional[Path]  # a run's folder or a cell's
    trust: Trust = False  # load methods that are not ours too: their code runs here, without isolation

    def __call__(self) -> int:
        """Both ways to draw the avatars of a run that have a display of their own."""
        from benchmarks.cell.cells import is_trained
        from benchmarks.cell.methods import find_method
        from benchmarks.studies.display import show
        from benchmarks.suites.runs import read_run

        cells = [cell for cell in read_run(self.run).cells if is_trained(cell)]
        shown = 0
        for cell in cells:
            find_method(cell.config.method)
            try:
                row = show(cell, trust=self.trust)
            except InputError as error:
                if len(cells) == 1:
                    raise
                print(error, file=sys.stderr)
                continue
            shown += 1
            ours = f"a frame takes {row.display_ms:.1f} ms, drawing it {row.display_draw_ms:.1f} ms"
            theirs = f"by the training renderer {row.trained_ms:.1f} and {row.trained_draw_ms:.1f} ms"
            print(f"{row.title}: {ours}; {theirs}; both agree to {row.agreement_db:.1f} dB")
        if not shown:
            raise InputError(f"{self.run}: holds no trained avatar with a display of its own")
        return DONE


@dataclass(frozen=True, kw_only=True)
class RetargetCommand:
    """Drive a run's avatars with a motion file, and score them against its truth."""

    run: Positional[Path]  # a run's folder or a cell's
    motion: File  # BVH, or AMASS .npz
    frames: Count = 12  # of the motion
    out: Folder | None = None  # default: RUN/retarget-FILE
    workers: CountIfAny = None  # processes that render; default: all cores

    def __call__(self) -> int:
        """Truth and avatars for a motion that nobody captured."""
        from benchmarks.provenance import cores
        from benchmarks.studies.retarget import retarget as drive
        from benchmarks.suites.runs import read_run

        cells = list(read_run(self.run).cells)
        motion: Path = self.motion
        out = self.out or self.run / f"retarget-{motion.stem}"
        workers = self.workers or cores()
        for row in drive(cells, motion, out, frames=max(2, self.frames), workers=workers):
            own = "" if row.own_psnr is None else f" ({row.own_psnr:.2f} dB on its own test motion)"
            print(f"{row.title}: {row.psnr:.2f} dB{own}, IoU {row.iou:.3f}, foreground PSNR on {motion.name}")
        print(out)
        return DONE
