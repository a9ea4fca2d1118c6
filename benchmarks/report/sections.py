"""What a report says of a run as a whole, beside its scenes: ablations, stability, cost of training, the paper."""

from collections import Counter
from collections.abc import Iterable, Sequence

import pandas as pd

from benchmarks.analysis import ablation_matrix, curves, paper, pareto, stability, template_error
from benchmarks.analysis.differences import differences
from benchmarks.analysis.results import RANKED_SPLITS, Quantity, RunTables, alike
from benchmarks.analysis.style import SPLIT_NAMES, prominence, style_of
from benchmarks.cell.metrics import METRICS, PROTOCOL
from benchmarks.cell.schema import CellResult
from benchmarks.report import author_table, charts, vega
from benchmarks.report.content import Block, Bullets, Commands, Section, Table, Text
from benchmarks.report.figures import line_figure
from benchmarks.report.glossary import GLOSSARY
from benchmarks.report.tables import text_of
from benchmarks.report.vega import Figure, Series
from benchmarks.suites.reuse import TRAINED_BY
from benchmarks.suites.runs import commands_of
from benchmarks.suites.stress import AXES, TRIVIAL

WHISKERS = "Whiskers: 95 % interval over seeds, or over captures where there are several."
APART = "The common effect of a capture is removed."
LIMIT_DB = 2.0  # differences from which on a matrix has the deepest colour
MOST_LINES = 8  # in the chart of novelty; of more rows the main ones
MANY_ROWS = 3  # from which on the smallest sufficient one is asked for
MATRIX_NOTE = (
    "Foreground PSNR of ASH minus that of the row without the component, with its 95 % interval and the verdict on "
    "ASH: better means that the component is needed, worse that it does harm. The numbers and verdicts are those of "
    "the scene's own table of differences. n/a: not run there. One seed on one capture gives no verdict."
)
UNDECIDED = (
    "Unclear, and how many people would decide, if difference and spread are those of all people (80 % power, after "
    "correction):"
)
ONE_VALUE = "One seed on one capture: no verdict on components; --seeds 3 or --subjects 8 gives one."
SUFFICIENT_NOTE = (
    f"The cheapest row by milliseconds per frame whose loss to the best is below {pareto.SUFFICIENT_DB} dB (upper 95 % "
    "bound). Rows that were given the exact surface take no part."
)
CHOSEN_NOTE = (
    "The same choice, made on subjects for validation and judged on the subjects here: the chosen row minus the one "
    f"that was best there, with the 90 % interval. Equivalent: the interval lies within {pareto.SUFFICIENT_DB} dB."
)
NOT_CHOSEN = "On subjects for validation nothing was chosen: no scene or row in common with this run, or too few."
BROKEN_NOTE = (
    "Loss: PSNR on the clean capture minus that on the perturbed one, in pairs over people, with its 95 % interval; a "
    "number without one is of one training. Broken, the breakdown point: the score lies below the midpoint between the "
    "clean score and that of the nearest training image, with the upper bound of its interval where there is one. The "
    "foreground leaves out what a method draws beside the person; on a white frame it counts."
)
PAPER_NOTE = (
    "The paper: captured data at 1285x940 and weeks on a GPU, PSNR of the release's convention. Ours: foreground PSNR "
    "and LPIPS on the release's window, on {suite}. Levels cannot be compared, orders can."
)
PROVENANCE_NOTE = (
    f"Protocol {PROTOCOL}: predictions are quantised to 8 bits on black before anything is compared. Code: hash of the "
    "sources that decide a cell. results.csv beside this report has every number; each cell's result.json the scores "
    "of every image. Differences are taken before numbers are rounded."
)
REUSED_NOTE = (
    "{reused} of {cells} trainings are those of an earlier run by other code: for one cell of each of their rows and "
    "scenes this code made the same pictures, bit for bit."
)


