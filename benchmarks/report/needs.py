"""What each scene needs: the matrix as a picture and in numbers, its surprises, its doses, and what would suffice."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from benchmarks.analysis import ablation_matrix, contrasts, pareto
from benchmarks.analysis.ablation_matrix import AblationEffect, Dose, Matrix
from benchmarks.analysis.scores import RANKED_SPLITS, Quantity, Scores
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.metrics import METRICS
from benchmarks.report import charts, tables, vega
from benchmarks.report.content import Block, Bullets, Chart, Entry, Head, Mark, Row, Section, Table, Text
from benchmarks.report.heatmap import heatmap, least_width
from benchmarks.report.vega import Figure

LIMIT_DB = 2.0  # A loss of more has the deepest colour.
NOTE = (
    "Foreground PSNR in dB that is lost when the column's row takes ASH's place, with its 95 % interval. Needed: a "
    f"loss of more than {ablation_matrix.MARGIN_DB} dB that is sure at 5 %, corrected over all cells "
    "(Benjamini-Hochberg). "
    "Few people tell little about how far a loss spreads over people, so cells over several lend each other their "
    "variances (moderated t, Smyth 2004), the mesh's column apart. "
    "Harmful: as sure and as large a gain. Not needed: surely less is lost. One seed on one capture tells nothing."
)
UNTOLD = "One seed on one capture: what is needed cannot be told; --seeds 3 or --subjects 8 can."
NOT_CHOSEN = "On people for validation nothing was chosen: they share no scene or row with those here, or are too few."
MANY_ROWS = 3  # from which on it is worth asking which of them would suffice
PARAMETERS = Quantity("memory", "", "params")


def sections(scores: Scores, chosen_on: Scores | None = None) -> list[Section]:
    """What is needed, where parts were taken away; and what suffices, where there is a choice.

    `chosen_on`: the same rows on people for validation, whose choice is judged on the people here.
    """
    return [*_matrix_section(scores), *_dose_section(scores), *_sufficient_section(scores, chosen_on)]


def _matrix_section(scores: Scores) -> list[Section]:
    """The matrix of each split, or in words that there is none, where losses without an interval are all there is."""
    found = [matrix for split in RANKED_SPLITS if (matrix := ablation_matrix.matrix(scores, split))]
    blocks: list[Block] = []
    if told := [matrix for matrix in found if matrix.has_intervals]:
        for matrix in told:
            blocks += [Chart(figure=_picture(matrix)), *_surprises(matrix)]
        blocks += [*map(_table, told), Text(text=NOTE, note=True)]
    elif any(effect.loss for matrix in found for effect in matrix.effects):
        blocks.append(Text(text=UNTOLD))
    return [Section(title="What each scene needs", blocks=tuple(blocks))] if blocks else []


def _picture(matrix: Matrix) -> Figure:
    """The matrix, a row per scene and a column per part."""
    cells = pd.DataFrame(
        [
            {
                "row": effect.scene,
                "column": effect.part.title,
                "value": None if effect.loss is None else effect.loss.mean,
                "text": "n/a" if effect.loss is None else f"{effect.loss.mean:+z.2f}",
                "interval": _interval(effect),
                "verdict": effect.verdict,
                "framed": effect.expected,
            }
            for effect in matrix.effects
        ]
    )
    words = SPLIT_NAMES[matrix.split].words
    framed = " Framed: expected to be needed." if any(effect.expected for effect in matrix.effects) else ""
    return Figure(
        name=f"needs_{matrix.split}",
        title=f"What each scene needs, {words}",
        caption=f"Foreground PSNR lost without the part, {words}: blue where something is lost, orange where the scene "
        f"is better off without, deepest from {LIMIT_DB:g} dB on. Below: the 95 % interval. Bold: needed, or harmful."
        f"{framed}",
        panels=heatmap(
            cells, rows=matrix.scenes, columns=[part.title for part in matrix.parts], limit=LIMIT_DB, title=words
        ),
        columns=1,
        least=least_width(len(matrix.parts)),
    )


def _interval(effect: AblationEffect) -> str:
    if effect.loss is None or math.isnan(effect.loss.low):
        return ""
    return f"{effect.loss.low:z.1f} to {effect.loss.high:z.1f}"


def _surprises(matrix: Matrix) -> tuple[Block, ...]:
    """In words: what contradicts the expected diagonal, and how much of it was found."""
    framed = [effect for effect in matrix.effects if effect.expected]
    if not any(effect.loss for effect in framed):
        return ()
    counts = Counter(effect.verdict for effect in framed if effect.loss)
    words = SPLIT_NAMES[matrix.split].words
    surprises = tuple(effect.surprise for effect in matrix.effects if effect.surprise)
    told = f"On {words}, of {counts.total()} parts that were tried where they should be needed, {counts['needed']} are"
    told += f" needed, {counts['not needed'] + counts['harmful']} are not,"
    told += f" and of {counts['unclear'] + counts['unknown']} it cannot be told from so few people or seeds."
    told += " Surprises:" if surprises else " No surprises."
    return (Text(text=told), Bullets(items=surprises)) if surprises else (Text(text=told),)


def _table(matrix: Matrix) -> Table:
    by_place = {(effect.scene, effect.part.row): effect for effect in matrix.effects}
    rows = tuple(
        Row(name=scene, entries=tuple(_entry(by_place[scene, part.row]) for part in matrix.parts))
        for scene in matrix.scenes
    )
    columns = tuple(Head(title=part.title, unit="dB lost") for part in matrix.parts)
    return Table(title=SPLIT_NAMES[matrix.split].title, corner="scene", columns=columns, rows=rows)


def _entry(effect: AblationEffect) -> Entry:
    marks: dict[str, Mark] = {"needed": "best", "harmful": "second"}
    if effect.loss is None:
        return Entry(text="n/a")
    told = (
        "" if effect.verdict == "unknown" else f" [{effect.loss.low:+z.2f}, {effect.loss.high:+z.2f}] {effect.verdict}"
    )
    return Entry(text=f"{effect.loss.mean:+z.2f}{told}", sort=effect.loss.mean, mark=marks.get(effect.verdict, ""))


def _dose_section(scores: Scores) -> list[Section]:
    blocks: list[Block] = []
    for split in RANKED_SPLITS:
        if found := ablation_matrix.doses(scores, split):
            blocks += [Chart(figure=_dose_figure(found, split)), Bullets(items=tuple(map(_dose_sentence, found)))]
    return [Section(title="More of a phenomenon", blocks=tuple(blocks))] if blocks else []


def _dose_figure(found: Sequence[Dose], split: str) -> Figure:
    parts = {dose.part.row: dose.part for dose in found}
    plain = zip(parts, vega.series_of(tuple(parts)), strict=True)
    looks = {row: replace(look, title=parts[row].title) for row, look in plain}
    samples = pd.DataFrame(
        [
            {
                "panel": dose.scene,
                "x_title": "strength of the phenomenon",
                "series": looks[dose.part.row].title,
                "x": strength,
                "y": loss.mean,
                "low": loss.low,
                "high": loss.high,
                "crossed": False,
            }
            for dose in found
            for strength, loss in dose.losses
        ]
    )
    words = SPLIT_NAMES[split].words
    zero = pd.DataFrame({"panel": samples["panel"].unique(), "y": 0.0, "text": ""})
    return Figure(
        name=f"doses_{split}",
        title=f"Loss against dose, {words}",
        caption=f"Foreground PSNR lost without a part that the rung asks for, {words}, by the phenomenon's strength "
        "(1: the rung as it is; 0: the scene without any). Whiskers: 95 % interval.",
        panels=charts.lines(samples, tuple(looks.values()), y="dB lost", size=(230, 170), rules=zero),
        series=tuple(looks.values()),
        columns=3,
    )


def _dose_sentence(dose: Dose) -> str:
    course = ", ".join(f"{ablation_matrix.told(loss)} at {strength:g}" for strength, loss in dose.losses)
    rises = "rises" if dose.rises else "does not rise"
    return f"{dose.scene}, {dose.part.title}: {course}; it {rises} with every dose."


def _sufficient_section(scores: Scores, chosen_on: Scores | None) -> list[Section]:
    """The smallest sufficient row of every scene that has many, and how the rows do that were chosen elsewhere."""
    places = [(scene, split) for scene in scores.scenes for split in RANKED_SPLITS]
    rows = [row for scene, split in places if (row := _sufficient(scores, scene, split))]
    blocks = [*_sufficient_table(rows)] if rows else []
    if chosen_on:
        judged = [row for scene, split in places if (row := _judged(scores, chosen_on, scene, split))]
        blocks += _judged_table(judged) if judged else [Text(text=NOT_CHOSEN)]
    return [Section(title="The smallest that suffices, per scene", blocks=tuple(blocks))] if blocks else []


def _sufficient_table(rows: Sequence[Row]) -> tuple[Block, ...]:
    heads = [Head(title=title) for title in ("split", "cheapest that suffices")]
    heads += [Head(title="frame", unit="ms"), Head(title="parameters")]
    heads += [Head(title="loss at most", unit="dB"), Head(title="best"), Head(title="frame of the best", unit="ms")]
    heads += [Head(title="lost on people left out", unit="dB")]
    note = (
        f"The cheapest row by milliseconds per frame whose loss to the best is below {pareto.SUFFICIENT_DB} dB (upper "
        "95 % bound). Rows that were given the exact surface take no part. Lost on people left out: each person in "
        "turn has no say in the choice, which then loses so much there to the best of the others, in the mean; behind "
        "it, in how many of these choices it is the same row. Joules of a frame: speed frame --avatar, where the "
        "machine tells them."
    )
    return Table(title="", corner="scene", columns=tuple(heads), rows=tuple(rows)), Text(text=note, note=True)


def _judged_table(rows: Sequence[Row]) -> tuple[Block, ...]:
    title = "Chosen on people for validation"
    heads = [Head(title=title) for title in ("split", "cheapest that suffices there", "best there")]
    heads += [Head(title="lost here", unit="dB"), Head(title="verdict here")]
    note = (
        "The same choice, made on people whom no other table has, and judged on the people here: what the chosen row "
        "loses to the one that was best there, with the 90 % interval. It suffices where the upper end is below "
        f"{pareto.SUFFICIENT_DB} dB, is too little where the lower end is above, and unclear otherwise."
    )
    return Table(title=title, corner="scene", columns=tuple(heads), rows=tuple(rows)), Text(text=note, note=True)


def _sufficient(scores: Scores, scene: str, split: str) -> Row | None:
    competing = contrasts.candidates(scores, scene, split)
    found = pareto.smallest_sufficient(competing) if len(competing) >= MANY_ROWS else None
    if found is None:
        return None
    frames = {contender.name: contender.cost for contender in competing}
    entries = (
        Entry(text=SPLIT_NAMES[split].title),
        Entry(text=style_of(found.name).title),
        Entry(text=f"{frames[found.name]:.1f}", sort=frames[found.name]),
        tables.entry_of(scores.get(scene, found.name, PARAMETERS), METRICS["params"]),
        Entry(text=f"{found.loss_bound_db:.2f}", sort=found.loss_bound_db),
        Entry(text=style_of(found.best).title),
        Entry(text=f"{frames[found.best]:.1f}", sort=frames[found.best]),
        _confirmation(pareto.confirmed(competing)),
    )
    return Row(name=scene, entries=entries)


def _judged(scores: Scores, chosen_on: Scores, scene: str, split: str) -> Row | None:
    if scene not in chosen_on.scenes:
        return None
    here, there = (contrasts.candidates(each, scene, split) for each in (scores, chosen_on))
    found = pareto.chosen_elsewhere(here, there)
    if found is None:
        return None
    interval = "" if math.isnan(found.loss.low) else f" [{found.loss.low:z.2f}, {found.loss.high:z.2f}]"
    entries = (
        Entry(text=SPLIT_NAMES[split].title),
        Entry(text=style_of(found.name).title),
        Entry(text=style_of(found.best).title),
        Entry(text=f"{found.loss.mean:z.2f}{interval}", sort=found.loss.mean),
        Entry(text=found.verdict),
    )
    return Row(name=scene, entries=entries)


def _confirmation(found: pareto.Confirmation | None) -> Entry:
    if found is None:
        return Entry(text="n/a")
    return Entry(text=f"{found.loss_db:z.2f}, {found.same} of {found.captures}", sort=found.loss_db)
