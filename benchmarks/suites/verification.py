"""Checks what others packed: pictures are scored again from their pixels, and it is said what cannot be checked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ash.capture.formats import load_capture
from ash.capture.manifest import NAME as MANIFEST
from ash.capture.manifest import read_manifest
from ash.files import PLAIN, InputError, sha256_of
from benchmarks.cell.evaluation import evaluated_views, quality_summary, scored_views
from benchmarks.cell.metrics import IMAGE_SPLITS, METRICS, weights_file
from benchmarks.cell.schema import Cell, CellResult, Summary, View, ViewScore, result_of
from benchmarks.suites.archive import read_pack
from benchmarks.suites.captures import require_intact, truth_of
from benchmarks.suites.runs import read_run

Kind = Literal["equal", "near", "differs", "failed", "unchecked"]
EQUAL = 1e-4  # relative, from 1 on: LPIPS depends on the count of threads
NOT_FROM_PICTURES = ("template_mm", "surface_mm")
TRUST = (
    "Can be trusted of rows that were scored again: that these pictures have these scores on that capture.",
    "Only reported: training seconds, ms per frame, memory, parameters, errors of template and surface; that the named"
    " method and checkpoint made the pictures, and what it saw before. The hashes show damage, not who made the pack.",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class CellCheck:
    """What became of a cell of a pack.

    `equal`: scored again, with the same scores. `near`: the same, on the same scene rendered elsewhere, within what
    counts as no change. `failed`: a cell that says it failed and has the worst scores.
    """

    cell: Cell
    kind: Kind
    text: str  # for people: why, against what


def verify_pack(folder: Path, captures: Sequence[Path] = ()) -> tuple[list[CellCheck], int]:
    """Check an unpacked pack: names, counts, hashes, then each cell by its pixels; and how many files there are.

    `captures`: folders with the truth, besides those that lie where runs have them (`data/NAME`, `NAME`).

    Raises:
        InputError: the pack is not whole, or not of this protocol, or a capture is damaged.
    """
    pack, run = read_pack(folder), read_run(folder)
    folders = {path.parent for path in folder.glob("cells/*/*")}
    if run.absent or {cell.folder for cell in run.cells} != folders:
        raise InputError(f"{folder}: run.json and the cells that are there differ")
    intact: set[Path] = set()
    checks = []
    for cell in run.cells:
        result = result_of(cell)
        if result is None:
            raise InputError(f"{cell.folder}: has no result")
        _require_pictures(cell, result)
        kind, text = _check(cell, result, find_capture(cell, captures), intact)
        checks.append(CellCheck(cell=cell, kind=kind, text=text))
    return checks, len(pack.files)


def find_capture(cell: Cell, given: Sequence[Path] = ()) -> Path | None:
    """The capture that a cell was scored on: by its identity, or of those given, one of the same scene; else None."""
    name = cell.capture_folder.name
    searched = [cell.capture_folder, Path("data") / name] if PLAIN.fullmatch(name) else []
    there = [folder for folder in (*given, *searched) if (folder / MANIFEST).is_file()]
    for folder in there:
        if sha256_of(folder / MANIFEST) == cell.config.capture:
            return folder
    for folder in given:
        manifest = read_manifest(folder)
        if manifest.identity and truth_of(manifest) == cell.config.truth:
            return folder
    return None


def _require_pictures(cell: Cell, result: CellResult) -> None:
    images = {path.relative_to(cell.folder).as_posix() for path in cell.folder.glob("images/*/*/*")}
    named = [f"images/{view.split}/{view.camera}/{view.frame:06d}.png" for view in result.views]
    if len(set(named)) < len(named) or set(named) != images:
        raise InputError(f"{cell.folder}: {len(images)} pictures, and the result is of {len(named)} others")


def _check(cell: Cell, result: CellResult, folder: Path | None, intact: set[Path]) -> tuple[Kind, str]:
    if result.status != "done":
        worst = not result.views and all(row.value == METRICS[row.metric].worst for row in result.summary)
        text = f"no pictures, for it failed ({result.status}: {result.reason})"
        return ("failed", text) if worst else ("differs", "says that it failed, and has scores")
    if folder is None:
        named = f"{cell.capture_folder.name}, whose manifest has SHA-256 {cell.config.capture:.12}..."
        return "unchecked", f"NOT CHECKED: the capture is not at hand ({named}); give it with --capture DIR"
    if folder not in intact:
        require_intact(folder)
        intact.add(folder)
    capture = load_capture(folder)
    views = evaluated_views(capture)
    if views != tuple(View(split=v.split, camera=v.camera, frame=v.frame) for v in result.views):
        return "differs", f"its pictures are not the {len(views)} views that {folder} is scored on"
    on_cpu = replace(cell, config=replace(cell.config, changes={}))  # The device that a pack names may not be here.
    scored = scored_views(on_cpu, capture, views, alpha=result.has_alpha)
    for before, view in zip(result.views, scored, strict=True):
        if before.prediction != view.prediction:
            return "differs", f"the picture {view.split}/{view.camera}/{view.frame} is not the one that it names"
    same = capture.identity == cell.config.capture
    scores, measured = _scores(result.summary, result.views), _scores(quality_summary(on_cpu, capture, scored), scored)
    values, given = dict(measured), dict(scores)
    if left_out := [place for place in values if place not in given and place[-1] != "lpips"]:
        return "differs", f"{len(left_out)} scores are left out, the first: {' '.join(left_out[0])}"
    wrong = [(place, value) for place, value in scores if not _close(place[-1], value, values.get(place), same=same)]
    if wrong:
        (place, value), count = wrong[0], f"{len(wrong)} of {len(scores)} scores differ"
        pictures = "none" if place not in values else f"{values[place]:.6g}"
        return "differs", f"{count}, the first: {' '.join(place)} is reported as {value:.6g}, pictures have {pictures}"
    without = "" if weights_file() else "; LPIPS is not checked, for its weights are not installed"
    how = "equal" if same else "within what counts as no change (the same scene, rendered elsewhere)"
    text = f"{len(views)} pictures scored again on {folder}, {len(scores)} scores are {how}{without}"
    return "equal" if same else "near", text


def _scores(summary: Sequence[Summary], views: Sequence[ViewScore]) -> list[tuple[tuple[str, ...], float]]:
    """What follows from pictures, by place; LPIPS only where it can be measured here."""
    rows = [((row.split, row.region, row.metric), row.value) for row in summary if row.split in IMAGE_SPLITS]
    scores: list[tuple[tuple[str, ...], float]] = [row for row in rows if row[0][-1] not in NOT_FROM_PICTURES]
    for view in views:
        place = view.split, view.camera, str(view.frame)
        scores += [((*place, *name), value) for name, value in view.scores.items()]
    return [row for row in scores if row[0][-1] != "lpips" or weights_file() is not None]


def _close(metric: str, reported: float, measured: float | None, *, same: bool) -> bool:
    definition = METRICS.get(metric)
    if measured is None or definition is None:
        return False
    return abs(reported - measured) <= (EQUAL * max(1.0, abs(measured)) if same else definition.abs_tol)
