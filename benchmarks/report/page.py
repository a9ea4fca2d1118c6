"""Writes the report of a run: one self-contained page, and the same content as Markdown, with tables as CSV and LaTeX.

Everything comes from the results of the run's cells; the page needs no network and no other file.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ash.files import InputError, write_atomic
from benchmarks.analysis.results import RunTables, csv_of
from benchmarks.analysis.style import titles_of
from benchmarks.report import author_table, content, defects, escaping, glossary, sections, sentences, tables, vega
from benchmarks.report.content import Section
from benchmarks.report.headings import new_headings
from benchmarks.report.pictures import Album
from benchmarks.report.scene import FEW_WORST, MANY, WORST, SceneData, scene_report
from benchmarks.report.vega import Figure
from benchmarks.suites.archive import without_places, write_archive
from benchmarks.suites.runs import Run, capture_name_of, results_of

PUBLISHED = ("report.md", "results.csv", "tables.tex", "chart_*.svg", "pictures_*.webp", "worst_*.webp")
PICTURE_SUFFIXES = (".svg", ".webp")
CELLS = "cells.zip"
PICTURE_BYTES = 10_000_000  # of all pictures that are stepped through; worst frames come on top


def write_report(run: Run, chosen_on: Run | None = None) -> list[str]:
    """Write report.html, report.md, tables.tex, results.csv, charts and pictures; returns lines for the terminal.

    `chosen_on`: the same rows on subjects for validation, whose choice of the smallest sufficient row is judged here.

    Raises:
        InputError: no cell is finished, or a result is damaged; nothing is written then.
    """
    with titles_of((cell.config for cell in run.cells), run.titles):
        return _write_report(run, chosen_on)


def _write_report(run: Run, chosen_on: Run | None) -> list[str]:
    results = results_of(run)
    run_tables = RunTables(results, {cell.config.key: capture_name_of(cell) for cell in run.cells})
    own = author_table.of_tables(run_tables, run.table)
    album = Album()
    many = sum(len(run_tables.methods(scene)) for scene in run_tables.scenes) > MANY
    made = [
        scene_report(
            SceneData(
                run=run,
                tables=run_tables,
                results=tuple(r for r in results if r.config.scene == scene and not r.config.axis),
                scene=scene,
                album=album,
                max_bytes=PICTURE_BYTES // len(run_tables.scenes),
                worst_frames=FEW_WORST if many else WORST,
            )
        )
        for scene in run_tables.scenes
    ]
    first, others = _first_sections([parts for parts, _ in made])
    curves = [*sections.training_cost(run_tables), *sections.template_errors(run_tables)]
    novelty = sections.novelty(run_tables)
    turned, turned_sheets = new_headings(run, results, run_tables, album)
    defect_parts = [defects.pictured(run, results, scene, album) for scene in run_tables.scenes]
    title = f"Report of suite {run.suite}"
    parts = [
        Section(title="", blocks=(content.Text(text=run.about[:1].upper() + run.about[1:] + "."),)),
        *first,
        *([Section(title="Tables of the suite", blocks=tuple(author_table.blocks(own)))] if own else []),
        *sections.ablations(run_tables, None if chosen_on is None else RunTables(results_of(chosen_on))),
        *sections.stabilities(run_tables),
        *(section for own_sections, _ in defect_parts for section in own_sections),
        *curves,
        *others,
        *novelty,
        *turned,
        *sections.beside_the_paper(run_tables, run.suite),
        *sections.failed_cells(results, len(run.cells) + len(run.absent) - len(results)),
        *sections.again(run.command),
        sections.provenance(results),
        sections.glossary(),
    ]
    files = {each.file: each.svg().encode() for part in parts for each in part.blocks if isinstance(each, Figure)}
    files |= {name: image for _, sheets in (*made, *defect_parts) for name, image in sheets.items()} | turned_sheets
    files |= {
        "results.csv": csv_of(_without_formulas(run_tables.all_rows)).encode(),
        "tables.tex": author_table.latex(own or author_table.default_tables(run_tables)).encode(),
        "report.md": render(title, parts, "md").encode(),
        "report.html": render(title, parts, "html", album).encode(),
    }
    for name, data in files.items():
        write_atomic(run.folder / name, data)
    shown = [line for table in own for line in (tables.plain(table.shown), table.caption, "")]
    lines = _terminal(run_tables, [*curves, *novelty], smoke=sentences.smoke(results), with_tables=not own)
    return [*lines, *shown, f"report: {run.folder / 'report.html'}"]


def _first_sections(scenes: Sequence[Sequence[Section]]) -> tuple[Sequence[Section], Sequence[Section]]:
    """What stands first, the opening of a single scene or the findings of all; and the other sections of scenes."""
    if len(scenes) == 1:
        return scenes[0][:1], scenes[0][1:]
    findings = tuple((opening.title, opening.headline) for opening, *_ in scenes)
    every = [section for opening, *others in scenes for section in (replace(opening, headline=""), *others)]
    return [Section(title="Results by scene", blocks=(content.Facts(items=findings),))], every


def write_tables(
    run: Run,
    file: Path | None = None,
    *,
    latex: Path | None = None,
    markdown: Path | None = None,
    csv: Path | None = None,
) -> list[str]:
    """Write the tables that `file` describes, by default those of the run's suite; returns lines for the terminal.

    Raises:
        InputError: see `author_table.of_run`; nothing is written then.
    """
    made = author_table.of_run(run, file)
    numbers = author_table.numbers_of(made)
    texts = {name: numbers[name].map(escaping.csv_text) for name in ("row", "method", "scene", "text")}
    if latex is not None:
        write_atomic(latex, author_table.latex(made).encode())
    if markdown is not None:
        page = render("Tables", [Section(title="", blocks=tuple(author_table.blocks(made)))], "md")
        write_atomic(markdown, page.encode())
    if csv is not None:
        write_atomic(csv, numbers.assign(**texts).to_csv(lineterminator="\n").encode())
    lines = [line for table in made for line in (tables.plain(table.shown), "", table.caption, "")]
    return [*lines, *(str(path) for path in (latex, markdown, csv) if path is not None)]


def publish(run: Run, folder: Path) -> None:
    """Copy what a repository should keep of a report, in place of an earlier one, and `cells.zip` with all numbers.

    Raises:
        InputError: the report was not written.
    """
    report = run.folder / PUBLISHED[0]
    if not report.exists():
        raise InputError(f"{run.folder}: expected {PUBLISHED[0]}, which `ash-bench report` writes")
    text = report.read_text()
    paths = [path for pattern in PUBLISHED for path in sorted(run.folder.glob(pattern))]
    paths = [path for path in paths if path.suffix not in PICTURE_SUFFIXES or path.name in text]  # of this report
    for pattern in PUBLISHED:
        for old in folder.glob(pattern):
            old.unlink()
    for path in paths:
        write_atomic(folder / path.name, without_places(text).encode() if path == report else path.read_bytes())
    write_archive(run, folder / CELLS)


def render(title: str, parts: Sequence[Section], form: Literal["html", "md"], album: Album | None = None) -> str:
    """A report by its template."""
    has_charts = any(isinstance(block, Figure | content.Flipbook) for part in parts for block in part.blocks)
    text = (
        environment(form)
        .get_template(f"report.{form}")
        .render(
            title=title,
            sections=parts,
            album=[] if album is None else album.pictures,
            library=Markup(vega.library()) if form == "html" and has_charts else "",
            dark_rules=Markup(vega.dark_rules(".vega ")),
        )
    )
    if form == "html":
        return text
    return re.sub(r"\n{3,}", "\n\n", re.sub(r" +$", "", text, flags=re.MULTILINE)).lstrip("\n")


def environment(form: Literal["html", "md"]) -> Environment:
    """The templates, with the filters that they use: HTML escapes by itself, Markdown by `md`."""
    templates = Environment(
        loader=PackageLoader("benchmarks.report"),
        autoescape=form == "html",
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {
        "md": escaping.markdown,
        "terms": _terms,
        "anchor": glossary.anchor,
        "meaning": glossary.meaning,
    }
    return templates


def _without_formulas(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.assign(**{name: rows[name].map(escaping.csv_text) for name in ("scene", "method", "capture")})


def _terminal(run_tables: RunTables, curves: list[Section], *, smoke: bool, with_tables: bool) -> list[str]:
    """Findings, what must be known to read them, and a short table of each scene."""
    lines = [
        item
        for section in curves
        for block in section.blocks
        if isinstance(block, content.Bullets)
        for item in block.items
    ]
    lines += [""] if lines else []
    for scene in run_tables.scenes:
        columns = [*tables.main_columns(run_tables, scene), *tables.cost_columns(("frame_ms", "train_s"))]
        short = tables.build(run_tables, scene, columns, title="")
        facts = (f"- {label}: {text}" for label, text in sentences.facts(run_tables, scene))
        lines += [sentences.headline(run_tables, scene, smoke=smoke), *facts, ""]
        lines += [tables.plain(short), ""] if with_tables else []
    return lines


def _terms(text: str) -> Markup:
    """The text with its glossary's words explained to the pointer, and linked to where they are listed."""
    pieces = [
        Markup('<a class="term" href="#{}" title="{}">{}</a>').format(
            glossary.anchor(term), glossary.GLOSSARY[term], piece
        )
        if term
        else escape(piece)
        for piece, term in glossary.split_terms(text)
    ]
    return Markup("").join(pieces)