def ablations(tables: RunTables, chosen_on: RunTables | None = None) -> list[Section]:
    """Scenes by components, the strength of phenomena, and the smallest sufficient rows.

    `chosen_on`: the same rows on subjects for validation, whose choice is judged on the subjects here.
    """
    ranked = differences(tables.rows)
    blocks: list[Block] = []
    for split in RANKED_SPLITS:
        effects = ablation_matrix.matrix(tables, ranked, split)
        if any(not pd.isna(effect.low) for effect in effects):
            blocks += [*_matrix(tables, effects, split)]
        elif effects and not blocks:
            blocks = [Text(text=ONE_VALUE)]
    blocks += [Text(text=MATRIX_NOTE, note=True)] if len(blocks) > 1 else []
    sections = [Section(title="Components by scene", blocks=tuple(blocks))]
    strengths: list[Block] = []
    for split in RANKED_SPLITS:
        table = ablation_matrix.strength_curves(tables.rows, split)
        strengths += _strengths(tables.rows, table, split) if len(table) else []
    sections.append(Section(title="Strength of a phenomenon", blocks=tuple(strengths)))
    sections.append(Section(title="Smallest sufficient row by scene", blocks=tuple(_sufficient(tables, chosen_on))))
    return [section for section in sections if section.blocks]


def _matrix(tables: RunTables, effects: Sequence[ablation_matrix.AblationEffect], split: str) -> list[Block]:
    scenes = [scene for scene in tables.scenes if any(effect.scene == scene for effect in effects)]
    components = list(dict.fromkeys(effect.component for effect in effects))
    by_place = {(effect.scene, effect.component): effect for effect in effects}
    words = SPLIT_NAMES[split].words
    cells = pd.DataFrame(
        {
            "row": scene,
            "column": component,
            "value": None if each is None else each.mean,
            "text": "n/a" if each is None else f"{each.mean:+z.2f}",
            "interval": "" if each is None or pd.isna(each.low) else f"{each.low:z.1f} to {each.high:z.1f}",
            "verdict": "" if each is None else each.verdict,
            "framed": each is not None and each.expected,
        }
        for scene in scenes
        for component in components
        for each in [by_place.get((scene, component))]
    )
    framed = [effect for effect in effects if effect.expected]
    figure = Figure(
        name=f"needs_{split}",
        title=f"Components by scene, {words}",
        caption=f"Foreground PSNR lost without the component, {words}: blue a loss, orange a gain, deepest from "
        f"{LIMIT_DB:g} dB on. Below: the 95 % interval. Bold: better or worse."
        f"{' Framed: the scene should need the component.' if framed else ''}",
        panels=charts.heatmap(cells, rows=scenes, columns=components, limit=LIMIT_DB, title=words),
        columns=1,
        least=charts.least_width(len(components)),
    )
    blocks: list[Block] = [figure]
    if framed:
        counts = Counter(effect.verdict for effect in framed)
        sentences = ablation_matrix.surprises(list(effects))
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
        text = f"Framed on {words}: {len(framed)}. Verdicts on ASH with the component: {verdicts}."
        blocks.append(Text(text=f"{text} {'Contradictions:' if sentences else 'No contradictions.'}"))
        blocks += [Bullets(items=tuple(sentences))] if sentences else []
        if open_cells := ablation_matrix.undecided(list(effects)):
            blocks += [Text(text=UNDECIDED), Bullets(items=tuple(open_cells))]
    return blocks


