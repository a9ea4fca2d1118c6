"""What a suite would cost, before anything is started."""

from collections.abc import Iterator, Sequence
from itertools import groupby

from benchmarks.suites.captures import capture_folder, described
from benchmarks.suites.engine import shard_of
from benchmarks.suites.runs import RunOptions, require_runnable
from benchmarks.suites.scenes import SPLATS
from benchmarks.suites.suites import CellSpec, Suite


def estimate(suite: Suite, options: RunOptions) -> str:
    """Cells, hours and gigabytes of a suite, as lines."""
    from synth.capture import is_finished
    from synth.cost import estimate as estimate_capture

    notes = require_runnable(suite, options)
    cells: list[CellSpec] = list(suite.cells)
    if options.shard:
        cells = list(shard_of(cells, options.shard))
    lines = [f"{suite.name}: {suite.about}", *notes, ""]
    for spec in suite.captures:
        if spec.stress is not None:
            lines.append(f"capture {spec.name}: made from the clean one, what does not change is linked")
            continue
        if spec.folder is not None:
            lines.append(f"capture {spec.folder}: is there")
            continue
        if (spec.of or spec.scene) == SPLATS:
            lines.append(f"capture {spec.name}: splatted, under a minute")
            continue
        scene, folder = described(spec), capture_folder(spec, options.data)
        state = "is there" if is_finished(scene, folder) else estimate_capture(scene).text
        lines.append(f"capture {folder.name}: {state}")
    lines += ["", *_described(cells)]
    hours = len(cells) * suite.cell_minutes / 60
    beside = options.side_by_side
    wall = hours / min(beside, max(1, len(cells)))
    lines += ["", f"{len(cells)} cells, about {hours:.2f} core-hours, {wall:.2f} hours with {beside} workers"]
    return "\n".join(lines)


def _described(cells: Sequence[CellSpec]) -> Iterator[str]:
    """A line per capture, preset and seed."""
    for (capture, preset, seed), alike in groupby(cells, key=lambda cell: (cell.capture.name, cell.preset, cell.seed)):
        methods = [cell.method for cell in alike]
        of_them = "cell" if len(methods) == 1 else "cells"
        yield f"{len(methods)} {of_them} on {capture}, {preset}, seed {seed}: {', '.join(methods)}"
