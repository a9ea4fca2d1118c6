"""Writes the report of a run: one self-contained page, and the same content as Markdown, with tables as CSV and LaTeX.

Everything comes from the results of the run's cells; the page needs no network and no other file.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from ash.files import InputError, write_atomic
from benchmarks.analysis.scores import Scores, csv_of, scores_of
from benchmarks.analysis.style import titles_of
from benchmarks.cell.cells import CellResult, printable
from benchmarks.report import content, escaping, glossary, needs, sections, sentences, tables, vega
from benchmarks.report.content import Report, Section
from benchmarks.report.pictures import Album
from benchmarks.report.scene import FEW_WORST, MANY, WORST, SceneData, SceneReport, scene_report
from benchmarks.report.vega import Figure
from benchmarks.suites.archive import write_archive
from benchmarks.suites.runs import Run, results_of

PUBLISHED = ("report.md", "results.csv", "tables.tex", "chart_*.svg", "pictures_*.png", "worst_*.png")
PICTURED = (".svg", ".png")
CELLS = "cells.zip"
PICTURE_BYTES = 10_000_000  # of all pictures that are stepped through; worst frames come on top
LATEX_HEAD = "% Needs booktabs and colortbl, and \\definecolor{antiquebrass}{rgb}{0.98, 0.92, 0.84}\n"


def write_report(run: Run, chosen_on: Run | None = None) -> list[str]:
    """Write report.html, report.md, tables.tex, results.csv, charts and pictures; returns what to tell the user.

    `chosen_on`: the same rows on people for validation, whose choice of the smallest that suffices is judged here.

    Raises:
        InputError: no cell is finished, or a result is damaged; nothing is written then.
    """
    with titles_of((cell.config for cell in run.cells), run.titles):
        return _write_report(run, chosen_on)


def _write_report(run: Run, chosen_on: Run | None) -> list[str]:
    results = results_of(run)
    scores = scores_of(results, {cell.config.key: printable(cell.capture_folder.name) for cell in run.cells})
    album = Album()
    scenes = {scene: scene_report(_scene(run, results, scores, album, scene)) for scene in scores.scenes}
    findings, novelties = [*sections.spent(results), *sections.margins(scores)], sections.novelties(scores)
    report = Report(
        title=f"Report of suite {run.suite}",
        sections=(
            Section(title="", blocks=(content.Text(text=run.about[:1].upper() + run.about[1:] + "."),)),
            *needs.sections(scores, None if chosen_on is None else scores_of(results_of(chosen_on))),
            *sections.stabilities(scores),
            *findings,
            *(section for scene in scenes.values() for section in scene.sections),
            *novelties,
            *sections.beside_the_paper(scores, run.suite),
            *sections.failed_cells(results, len(run.cells) - len(results)),
            sections.provenance(results, run.command),
            sections.glossary(),
        ),
    )
    files = {f"{figure.file}": figure.svg().encode() for figure in figures_of(report)}
    files |= {name: png for scene in scenes.values() for name, png in scene.sheets.items()}
    files |= {
        "results.csv": csv_of(_harmless(scores)).encode(),
        "tables.tex": _latex(scenes.values()).encode(),
        "report.md": render(report, "md").encode(),
        "report.html": render(report, "html", album).encode(),
    }
    for name, data in files.items():
        write_atomic(run.folder / name, data)
    return [*_told(scores, [*findings, *novelties]), f"report: {run.folder / 'report.html'}"]


def publish(run: Run, folder: Path) -> None:
    """Copy what a repository should keep of a report, in place of what an earlier one left there, and all its numbers.

    Raises:
        InputError: the report was not written.
    """
    report = run.folder / PUBLISHED[0]
    if not report.exists():
        raise InputError(f"{run.folder}: expected {PUBLISHED[0]}, which `ash-bench report` writes")
    told = report.read_text()
    found = [path for pattern in PUBLISHED for path in sorted(run.folder.glob(pattern))]
    found = [path for path in found if path.suffix not in PICTURED or path.name in told]  # Not an earlier report's.
    for pattern in PUBLISHED:
        for old in folder.glob(pattern):
            old.unlink()
    for path in found:
        write_atomic(folder / path.name, path.read_bytes())
    write_archive(run, folder / CELLS)


def figures_of(report: Report) -> Iterator[Figure]:
    """Every chart that becomes a file."""
    for section in report.sections:
        for block in section.blocks:
            if isinstance(block, content.Chart):
                yield block.figure


def render(report: Report, form: Literal["html", "md"], album: Album | None = None) -> str:
    """The report by its template."""
    template = environment(form).get_template(f"report.{form}")
    text = template.render(
        report=report,
        album=[] if album is None else album.pictures,
        library=Markup(vega.library()) if form == "html" else "",
        dark_rules=Markup(vega.dark_rules(".vega ")),
    )
    return text if form == "html" else "\n".join(_without_blank_runs(text.splitlines())) + "\n"


def environment(form: Literal["html", "md"]) -> Environment:
    """The templates, with the filters that they use: HTML escapes by itself, Markdown by `md`."""
    found = Environment(
        loader=PackageLoader("benchmarks.report"),
        autoescape=form == "html",
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"md": escaping.markdown, "terms": _terms, "anchor": glossary.anchor}
    found.globals |= {"glossary": glossary.GLOSSARY}
    return found


def _scene(run: Run, found: Sequence[CellResult], scores: Scores, album: Album, scene: str) -> SceneData:
    results = tuple(r for r in found if r.config.scene == scene and not r.config.axis)
    many = sum(len(scores.methods(each)) for each in scores.scenes) > MANY
    room = PICTURE_BYTES // len(scores.scenes)
    worst = FEW_WORST if many else WORST
    return SceneData(run=run, scores=scores, results=results, scene=scene, album=album, room=room, worst_frames=worst)


def _harmless(scores: Scores):
    texts = {name: scores.rows[name].map(escaping.csv_text) for name in ("scene", "method", "capture")}
    return scores.rows.assign(**texts)


def _latex(scenes: Iterable[SceneReport]) -> str:
    found = [table for scene in scenes for table in scene.tables]
    return LATEX_HEAD + "\n\n".join(f"% {escaping.one_line(t.title)}\n{tables.latex(t)}" for t in found) + "\n"


def _told(scores: Scores, findings: list[Section]) -> list[str]:
    """What the terminal shows: findings, remarks and a short table of each scene."""
    lines = [
        item
        for section in findings
        for block in section.blocks
        if isinstance(block, content.Bullets)
        for item in block.items
    ]
    lines += [""] if lines else []
    for scene in scores.scenes:
        columns = [*tables.quality_columns(("psnr", "flip")), *tables.cost_columns(("frame_ms", "train_s"))]
        short = tables.build(scores, scene, columns, title="")
        remarks = (f"- {remark}" for remark in sentences.remarks(scores, scene))
        lines += [sentences.headline(scores, scene), *remarks, "", tables.plain(short), ""]
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


def _without_blank_runs(lines: list[str]) -> Iterator[str]:
    before = ""
    for line in lines:
        if line.strip() or before.strip():
            yield line.rstrip()
        before = line