def _strengths(rows: pd.DataFrame, table: pd.DataFrame, split: str) -> list[Block]:
    words = SPLIT_NAMES[split].words
    figure = line_figure(
        table.assign(panel=table["scene"], method=table["row"], psnr=table["mean"]),
        name=f"strength_{split}",
        title=f"Loss against strength, {words}",
        caption=f"Foreground PSNR lost without a component that the scene should need, {words}, by the phenomenon's "
        "strength (1: the factor scene; 0: the scene without any), of the people who are on all scenes of a curve. "
        "Whiskers: 95 % interval.",
        x="strength",
        x_title="strength of the phenomenon",
        y_title="dB lost",
        size=(230, 170),
        rules=pd.DataFrame({"panel": table["scene"].unique(), "y": 0.0, "text": ""}),
        columns=3,
    )
    sentences = []
    for (scene, component, row), curve in table.groupby(["scene", "component", "row"], sort=False):
        course = ", ".join(f"{r.mean:+z.2f} dB at {r.strength:g}" for r in curve.itertuples())
        rises = "rises" if curve["mean"].is_monotonic_increasing and curve["mean"].is_unique else "does not rise"
        more = ablation_matrix.more_by_strength(rows, scene, row, split)
        paired = f" More than at 0, on the people of both: {more}." if more else ""
        sentences.append(f"{scene}, {component}: {course}; the loss {rises} with every step of strength.{paired}")
    return [figure, Bullets(items=tuple(sentences))]


def _sufficient(tables: RunTables, chosen_on: RunTables | None) -> list[Block]:
    """The smallest sufficient row of every scene that has many, and how the rows do that other subjects chose."""
    rows, judged = [], []
    for scene, split in [(scene, split) for scene in tables.scenes for split in RANKED_SPLITS]:
        competing, title = pareto.candidates(tables, scene, split), SPLIT_NAMES[split].title
        sufficient = pareto.smallest_sufficient(competing) if len(competing) >= MANY_ROWS else None
        if sufficient is not None:
            frames = {each.name: f"{each.frame_ms:.1f}" for each in competing}
            params = text_of(tables.get(scene, sufficient.name, Quantity("memory", "", "params")), METRICS["params"])
            best = (style_of(sufficient.best).title, frames[sufficient.best])
            names = (title, style_of(sufficient.name).title, frames[sufficient.name], params)
            rows.append((scene, *names, f"{sufficient.loss_bound_db:.2f}", *best))
        others = pareto.candidates(chosen_on, scene, split) if chosen_on and scene in chosen_on.scenes else ()
        if (choice := pareto.chosen_on_others(competing, others)) is not None:
            chosen, change = choice
            interval = "" if pd.isna(change.low) else f" [{change.low:+z.2f}, {change.high:+z.2f}]"
            both = (style_of(chosen.name).title, style_of(chosen.best).title)
            judged.append((scene, title, *both, f"{change.mean:+z.2f}{interval}", change.verdict))
    blocks: list[Block] = []
    if rows and (chosen_on or len(tables.scenes) > 1):  # A single scene says it in its opening.
        heads = ("split", "cheapest sufficient", "frame [ms]", "parameters", "loss at most [dB]", "best")
        frame = pd.DataFrame(rows, columns=["scene", *heads, "frame of the best [ms]"]).set_index("scene")
        blocks += [Table(corner="scene", frame=frame), Text(text=SUFFICIENT_NOTE, note=True)]
    if judged:
        columns = ["scene", "split", "chosen there", "best there", "chosen minus best, here [dB]", "verdict here"]
        frame = pd.DataFrame(judged, columns=columns).set_index("scene")
        blocks += [Table(title="Chosen on subjects for validation", corner="scene", frame=frame)]
        blocks += [Text(text=CHOSEN_NOTE, note=True)]
    elif chosen_on:
        blocks.append(Text(text=NOT_CHOSEN))
    return blocks


