"""What a suite would cost, before anything is started."""

from benchmarks import splats_rung
from benchmarks.engine import shard_of
from benchmarks.experiments import CellSpec, Suite, find_method
from benchmarks.runs import RunOptions


def estimate(suite: Suite, options: RunOptions) -> str:
    """Cells, hours and gigabytes of a suite, as lines."""
    from synth.presets import estimate as estimate_capture
    from synth.presets import scene

    for method in suite.methods:
        find_method(method)
    cells: list[CellSpec] = list(suite.cells)
    if options.shard:
        cells = list(shard_of(cells, options.shard))
    lines = [f"{suite.name}: {suite.about}", ""]
    for spec in suite.captures:
        if spec.stress is not None:
            lines.append(f"capture {spec.name}: made from the clean one, what does not change is linked")
            continue
        if spec.scene == splats_rung.SCENE:
            lines.append(f"capture {spec.name}: splatted, under a minute")
            continue
        lines.append(f"capture {spec.name}: {estimate_capture(scene(spec.scene, size=spec.size, seed=spec.seed)).text}")
    lines += [f"cell {cell.capture.name} · {cell.method}:{cell.preset} · seed {cell.seed}" for cell in cells]
    hours = len(cells) * suite.cell_minutes / 60
    wall = hours / min(options.workers, max(1, len(cells)))
    lines += ["", f"{len(cells)} cells, about {hours:.2f} core-hours, {wall:.2f} hours with {options.workers} workers"]
    return "\n".join(lines)
