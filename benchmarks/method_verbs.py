"""The verbs of the door that look at single methods: check-method, search, display, retarget."""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from ash.files import InputError

DONE, FAILED = 0, 1


def add_verbs(add: Callable[..., argparse.ArgumentParser], *, positive: Callable[[str], int]) -> None:
    """Add the verbs to the door's parser; `add(function, name, about)` makes one, `positive` reads a whole number."""
    verb = add(check_method, "check-method", "check that a method keeps the rules (docs/plugin.md)")
    verb.add_argument("method", metavar="NAME")
    verb.add_argument("--capture", type=Path, metavar="DIR", help="train on this capture (default: mannequin, size ci)")
    verb.add_argument("--preset", default="ci", help="budget of the method (default: %(default)s)")
    verb.add_argument("--minutes", type=positive, default=10, metavar="N", help="limit of each of the four trials")
    verb.add_argument("--memory-mb", type=positive, default=4096, metavar="N", help="likewise (default: %(default)s)")
    verb.add_argument("--workers", type=positive, metavar="N", help="trials side by side (default: all cores)")
    verb.add_argument("--data", type=Path, metavar="DIR", default=Path("data"), help="where captures are kept")
    verb.add_argument("--out", type=Path, metavar="DIR", help="keep the trials there (default: they are removed)")
    verb = add(display, "display", "time a trained mesh avatar's OpenGL display, and compare its picture")
    verb.add_argument("run", type=Path, metavar="RUN", help="a run's folder or a cell's")
    verb = add(retarget, "retarget", "drive a run's avatars with a motion file, and score them against its truth")
    verb.add_argument("run", type=Path, metavar="RUN", help="a run's folder or a cell's")
    verb.add_argument("--motion", type=Path, metavar="FILE", required=True, help="BVH, or AMASS .npz")
    verb.add_argument("--frames", type=positive, default=12, metavar="N", help="of the motion (default: %(default)s)")
    verb.add_argument("--out", type=Path, metavar="DIR", help="default: RUN/retarget-FILE")
    verb.add_argument("--workers", type=positive, metavar="N", help="processes that render (default: all cores)")
    verb = add(search, "search", "train ash or ddc with one setting of its preset changed at a time")
    verb.add_argument("method", metavar="METHOD")
    verb.add_argument("capture", type=Path, metavar="CAPTURE")
    verb.add_argument("--preset", default="ci", help="where the search starts (default: %(default)s)")
    verb.add_argument("--seeds", type=positive, default=1, metavar="N", help="per setting (default: %(default)s)")
    verb.add_argument("--workers", type=positive, metavar="N", help="trainings side by side (default: all cores)")
    verb.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/search"), help="default: %(default)s")


def check_method(arguments: argparse.Namespace) -> int:
    """Whether a method keeps the rules of docs/plugin.md."""
    from benchmarks.conformance import check_method as check
    from benchmarks.conformance import table
    from benchmarks.engine import Limits
    from benchmarks.experiments import CaptureSpec, find_method
    from benchmarks.provenance import cores
    from benchmarks.runs import make_capture, require_intact

    find_method(arguments.method)
    capture = arguments.capture
    if capture is None:
        capture = make_capture(CaptureSpec(scene="mannequin", size="ci"), arguments.data, workers=cores())
    require_intact(capture)
    if arguments.out is not None and arguments.out.exists() and any(arguments.out.iterdir()):
        raise InputError(f"{arguments.out}: expected an empty folder for the trials")
    limits = Limits(seconds=arguments.minutes * 60.0, memory_mb=arguments.memory_mb)
    workers = arguments.workers or cores()
    with tempfile.TemporaryDirectory(prefix="ash-bench-check-") as scratch:
        folder = arguments.out or Path(scratch)
        checks = check(arguments.method, capture, folder, preset=arguments.preset, limits=limits, workers=workers)
    print(table(arguments.method, checks))
    return DONE if all(check.kept for check in checks) else FAILED


def display(arguments: argparse.Namespace) -> int:
    """Both ways to draw the avatars of a run that have a display of their own."""
    from benchmarks.displaying import show
    from benchmarks.experiments import find_method
    from benchmarks.run import is_trained
    from benchmarks.runs import read_run

    cells = [cell for cell in read_run(arguments.run).cells if is_trained(cell)]
    shown = 0
    for cell in cells:
        find_method(cell.config.method)
        try:
            row = show(cell)
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
        raise InputError(f"{arguments.run}: holds no trained avatar with a display of its own")
    return DONE


def retarget(arguments: argparse.Namespace) -> int:
    """Truth and avatars for a motion that nobody captured."""
    from benchmarks.provenance import cores
    from benchmarks.retargeting import retarget as drive
    from benchmarks.runs import read_run

    cells = list(read_run(arguments.run).cells)
    motion: Path = arguments.motion
    out = arguments.out or arguments.run / f"retarget-{motion.stem}"
    workers = arguments.workers or cores()
    for row in drive(cells, motion, out, frames=max(2, arguments.frames), workers=workers):
        own = "" if row.own_psnr is None else f" ({row.own_psnr:.2f} dB on its own test motion)"
        print(f"{row.title}: {row.psnr:.2f} dB{own}, IoU {row.iou:.3f}, foreground PSNR on {motion.name}")
    print(out)
    return DONE


def search(arguments: argparse.Namespace) -> int:
    """What each setting of a preset is worth, on a camera that is kept apart."""
    from benchmarks.provenance import cores
    from benchmarks.search import search as find
    from benchmarks.search import table

    method, preset, workers = arguments.method, arguments.preset, arguments.workers or cores()
    found = find(
        method,
        arguments.capture,
        arguments.out,
        preset=preset,
        seeds=arguments.seeds,
        workers=workers,
        command=arguments.command,
    )
    print(table(method, preset, found))
    return DONE