def template_errors(tables: RunTables) -> list[Section]:
    """Quality, and ASH minus DDC, against the template's error, where templates of known error were run."""
    margins = template_error.margins(tables)
    if not len(margins):
        return []

    def panel(table: pd.DataFrame) -> pd.Series:
        return table["scene"] + ", " + table["split"].map(lambda split: SPLIT_NAMES[split].words)

    levels = template_error.levels(tables).merge(margins[["scene", "split"]].drop_duplicates())
    level_figure = line_figure(
        levels.assign(panel=panel(levels)),
        name="levels",
        title="Quality against the template's error",
        caption="Foreground PSNR when a method is given a template of known error (the exact surface, displaced "
        f"smoothly). {WHISKERS} {APART}",
        x="error_mm",
        x_title="template error [mm rms]",
    )
    templates = {
        template_error.PLANTED: Series(title="planted error", colour=vega.BLUE),
        "": Series(title="learned template", colour=vega.ORANGE, shape="square"),
    }
    rules = [(place, 0.0, "") for place in panel(margins).unique()]
    for scene, split in margins[["scene", "split"]].drop_duplicates().itertuples(index=False):
        if (db := template_error.PAPER_DB[split].get(scene)) is not None:
            rules.append((f"{scene}, {SPLIT_NAMES[split].words}", db, f"the paper's {db:+.1f} dB"))
    kinds = margins["template"].where(margins["template"] == template_error.PLANTED, "")
    margin_figure = line_figure(
        margins.assign(panel=panel(margins), method=kinds, psnr=margins["mean"]),
        templates,
        name="margin",
        title="ASH minus DDC against the template's error",
        caption="Foreground PSNR of ASH minus DDC when both are given such a template, and on templates that both "
        f"learned. {WHISKERS}",
        x="error_mm",
        x_title="template error [mm rms]",
        y_title="ASH minus DDC [dB]",
        rules=pd.DataFrame(rules, columns=["panel", "y", "text"]),
    )
    sentences = Bullets(items=tuple(template_error.sentences(tables, margins)))
    return [Section(title=level_figure.title, blocks=(level_figure, margin_figure, sentences))]


def training_cost(tables: RunTables) -> list[Section]:
    """Quality against training seconds and against training frames, where a suite made them."""
    seconds = curves.time_to_quality(curves.on_equal_captures(tables.snapshots))
    frames = curves.data_scaling(tables.all_rows)
    charts_asked = (
        ("budget", "Accuracy against training seconds", "seconds", "seconds of training", seconds),
        ("footage", "Novel poses against the number of training frames", "frames", "training frames", frames),
    )
    sections = []
    for name, title, x, x_title, table in charts_asked:
        if len(table):
            on_all = table["scene"].isin(tables.scenes)  # captures of a scene, not only some of them
            compared = table[on_all & table["method"].isin(alike(table["method"], tables.trained_on))]
            table = table[on_all | table["split"].isin(RANKED_SPLITS)]
            words = table["split"].map(lambda split: SPLIT_NAMES[split].words)
            sentences = curves.crossings(compared) if name == "budget" else curves.frames_needed(table)
            snapshots = "Snapshots: the learning rate falls only at the end of a training." if name == "budget" else ""
            figure = line_figure(
                table.assign(panel=table["scene"] + ", " + words, scale=table["scene"]),
                name=name,
                title=title,
                caption=" ".join(filter(None, ("Foreground PSNR.", snapshots, WHISKERS, APART))),
                x=x,
                x_title=x_title,
                size=(250, 200),
                log=True,
                columns=3,
            )
            sections.append(Section(title=title, blocks=(figure, Bullets(items=tuple(sentences)))))
    return sections


def novelty(tables: RunTables) -> list[Section]:
    """Quality by how far a pose lies from the training poses, where novel poses are diverse enough for a curve."""
    table = curves.novelty(curves.on_equal_captures(tables.images))
    if not len(table):
        return []
    main = table[table["method"].map(prominence) < 2]
    shown = main if table["method"].nunique() > MOST_LINES and len(main) else table
    rows = "" if shown is table else "The main rows; the sentence below has all. "
    figure = line_figure(
        shown.assign(panel=shown["scene"], scale=shown["scene"], novelty_deg=shown["novelty_deg"].round(1)),
        name="novelty",
        title="Quality against novelty",
        caption="Foreground PSNR by how far a pose lies from the nearest training pose: the mean over the joints of "
        "the angle between their rotations, the heading removed. At zero: novel views of training poses. The frames of "
        f"near, new and far novel poses stand in bins of equal number, each at its mean. {rows}{WHISKERS} {APART}",
        x="novelty_deg",
        x_title="novelty of the pose [degrees]",
    )
    return [Section(title=figure.title, blocks=(figure, Bullets(items=tuple(curves.losses_by_novelty(table)))))]


