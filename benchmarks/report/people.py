"""Person by person: how far ASH is ahead on each capture, and how far scores spread between captures and seeds."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import altair as alt
import numpy as np
import pandas as pd

from ash.capture.formats import load_capture
from benchmarks.analysis.scores import RANKED_SPLITS, Scores, foreground
from benchmarks.analysis.statistics import spreads
from benchmarks.analysis.style import SPLIT_NAMES, is_ours, style_of
from benchmarks.cell.cells import CellResult
from benchmarks.cell.methods import is_oracle
from benchmarks.report import charts, pictures, vega
from benchmarks.report.content import Block, Bullets, Chart, Entry, Head, Row, Section, Strips, Table, Text
from benchmarks.report.pictures import Album, Frames, Shown
from benchmarks.report.vega import Figure, Series
from benchmarks.suites.runs import Run

REFERENCE = "ash"
RIVALS = ("ddc", "wo_mot")  # Of many rows, those that are shown person by person, and the user's own.
FEW = 5
FEW_PEOPLE = 4  # whose pictures are shown at twice their size
NOTE = (
    "Foreground PSNR. Standard deviations: between captures (people in their outfits), and between trainings of one "
    "capture from other seeds; n/a where no capture has two seeds, and then the spread between captures holds theirs."
)


def sections(scores: Scores, scene: str) -> list[Section]:
    """The differences on every capture, where a scene has several."""
    others = _others(scores, scene)
    if not others:
        return []
    gains = _gains(scores, scene, others)
    blocks: tuple[Block, ...] = (
        Chart(figure=_figure(gains, others, scene)),
        Bullets(items=tuple(_told(gains, others))),
        *(_table(scores, scene, gains, others, split) for split in gains["split"].unique()),
        _spread_table(scores, scene, others),
        Text(text=NOTE, note=True),
    )
    return [Section(title=f"Person by person on {scene}", blocks=blocks)]


def pictured(
    run: Run, results: Sequence[CellResult], scores: Scores, scene: str, album: Album
) -> tuple[Strips | None, dict[str, bytes]]:
    """Everybody as the methods draw them, where a scene has several captures: a typical view of each ranked split.

    The sheet for Markdown has a column per person and a row per method, of held-out views.

    Raises:
        InputError: a capture or a picture is not there.
    """
    others = _others(scores, scene)
    if not others:
        return None, {}
    groups, columns = [], []
    for who, (folder, cells) in _persons(run, results, scores, scene, (REFERENCE, *others)).items():
        capture, first = load_capture(folder), cells[0].result
        views = [view for split in RANKED_SPLITS for view in pictures.choose_views(first, split, 1)]
        rows = [pictures.compare(capture, cells, view, with_errors=False) for view in views]
        groups.append((who, tuple(replace(row, title=f"{who}, {row.title}").strip(album) for row in rows)))
        columns.append([replace(rows[0].images[0], caption=who), *rows[0].images[1:]])
    lines = [Frames(title="", images=line) for line in zip(*columns, strict=True)]
    file = f"pictures_people_{scene}.png"
    strips = Strips(file=file, title=f"Everybody on {scene}", groups=tuple(groups))
    return strips, {file: pictures.sheet(lines, scale=1 if len(columns) > FEW_PEOPLE else 2)}


def _persons(
    run: Run, results: Sequence[CellResult], scores: Scores, scene: str, methods: Sequence[str]
) -> dict[str, tuple[Path, list[Shown]]]:
    """By person: the capture's folder, and the first cell of each method on it, the reference first."""
    names, done = _names(scores, scene), {result.config.key: result for result in results}
    found: dict[str, tuple[Path, dict[str, Shown]]] = {}
    for cell in run.cells:
        if cell.config.key in done and cell.config.method in methods:
            _, cells = found.setdefault(names[cell.capture_folder.name], (cell.capture_folder, {}))
            cells.setdefault(cell.config.method, Shown(cell=cell, result=done[cell.config.key]))
    whole = {who: kept for who, kept in found.items() if len(kept[1]) == len(methods)}
    return {who: (folder, [cells[m] for m in methods]) for who, (folder, cells) in whole.items()}


def _others(scores: Scores, scene: str) -> list[str]:
    """The rows that ASH is compared with: run on everybody that ASH was, and failed on nobody; none for one person."""
    views = foreground(RANKED_SPLITS[0])
    own = scores.samples(scene, REFERENCE, views).keys()
    if len(own) < 2 or not scores.whole(scene, REFERENCE):
        return []
    others = [
        row
        for row in scores.methods(scene)
        if row != REFERENCE and scores.whole(scene, row) and not is_oracle(row)
        if own <= scores.samples(scene, row, views).keys()
    ]
    return others if len(others) <= FEW else [row for row in others if row in RIVALS or not is_ours(row)][:FEW]


def _gains(scores: Scores, scene: str, others: Sequence[str]) -> pd.DataFrame:
    """A row per split, capture and method: the capture's name for readers, and ASH's PSNR minus the method's in dB."""
    who = _names(scores, scene)
    rows = []
    for split in RANKED_SPLITS:
        own = scores.samples(scene, REFERENCE, foreground(split))
        for method in others:
            rival = scores.samples(scene, method, foreground(split))
            rows += [
                {"split": split, "who": who[c], "capture": c, "method": method, "gain": _mean(own[c]) - _mean(rival[c])}
                for c in own
                if c in rival
            ]
    return pd.DataFrame(rows)


