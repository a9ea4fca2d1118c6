"""Two runs side by side, before and after: each row of both, what changed in it, and the worst frames of each."""

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from PIL import Image

from ash.capture.formats import load_capture
from ash.files import InputError, write_atomic
from benchmarks.analysis.scores import RANKED_SPLITS
from benchmarks.analysis.statistics import Difference, compared
from benchmarks.analysis.style import SPLIT_NAMES
from benchmarks.cell.cells import Cell, CellResult, ViewScore, read_result, stored_prediction
from benchmarks.cell.metrics import METRICS, on_black
from benchmarks.cell.views import View
from benchmarks.report.page import environment
from benchmarks.report.pictures import crop_of, on_paper
from benchmarks.suites.runs import Run, results_of

Verdict = Literal["better", "worse", "identical", "no change seen", "too few", "only before", "only after"]
QUANTITIES = (
    ("novel_view", "foreground", "psnr"),
    ("novel_pose", "foreground", "psnr"),
    ("near_pose", "foreground", "psnr"),
    ("far_pose", "foreground", "psnr"),
    ("novel_view", "foreground", "flip"),
    ("novel_pose", "foreground", "flip"),
    ("novel_pose", "full", "iou"),
    ("speed", "", "frame_ms"),
    ("speed", "", "train_s"),
)
WORST = 2  # Frames of each run that are shown of a row.

Rows = dict[tuple[str, str], list[tuple[Cell, CellResult]]]


@dataclass(frozen=True, kw_only=True, slots=True)
class Change:
    """One quantity of one row, in both runs: means, and the 95 % interval of their difference."""

    scene: str
    method: str
    what: str
    unit: str
    before: float | None
    after: float | None
    change: float | None
    low: float | None
    high: float | None
    verdict: Verdict


@dataclass(frozen=True, kw_only=True, slots=True)
class WorstFrame:
    """A view that is among the worst of one of the runs, as both draw it. Pictures are data URIs."""

    title: str
    before_db: float
    after_db: float
    truth: str
    before: str
    after: str


def write_comparison(before: Run, after: Run, out: Path) -> str:
    """Write compare.html and compare.csv into `out`; returns the table for the terminal, its verdict first.

    Raises:
        InputError: the runs have no row in common, or one of them has no finished cell.
    """
    old, new = _rows(before), _rows(after)
    if not set(old) & set(new):
        raise InputError(f"{before.folder} and {after.folder}: no scene and method in common, expected at least one")
    found = changes(old, new)
    table = pd.DataFrame([asdict(change) for change in found])
    verdict = verdict_of(found)
    write_atomic(out / "compare.csv", table.to_csv(index=False, float_format="%.6g").encode())
    frames = {key: list(_worst_frames(old[key][0], new[key][0])) for key in old if key in new}
    page = (
        environment("html")
        .get_template("compare.html")
        .render(before=before, after=after, verdict=verdict, changes=[_told(change) for change in found], frames=frames)
    )
    write_atomic(out / "compare.html", page.encode())
    return f"{verdict}\n\n{pd.DataFrame([_told(change) for change in found]).to_string(index=False)}"


def changes(before: Rows, after: Rows) -> list[Change]:
    """Every quantity of every row of either run, in their order."""
    rows = list(dict.fromkeys([*before, *after]))
    return [
        change
        for row in rows
        for quantity in QUANTITIES
        if (change := _change(row, quantity, before.get(row, []), after.get(row, []))) is not None
    ]


def verdict_of(found: Sequence[Change]) -> str:
    """What changed in one sentence."""
    counts = {kind: [c for c in found if c.verdict == kind] for kind in ("worse", "better")}
    if not any(counts.values()):
        return "No change is sure."
    parts = []
    for kind, those in counts.items():
        named = ", ".join(dict.fromkeys(f"{c.method} on {c.scene}" for c in those))
        parts += [f"{len(those)} {'is' if len(those) == 1 else 'are'} {kind} ({named})"] if those else []
    return f"Of {len(found)} quantities {' and '.join(parts)}."


def _rows(run: Run) -> Rows:
    results_of(run)  # Refuses a run without any.
    rows: Rows = {}
    for cell in run.cells:
        result = read_result(cell.folder)
        if result is not None:
            rows.setdefault((cell.config.place, cell.config.method), []).append((cell, result))
    return rows