def stabilities(tables: RunTables) -> list[Section]:
    """Where methods fail, per scene with perturbed captures."""
    steps, losses = stability.steps(tables.all_rows), stability.losses(tables.all_rows)
    on_white = stability.losses(tables.all_rows, "white_frame")
    return [
        _stability(tables, str(scene), own, on_white[on_white["scene"] == scene], steps)
        for scene, own in losses.groupby("scene", sort=False)
    ]


def _stability(
    tables: RunTables, scene: str, losses: pd.DataFrame, on_white: pd.DataFrame, steps: pd.DataFrame
) -> Section:
    series = vega.series_of(losses["method"].unique())
    titles = {name: f"{axis.title} [{axis.unit}]" for name, axis in AXES.items()}
    breakdowns = stability.breakdowns(losses)
    caption = "Accuracy against severity, the clean capture at 0. A failed cell counts with the worst score."
    caption += f" Crossed: the breakdown point. {WHISKERS}" if losses["distance"].notna().any() else f" {WHISKERS}"
    caption += f" {APART}" if tables.captures(scene) > 1 else ""
    blocks: list[Block] = []
    for index, split in enumerate(RANKED_SPLITS):
        here = steps[(steps["scene"] == scene) & (steps["split"] == split)]
        floor = here[(here["method"] == TRIVIAL) & (here["severity"] == 0)]
        here = here[here["method"].isin(series)].merge(breakdowns, on=stability.COURSE)
        text = style_of(TRIVIAL).title
        title = SPLIT_NAMES[split].words.capitalize()
        figure = line_figure(
            here.assign(
                panel=here["axis"].map(titles),
                severity=here["severity"].map("{:g}".format),
                crossed=here["severity"] == here["breakdown"],
            ),
            series,
            name=f"stability_{scene}_{index}",
            title=title,
            caption=f"{title}. {caption}",
            x="severity",
            x_title="severity",
            y_title="PSNR [dB]",
            size=(240, 150),
            rules=pd.DataFrame({"panel": floor["axis"].map(titles), "y": floor["psnr"], "text": text}),
            columns=3,
        )
        blocks += [figure, _losses(losses[losses["split"] == split], f"foreground, {title.lower()}")]
        if (on_white["split"] == split).any():
            blocks.append(_losses(on_white[on_white["split"] == split], f"on a white frame, {title.lower()}"))
    blocks.append(Text(text=BROKEN_NOTE, note=True))
    rates = stability.reliability(tables.all_rows, scene)
    frame = pd.DataFrame(
        {
            "failed cells": [f"{r.failures} of {r.cells}" for r in rates.itertuples()],
            "95 % interval of the rate": [f"{100 * r.low:.0f} to {100 * r.high:.0f} %" for r in rates.itertuples()],
            "diverged": rates["diverged"].map(str).tolist(),
            "spread over seeds, clean capture, novel views [dB]": [
                "n/a" if pd.isna(spread) else f"{spread:.2f}" for spread in rates["spread_db"]
            ],
        },
        index=[style_of(method).title for method in rates["method"]],
    )
    return Section(title=f"Stability on {scene}", blocks=(*blocks, Table(title="Reliability", frame=frame)))