def _names(scores: Scores, scene: str) -> dict[str, str]:
    """The subject of each capture, or where one has several captures, the captures' own names."""
    subjects = scores.clean[scores.clean["scene"] == scene].groupby("capture", sort=False)["subject"].first()
    alone = subjects.is_unique
    return {str(name): f"subject {subject}" if alone else str(name) for name, subject in subjects.items()}


def _figure(gains: pd.DataFrame, others: Sequence[str], scene: str) -> Figure:
    looks = vega.series_of(others)
    titles = {method: look.title for method, look in zip(others, looks, strict=True)}
    first = gains[(gains["split"] == RANKED_SPLITS[0]) & (gains["method"] == others[0])]
    order = list(first.sort_values("gain", ascending=False)["who"])
    points = gains.assign(series=gains["method"].map(titles), panel=[SPLIT_NAMES[s].title for s in gains["split"]])
    return Figure(
        name=f"people_{scene}",
        title="Person by person",
        caption="Foreground PSNR of ASH minus that of each method, a row per person. Right of the line ASH is ahead. "
        f"Sorted by the lead over {looks[0].title} on {SPLIT_NAMES[RANKED_SPLITS[0]].words}.",
        panels=_dots(points, looks, order),
        series=looks,
    )


def _dots(points: pd.DataFrame, looks: Sequence[Series], order: Sequence[str]) -> tuple[alt.LayerChart, ...]:
    """`points`: panel, who, series, gain. All panels share the scale."""
    low, high = min(0.0, float(points["gain"].min())), max(0.0, float(points["gain"].max()))
    room = 0.05 * (high - low)
    axis = alt.Scale(domain=[low - room, high + room], nice=False)
    at = {
        "x": alt.X("gain:Q", title="ASH minus the method [dB]", scale=axis),
        "y": alt.Y("who:N", sort=list(order), title=None, axis=alt.Axis(ticks=False, domain=False, grid=True)),
    }
    tips = charts.tooltips([("who", "", ""), ("series", "ASH minus", ""), ("gain", "dB", "+.2f")])
    panels = []
    for panel, own in points.groupby("panel", sort=False):
        seen = alt.Chart(charts.inline(own)).transform_filter("indexof(hidden, datum.series) < 0")
        layers = [
            alt.Chart(charts.inline(own.head(1).assign(zero=0.0))).mark_rule().encode(x=alt.X("zero:Q")),
            seen.mark_point(size=70, opacity=1).encode(**at, **charts.look(looks), tooltip=tips),
        ]
        panels.append(charts.layered(layers, str(panel), (300, 24 * len(order))))
    return tuple(panels)


def _told(gains: pd.DataFrame, others: Sequence[str]) -> Iterator[str]:
    """On how many people ASH is ahead, in one sentence per split and method."""
    for split in gains["split"].unique():
        for method in others:
            here = gains[(gains["split"] == split) & (gains["method"] == method)]["gain"].round(2)
            words, title = SPLIT_NAMES[split].words, style_of(method).title
            span = f"{here.min():+.2f} to {here.max():+.2f} dB"
            if (here == 0).all():
                yield f"On {words} ASH and {title} are equal on all {len(here)} people, within 0.01 dB."
            elif (here > 0).any():
                yield f"On {words} ASH is ahead of {title} on {(here > 0).sum()} of {len(here)} people, by {span}."
            else:
                yield f"On {words} ASH is ahead of {title} on none of {len(here)} people; the differences are {span}."


def _table(scores: Scores, scene: str, gains: pd.DataFrame, others: Sequence[str], split: str) -> Table:
    own = scores.samples(scene, REFERENCE, foreground(split))
    here = gains[gains["split"] == split].set_index(["capture", "method"])["gain"]
    rows = []
    for capture, who in _names(scores, scene).items():
        if capture in own:
            values = [here.get((capture, method)) for method in others]
            found = [Entry(text="n/a" if v is None else f"{v:+.2f}", sort=v) for v in values]
            rows.append(Row(name=who, entries=(Entry(text=f"{_mean(own[capture]):.2f}"), *found)))
    heads = (
        Head(title=style_of(REFERENCE).title, unit="dB"),
        *(Head(title=f"minus {style_of(m).title}") for m in others),
    )
    return Table(title=SPLIT_NAMES[split].title, corner="person", columns=heads, rows=tuple(rows))


def _spread_table(scores: Scores, scene: str, others: Sequence[str]) -> Table:
    """How far scores differ between people, and how far by chance of training."""
    heads = tuple(
        Head(title=title, unit="dB", group=SPLIT_NAMES[split].title)
        for split in RANKED_SPLITS
        for title in ("between captures", "between seeds")
    )
    rows = tuple(
        Row(name=style_of(method).title, entries=tuple(_spread_entries(scores, scene, method)))
        for method in (REFERENCE, *others)
    )
    return Table(title="How far scores spread", columns=heads, rows=rows)


def _spread_entries(scores: Scores, scene: str, method: str) -> Iterator[Entry]:
    for split in RANKED_SPLITS:
        found = spreads(scores.samples(scene, method, foreground(split)))
        for value in (found.captures, found.seeds):
            yield Entry(text="n/a" if value is None else f"{value:.2f}", sort=value)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))
