"""Two runs side by side, before and after: each row of both, what changed in it, and the worst frames of each."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from ash.capture.formats import load_capture
from ash.files import InputError, write_atomic
from benchmarks.analysis.error_attribution import psnr_of
from benchmarks.analysis.results import RANKED_SPLITS, Quantity, foreground, load, samples_of
from benchmarks.analysis.statistics import compare_samples, corrected
from benchmarks.analysis.style import SPLIT_NAMES
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import Cell, CellResult, ViewScore
from benchmarks.report import pictures
from benchmarks.report.content import Block, Mark, Section, Strip, Strips, Table, Text
from benchmarks.report.page import render
from benchmarks.report.pictures import Album, Frames, Shown
from benchmarks.suites.runs import Run, require_one_of_each, results_of

NAMES = ("Before", "After")
ABOUT = (
    "In brackets: the 95 % interval of the change, over seeds, or in pairs over subjects where both have several. "
    "Better or worse: p below 5 % after Holm's correction over all rows, and a change above the metric's margin. "
    "Equivalent: the interval lies within that margin, or the predictions are identical. n/a: one value only."
)
NO_PICTURES = "No pictures: the capture or the stored predictions are missing."
QUANTITIES = (
    foreground("novel_view"),
    foreground("novel_pose"),
    foreground("near_pose"),
    foreground("far_pose"),
    foreground("novel_view", "flip"),
    foreground("novel_pose", "flip"),
    Quantity("novel_view", "full", "lpips"),
    Quantity("novel_pose", "full", "lpips"),
    Quantity("novel_pose", "full", "iou"),
    Quantity("speed", "", "frame_ms"),
    Quantity("speed", "", "train_s"),
)
WORST = 2  # frames of each run that are shown of a row
COLUMNS = ["scene", "method", "what", "unit", "before", "after", "change", "low", "high", "p", "verdict"]

Done = tuple[Cell, CellResult]
Rows = dict[tuple[str, str], list[Done]]
Views = list[tuple[ViewScore, ViewScore]]  # those that two cells have, with the scores of each


def write_comparison(before: Run, after: Run, out: Path) -> str:
    """Write compare.html and compare.csv into `out`; returns the table for the terminal, its verdict first.

    Raises:
        InputError: the runs have no row in common, or one of them has no finished cell.
    """
    old, new = cells_by_row(before), cells_by_row(after)
    if not set(old) & set(new):
        raise InputError(f"{before.folder} and {after.folder}: no scene and method in common, expected at least one")
    table, failed = changes(old, new), failures_in_words(old, new)
    write_atomic(out / "compare.csv", table.to_csv(index=False, float_format="%.6g").encode())
    shown, verdict, album = printed(table), f"{failed}{verdict_of(table)}", Album()
    kinds: dict[str, Mark] = {"better": "best", "worse": "second"}
    last = len(shown.columns) - 2
    marks = {(i, last): kinds[kind] for i, kind in enumerate(table["verdict"]) if kind in kinds}
    groups = [
        (f"{key[1]} on {key[0]}: the worst frames", tuple(_worst_frames(pair, album)))
        for key in old
        if key in new and (pair := same_person(old[key], new[key])) is not None
    ]
    groups = [(name, strips) for name, strips in groups if strips]
    about = f"Before: {before.folder} ({before.suite}). After: {after.folder} ({after.suite}). {ABOUT}"
    blocks: list[Block] = [Text(text=about), Table(frame=shown.set_index("scene"), corner="scene", marks=marks)]
    blocks.append(Strips(file="", title="", groups=tuple(groups)) if groups else Text(text=NO_PICTURES))
    section = Section(title="Before and after", headline=verdict, blocks=tuple(blocks))
    page = render("ash-bench: before and after", [section], "html", album)
    write_atomic(out / "compare.html", page.encode())
    return f"{verdict}\n\n{shown.to_string(index=False)}"


def changes(before: Rows, after: Rows) -> pd.DataFrame:
    """Every quantity of every row of either run: `COLUMNS`; p is corrected over all of them.

    Verdict: on the run after; empty where one of the runs lacks the row, or each has one value.
    """
    rows, tests = [], []
    for scene, method in dict.fromkeys([*before, *after]):
        pair = [runs.get((scene, method), []) for runs in (before, after)]
        tables = [_by_subject([result for _, result in cells]) for cells in pair]
        for quantity in QUANTITIES:
            metric = METRICS[quantity.metric]
            old, new = (samples_of(table, quantity).get(method, {}) for table in tables)
            if not old and not new:
                continue
            if shared := set(old) & set(new):  # Means of the same people.
                old, new = ({key: samples[key] for key in samples if key in shared} for samples in (old, new))
            means = [
                float(np.mean([np.mean(seeds) for seeds in samples.values()])) if samples else None
                for samples in (old, new)
            ]
            test = compare_samples(new, old, margin=metric.abs_tol, higher_is_better=metric.direction == "up")
            same = quantity.split != "speed" and _predictions(pair[0]) == _predictions(pair[1]) != set()
            what = f"{metric.title}, {SPLIT_NAMES[quantity.split].words}"
            rows.append([scene, method, what, metric.unit, *means])
            tests.append((test, same))
    corrected_tests = iter(corrected([test for test, _ in tests if test is not None]))
    records = []
    for row, (test, same) in zip(rows, tests, strict=True):
        each = None if test is None else next(corrected_tests)
        verdict = "equivalent" if same else "" if each is None or pd.isna(each.p) else each.verdict
        numbers = [None] * 4 if each is None else [each.mean, each.low, each.high, each.p]
        records.append([*row, *numbers, verdict])
    return pd.DataFrame(records, columns=COLUMNS)


def failures_in_words(before: Rows, after: Rows) -> str:
    """The rows of which cells failed, whose worst scores widen every interval; empty where none did."""
    parts = []
    for key in dict.fromkeys([*before, *after]):
        was, now = (sum(result.status != "done" for _, result in run.get(key, [])) for run in (before, after))
        if was or now:
            parts.append(f"{now} cells of {key[1]} on {key[0]} failed (before: {was}).")
    return f"{' '.join(parts)} " if parts else ""


def verdict_of(table: pd.DataFrame) -> str:
    """What changed, in one sentence."""
    parts = []
    for kind in ("worse", "better"):
        rows = table[table["verdict"] == kind]
        names = ", ".join(dict.fromkeys(f"{row.method} on {row.scene}" for row in rows.itertuples()))
        parts += [f"{len(rows)} {'is' if len(rows) == 1 else 'are'} {kind} ({names})"] if len(rows) else []
    return f"Of {len(table)} quantities {' and '.join(parts)}." if parts else "No quantity is better or worse."


def printed(table: pd.DataFrame) -> pd.DataFrame:
    """The table as texts."""

    def text(value: float | None, sign: str = "") -> str:
        return "n/a" if pd.isna(value) else f"{value:{sign}.4g}"

    return pd.DataFrame(
        {
            "scene": row.scene,
            "method": row.method,
            "what": f"{row.what}{f' ({row.unit})' if row.unit else ''}",
            "before": text(row.before),
            "after": text(row.after),
            "change": text(row.change, "+")
            + ("" if pd.isna(row.low) else f" [{text(row.low, '+')}, {text(row.high, '+')}]"),
            "verdict": row.verdict or "n/a",
        }
        for row in table.itertuples()
    )


def cells_by_row(run: Run) -> Rows:
    """The finished cells of every row, by scene and method.

    Raises:
        InputError: there is none, or two of one name were trained differently.
    """
    require_one_of_each(run.cells)
    cells = {cell.config.key: cell for cell in run.cells}
    rows: Rows = {}
    for result in results_of(run):
        rows.setdefault((result.config.place, result.config.method), []).append((cells[result.config.key], result))
    return rows


def same_person(ours: Sequence[Done], theirs: Sequence[Done]) -> tuple[Done, Done] | None:
    """The first cells of two rows that are of one subject and seed."""
    by_person = {(cell.config.subject, cell.config.seed): (cell, result) for cell, result in theirs}
    pairs = ((mine, by_person.get((mine[0].config.subject, mine[0].config.seed))) for mine in ours)
    return next(((mine, other) for mine, other in pairs if other is not None), None)


def shared_views(
    pair: tuple[Done, Done], choose: Callable[[Views], Iterable[tuple[ViewScore, str]]]
) -> Iterator[Frames]:
    """Truth and both cells in those views of both that are chosen, each with its reason; none without the pictures."""
    shown = [Shown(cell=cell, result=result) for cell, result in pair]
    if not all(each.result.has_alpha for each in shown):
        return
    ours, theirs = ({(v.split, v.camera, v.frame): v for v in each.result.views} for each in shown)
    with suppress(InputError):
        capture = load_capture(shown[0].cell.capture_folder)
        for view, reason in choose([(view, theirs[key]) for key, view in ours.items() if key in theirs]):
            frames = pictures.compare(capture, shown, view, with_errors=False)
            yield replace(frames, title=f"{frames.title}: {reason}")


def _by_subject(results: Sequence[CellResult]) -> pd.DataFrame:
    """The results with subjects for captures: the same subject may have another capture in the other run."""
    rows = load(results)
    return rows.assign(capture=rows["subject"].astype(str))


def _predictions(cells: list[tuple[Cell, CellResult]]) -> set[tuple[int, int, str, str, int, str]]:
    """Every prediction of a row, by subject, seed and view."""
    return {
        (cell.config.subject, cell.config.seed, view.split, view.camera, view.frame, view.prediction)
        for cell, result in cells
        for view in result.views
    }


def _worst_frames(pair: tuple[Done, Done], album: Album) -> Iterator[Strip]:
    """The worst held-out views of each run that the other has as well."""

    def worst(views: Views) -> Iterator[tuple[ViewScore, str]]:
        views = [each for each in views if each[0].split in RANKED_SPLITS]
        orders = [sorted(range(len(views)), key=[psnr_of(both[run]) for both in views].__getitem__) for run in (0, 1)]
        before, after = (order[:WORST] for order in orders)
        for index in dict.fromkeys([*before, *after]):
            runs = [name.lower() for name, chosen in zip(NAMES, (before, after), strict=True) if index in chosen]
            yield views[index][0], f"among the worst {' and '.join(runs)}"

    for frames in shared_views(pair, worst):
        truth, *drawn = frames.images
        named = (replace(frame, caption=name) for frame, name in zip(drawn, NAMES, strict=True))
        yield replace(frames, images=(truth, *named)).strip(album)
