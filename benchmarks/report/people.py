"""Subject by subject: how far ASH is ahead on each capture, and how the methods draw every subject."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from ash.capture.formats import load_capture
from benchmarks.analysis.results import RANKED_SPLITS, RunTables, foreground, samples_of
from benchmarks.analysis.style import SPLIT_NAMES, prominence, style_of
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.schema import CellResult
from benchmarks.report import pictures
from benchmarks.report.content import Block, Bullets, Strips, Table, Text
from benchmarks.report.pictures import Album, Frames
from benchmarks.suites.runs import Run

REFERENCE = "ash"
FEW = 5  # rows beside ASH
MARGIN_DB = METRICS["psnr"].abs_tol  # below which nobody is ahead
FEW_SUBJECTS = 4  # whose pictures are shown at twice their size


def leads(tables: RunTables, scene: str) -> pd.DataFrame:
    """Foreground PSNR of ASH minus that of other methods: split, who, capture, method, ash, lead; of several captures.

    Methods that were run on every capture of ASH and failed on none; of many, our main ones and the user's.
    """
    rows = []
    others = _others(tables, scene)
    for split in RANKED_SPLITS if others else ():
        means = {
            method: {capture: float(np.mean(seeds)) for capture, seeds in samples_of_method.items()}
            for method, samples_of_method in samples_of(tables.of(scene), foreground(split)).items()
        }
        for method in others:
            for capture, who in _names(tables, scene).items():
                if capture in means[REFERENCE] and capture in means.get(method, {}):
                    ash = means[REFERENCE][capture]
                    rows.append((split, who, capture, method, ash, ash - means[method][capture]))
    return pd.DataFrame(rows, columns=["split", "who", "capture", "method", "ash", "lead"])


def blocks(tables: RunTables, scene: str) -> tuple[Block, ...]:
    """The differences on every capture, where a scene has several."""
    table = leads(tables, scene)
    if not len(table):
        return ()
    others = list(table["method"].unique())
    titles = {method: style_of(method).title for method in others}
    sentences, split_tables = [], []
    for split, here in table.groupby("split", sort=False):
        for method in others:
            sentences.append(_sentence(here[here["method"] == method]["lead"].round(2), str(split), method))
        wide = here.pivot(index="who", columns="method", values="lead").reindex(here["who"].unique())[others]
        wide = wide.map("{:+.2f}".format).set_axis([f"minus {titles[method]}" for method in others], axis=1)
        wide.insert(0, f"{style_of(REFERENCE).title} [dB]", here.groupby("who")["ash"].first().map("{:.2f}".format))
        split_tables.append(Table(title=SPLIT_NAMES[str(split)].title, corner="subject", frame=wide))
    return (
        Bullets(items=tuple(sentences)),
        *split_tables,
        Text(text="Foreground PSNR.", note=True),
    )


def _sentence(lead: pd.Series, split: str, method: str) -> str:
    words, title, count = SPLIT_NAMES[split].words, style_of(method).title, len(lead)
    ahead, behind = (int((sign * lead > MARGIN_DB).sum()) for sign in (1, -1))
    text = f"On {words} {style_of(REFERENCE).title} minus {title} is {lead.min():+.2f} to {lead.max():+.2f} dB: "
    return f"{text}ahead by more than {MARGIN_DB:g} dB on {ahead} of {count} subjects, behind on {behind}."


def pictured(
    run: Run, results: Sequence[CellResult], tables: RunTables, scene: str, album: Album
) -> tuple[Strips | None, dict[str, bytes]]:
    """Every subject as the methods draw it, where a scene has several captures: a typical view of each ranked split.

    The sheet for Markdown has a column per subject and a row per method, of novel views.

    Raises:
        InputError: a capture or a picture is missing.
    """
    others = _others(tables, scene)
    if not others:
        return None, {}
    groups, columns, names = [], [], _names(tables, scene)
    for by_method in pictures.first_cells(run, results):
        if not {REFERENCE, *others} <= by_method.keys():
            continue
        cells = [by_method[method] for method in (REFERENCE, *others)]
        folder, first = cells[0].cell.capture_folder, cells[0].result
        capture, who = load_capture(folder), names[folder.name]
        views = [view for split in RANKED_SPLITS for view in pictures.choose_views(first, split, 1)]
        rows = [pictures.compare(capture, cells, view, with_errors=False) for view in views]
        groups.append((who, tuple(replace(row, title=f"{who}, {row.title}").strip(album) for row in rows)))
        columns.append([replace(rows[0].images[0], caption=who), *rows[0].images[1:]])
    if not columns:  # Rows of several runs, each on captures of its own.
        return None, {}
    lines = [Frames(title="", images=line) for line in zip(*columns, strict=True)]
    file = f"pictures_people_{scene}.webp"
    strips = Strips(file=file, title=f"All subjects on {scene}", groups=tuple(groups))
    return strips, {file: pictures.sheet(lines, scale=1 if len(columns) > FEW_SUBJECTS else 2)}


def _others(tables: RunTables, scene: str) -> list[str]:
    samples = samples_of(tables.of(scene), foreground())
    samples_of_method = samples.get(REFERENCE, {}).keys()
    if len(samples_of_method) < 2 or not tables.whole(scene, REFERENCE):
        return []
    others = [
        row
        for row in tables.methods(scene, oracles=False)
        if row != REFERENCE and tables.whole(scene, row) and samples_of_method <= samples.get(row, {}).keys()
    ]
    return others if len(others) <= FEW else [row for row in others if prominence(row) < 2][:FEW]


def _names(tables: RunTables, scene: str) -> dict[str, str]:
    """The subject of each capture, or where one has several captures, the captures' own names."""
    subjects = tables.of(scene).groupby("capture", sort=False)["subject"].first()
    return {str(name): f"subject {subject}" if subjects.is_unique else str(name) for name, subject in subjects.items()}