def _change(
    row: tuple[str, str],
    quantity: tuple[str, str, str],
    before: list[tuple[Cell, CellResult]],
    after: list[tuple[Cell, CellResult]],
) -> Change | None:
    split, _, metric = quantity
    old, new = (_samples(cells, quantity) for cells in (before, after))
    if not old and not new:
        return None
    means = [float(np.mean([np.mean(own) for own in samples.values()])) if samples else None for samples in (old, new)]
    test = compared(new, old)
    sure = test is not None and not math.isnan(test.low)
    same = split != "speed" and _pictures(before) == _pictures(after) != set()
    return Change(
        scene=row[0],
        method=row[1],
        what=f"{METRICS[metric].title}, {SPLIT_NAMES[split].words}",
        unit=METRICS[metric].unit,
        before=means[0],
        after=means[1],
        change=test.mean if test else None,
        low=test.low if test and sure else None,
        high=test.high if test and sure else None,
        verdict="only before"
        if not new
        else "only after"
        if not old
        else "identical"
        if same
        else _verdict(metric, test),
    )


def _samples(cells: list[tuple[Cell, CellResult]], quantity: tuple[str, str, str]) -> dict[str, list[float]]:
    """A quantity for each seed, by subject."""
    found: dict[str, list[float]] = {}
    for cell, result in cells:
        if (value := result.value(*quantity)) is not None:
            found.setdefault(str(cell.config.subject), []).append(value)
    return found


def _verdict(metric: str, test: Difference | None) -> Verdict:
    if test is None or math.isnan(test.low):
        return "too few"
    if test.low <= 0 <= test.high:
        return "no change seen"
    return "better" if (test.low > 0) == (METRICS[metric].direction == "up") else "worse"


def _pictures(cells: list[tuple[Cell, CellResult]]) -> set[tuple[int, int, str, str, int, str]]:
    """Every picture of a row, by subject, seed and view."""
    return {
        (cell.config.subject, cell.config.seed, view.split, view.camera, view.frame, view.prediction)
        for cell, result in cells
        for view in result.views
    }


def _told(change: Change) -> dict[str, str]:
    """A change as it is read."""

    def number(value: float | None, sign: str = "") -> str:
        return "n/a" if value is None else f"{value:{sign}.4g}"

    interval = "" if change.low is None else f" [{number(change.low, '+')}, {number(change.high, '+')}]"
    return {
        "scene": change.scene,
        "method": change.method,
        "what": f"{change.what}{f' ({change.unit})' if change.unit else ''}",
        "before": number(change.before),
        "after": number(change.after),
        "change": number(change.change, "+") + interval,
        "verdict": change.verdict,
    }


def _worst_frames(before: tuple[Cell, CellResult], after: tuple[Cell, CellResult]) -> Iterator[WorstFrame]:
    """The worst views of each run that the other has as well, of the first seed; none where pictures are gone."""
    scores = [{_key(view): view for view in result.views} for _, result in (before, after)]
    shared = [key for key in scores[0] if key in scores[1] and key[0] in RANKED_SPLITS]  # Training views are no exam.
    chosen: dict[tuple[str, str, int], str] = {}
    for name, views in zip(("before", "after"), scores, strict=True):
        for key in sorted(shared, key=lambda key, views=views: _db(views[key]))[:WORST]:  # type: ignore[misc]
            chosen[key] = "before and after" if key in chosen else name
    for key, run in chosen.items():
        try:
            truth, drawn = _pixels(before[0], after[0], key)
        except InputError:
            return
        yield WorstFrame(
            title=f"{SPLIT_NAMES[key[0]].words}, camera {key[1]}, frame {key[2]}: among the worst {run}",
            before_db=_db(scores[0][key]),
            after_db=_db(scores[1][key]),
            truth=truth,
            before=drawn[0],
            after=drawn[1],
        )


def _key(view: ViewScore) -> tuple[str, str, int]:
    return view.split, view.camera, view.frame


def _db(view: ViewScore) -> float:
    return view.scores["foreground", "psnr"]


def _pixels(before: Cell, after: Cell, key: tuple[str, str, int]) -> tuple[str, list[str]]:
    """The truth of a view and what both runs drew, cropped alike to the subject."""
    capture = load_capture(before.capture_folder)
    split, camera, frame = key
    view = View(split=split, camera=camera, frame=frame)
    images = [on_black(capture.image(camera, frame))]
    images += [stored_prediction(cell, load_capture(cell.capture_folder), view) for cell in (before, after)]
    if len({image.shape for image in images}) > 1:
        raise InputError(f"{after.folder}: its pictures have another size than those of {before.folder}")
    crop = crop_of(images)
    truth, *drawn = (_uri(image[crop]) for image in images)
    return truth, drawn


def _uri(image: np.ndarray) -> str:
    """RGBA on black as a data URI, on the report's paper."""
    buffer = io.BytesIO()
    Image.fromarray(on_paper(image)).save(buffer, format="PNG")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