def _losses(losses: pd.DataFrame, of: str) -> Table:
    """PSNR lost by axis and severity, a column for each method; `losses`: of one split and region, that `of` names."""
    rows: dict[str, dict[str, str]] = {}
    for row in losses.itertuples():
        axis = AXES[row.axis]
        interval = "" if pd.isna(row.low) else f" [{row.low:z.1f}, {row.high:z.1f}]"
        text = f"{row.mean:z.1f}{interval}{', broken' if row.distance < 0 else ''}"
        rows.setdefault(f"{axis.title}: {row.severity:g} {axis.unit}", {})[style_of(row.method).title] = text
    title = f"Loss to the clean capture, {of} [dB]"
    return Table(title=title, corner="defect", frame=pd.DataFrame.from_dict(rows, orient="index").fillna("n/a"))


def beside_the_paper(tables: RunTables, suite: str) -> list[Section]:
    """Our rows beside those of the paper's tables, of which at least two were run."""
    blocks: list[Block] = []
    for spec in paper.paper_tables():
        run = tables.methods(spec.scene)
        if sum(row.method in run or row.instead in run for group in spec.rows for row in group) > 1:
            blocks += author_table.blocks(author_table.of_tables(tables, [spec]))
    note = Text(text=PAPER_NOTE.format(suite=suite), note=True)
    return [Section(title="Beside the paper", blocks=(*blocks, note))] if blocks else []


def failed_cells(results: Sequence[CellResult], missing: int) -> list[Section]:
    """Failed cells with their reasons, and how many are missing."""
    items = [f"{r.config.title}: {r.status}: {r.reason}" for r in results if r.status != "done"]
    blocks: list[Block] = [Bullets(items=tuple(items))] if items else []
    if items:
        blocks.append(Text(text="A failed cell has the worst score in every quality; it is never left out.", note=True))
    if missing:
        blocks.append(Text(text=f"Cells that are not finished: {missing}. The tables show the others.", note=True))
    return [Section(title="Failed cells" if items else "Unfinished", blocks=tuple(blocks))] if blocks else []


def again(command: str) -> list[Section]:
    """The commands that make the report again."""
    return [Section(title="Again", blocks=(Commands(items=tuple(commands_of(command))),))] if command else []


def provenance(results: Sequence[CellResult]) -> Section:
    """Where the numbers come from; cells made at several places are listed with all of them."""
    provenances = [result.provenance for result in results if result.provenance is not None]
    facts = [("protocol", PROTOCOL), ("commit", _distinct(p.commit for p in provenances))]
    facts.append(("code", _distinct(r.config.code for r in results)))
    for name in ("processor", "cores", "memory_gb", "system", "gpu", "python"):
        facts.append((name.replace("_gb", " [GB]"), _distinct(p.machine.get(name, "unknown") for p in provenances)))
    trainers = [p.versions[TRAINED_BY] for p in provenances if TRAINED_BY in p.versions]
    facts += [(TRAINED_BY, _distinct(trainers))] if trainers else []
    for name in sorted({name for p in provenances for name in p.versions} - {TRAINED_BY}):
        facts.append((name, _distinct(p.versions.get(name, "unknown") for p in provenances)))
    facts.append(("captures", _distinct(f"{r.config.scene} {r.config.size} {r.config.capture[:12]}" for r in results)))
    facts.append(("seeds", ", ".join(str(seed) for seed in sorted({r.config.seed for r in results}))))
    facts.append(("sum of all cells [min]", f"{sum(p.wall_s for p in provenances) / 60:.1f}"))
    reused = [REUSED_NOTE.format(reused=len(trainers), cells=len(results))] if trainers else []
    note = " ".join((PROVENANCE_NOTE, *reused))
    return Section(title="Provenance", blocks=(_facts("fact", facts), Text(text=note, note=True)))


def glossary() -> Section:
    """Every term with its meaning."""
    return Section(title="Glossary", blocks=(_facts("term", list(GLOSSARY.items())),), folded=True)


def _facts(corner: str, facts: Sequence[tuple[str, str]]) -> Table:
    frame = pd.DataFrame({"": [value for _, value in facts]}, index=[name for name, _ in facts])
    return Table(corner=corner, frame=frame)


def _distinct(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))
