"""Writes the report of a run: one self-contained page, and the same tables as Markdown, CSV and LaTeX.

Everything comes from the results of the run's cells; the page needs no network and no other file.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ash.files import InputError, write_atomic
from benchmarks import causes, conventions, courses, necessity, paper, tables
from benchmarks.cells import CellResult
from benchmarks.contrasts import Contrast
from benchmarks.metrics import PROTOCOL
from benchmarks.pictures import contact_sheet, png
from benchmarks.results import tidy, write_csv
from benchmarks.runs import Run, failures, results_of
from benchmarks.scene_report import SceneReport, scene_report
from benchmarks.scores import Scores

PUBLISHED = ("report.md", "results.csv", "tables.tex", "chart_*.svg", "pictures_*.png", "worst_*.png")


@dataclass(frozen=True, kw_only=True, slots=True)
class Sections:
    """What a report says about a run as a whole, beside its scenes. Empty where the suite does not ask for it."""

    needs: tuple[necessity.Matrix, ...]
    beside: tuple[paper.Beside, ...]
    stability: tuple[courses.StabilityReport, ...]
    margin: courses.MarginReport | None


def sections_of(results: Sequence[CellResult], scores: Scores) -> Sections:
    """Compute the sections."""
    needs = [
        necessity.matrix(scores, split, title=tables.SPLIT_TITLES[split]) for split in ("novel_view", "novel_pose")
    ]
    return Sections(
        needs=tuple(matrix for matrix in needs if matrix is not None),
        beside=paper.beside_the_paper(scores),
        stability=courses.stability_reports(results),
        margin=courses.margin_report(scores),
    )


def write_report(run: Run) -> list[str]:
    """Write report.html, report.md, tables.tex, results.csv and the pictures; returns what to tell the user.

    Raises:
        InputError: no cell is finished, or a result is damaged; nothing is written then.
    """
    results = results_of(run)
    scores = Scores(results)
    sections = sections_of(results, scores)
    scenes = [scene_report(run, scores, scene) for scene in scores.scenes]
    folder, lines = run.folder, list[str]()
    write_csv(folder / "results.csv", tidy(results))
    for scene in scenes:
        write_atomic(folder / f"chart_{scene.name}.svg", scene.chart.encode())
        if scene.effects:
            write_atomic(folder / f"chart_effects_{scene.name}.svg", scene.effects.encode())
        if scene.comparisons:
            write_atomic(folder / f"pictures_{scene.name}.png", png(contact_sheet(scene.comparisons)))
        if scene.worst:
            write_atomic(folder / f"worst_{scene.name}.png", png(contact_sheet(scene.worst)))
    for found in sections.stability:
        for index, (_, chart) in enumerate(found.charts):
            write_atomic(folder / f"chart_stability_{found.scene}_{index}.svg", chart.encode())
    if sections.margin is not None:
        write_atomic(folder / "chart_levels.svg", sections.margin.levels.encode())
        write_atomic(folder / "chart_margin.svg", sections.margin.chart.encode())
        lines = [*sections.margin.sentences, ""]
    write_atomic(folder / "tables.tex", latex_of(scenes).encode())
    write_atomic(folder / "report.md", markdown_of(run, results, sections, scenes).encode())
    write_atomic(folder / "report.html", html_of(run, results, sections, scenes).encode())
    for scene in scenes:
        columns = [*tables.quality_columns(("psnr", "flip")), *tables.cost_columns(("frame_ms", "train_s"))]
        short = tables.build(scores, scene.name, columns, title="")
        lines += [scene.headline, *(f"- {remark}" for remark in scene.remarks), "", tables.plain(short), ""]
    return [*lines, f"report: {folder / 'report.html'}"]


def publish(run: Path, folder: Path) -> None:
    """Copy what a repository should keep of a report, in place of what an earlier one left there.

    Raises:
        InputError: the report was not written.
    """
    found = [path for pattern in PUBLISHED for path in sorted(run.glob(pattern))]
    if not (run / PUBLISHED[0]).exists():
        raise InputError(f"{run}: expected {PUBLISHED[0]}, which `ash-bench report` writes")
    for pattern in PUBLISHED:
        for old in folder.glob(pattern):
            old.unlink()
    for path in found:
        write_atomic(folder / path.name, path.read_bytes())


def html_of(run: Run, results: Sequence[CellResult], sections: Sections, scenes: Sequence[SceneReport]) -> str:
    """The page."""
    environment = Environment(
        loader=PackageLoader("benchmarks"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = Markup
    return environment.get_template("report.html").render(
        needs=sections.needs,
        margin=sections.margin,
        stability=sections.stability,
        beside=sections.beside,
        paper_head=paper.HEAD,
        paper_groups=paper.GROUPS,
        run=run,
        scenes=scenes,
        results=results,
        failed=failures(results),
        facts=provenance_facts(results),
        protocol=PROTOCOL,
        missing=len(run.cells) - len(results),
        regions=tuple(zip(causes.REGIONS, causes.REGION_COLOURS, strict=True)),
        ways=conventions.CONVENTIONS,
    )


def markdown_of(run: Run, results: Sequence[CellResult], sections: Sections, scenes: Sequence[SceneReport]) -> str:
    """The report for places that show Markdown."""
    parts = [f"# Report of suite {run.suite}", run.about[:1].upper() + run.about[1:] + "."]
    parts += [_need_rows(matrix) for matrix in sections.needs]
    parts += [_stability_rows(found) for found in sections.stability]
    if sections.margin is not None:
        parts += ["### Quality against the template's error", "![Quality](chart_levels.svg)"]
        parts += ["### ASH minus DDC against the template's error", "![Margin](chart_margin.svg)"]
        parts.append("\n".join(f"- {sentence}" for sentence in sections.margin.sentences))
    for scene in scenes:
        parts += [f"## {scene.name}", f"**{scene.headline}**", "\n".join(f"- {remark}" for remark in scene.remarks)]
        parts += [f"![Differences with intervals](chart_effects_{scene.name}.svg)"] if scene.effects else []
        parts.append(_contrast_rows(scene.contrasts))
        parts.append(f"![Accuracy against speed](chart_{scene.name}.svg)")
        parts += [
            f"### {table.title}\n\n{tables.markdown(table)}" for table in (scene.quality, scene.cost, *scene.more)
        ]
        parts.append("Best in bold, second best in italics; methods given the exact surface are not ranked.")
        if scene.comparisons:
            parts.append(f"![Truth, methods and errors](pictures_{scene.name}.png)")
        if scene.worst:
            parts.append(f"### The worst frames, and why\n\n![The worst frames](worst_{scene.name}.png)")
            parts.append("\n".join(f"- {worst.title}" for worst in scene.worst))
    parts += [_paper_rows(found) for found in sections.beside]
    failed = [f"- {result.config.title}: {result.status}: {result.reason}" for result in failures(results)]
    if failed:
        parts.append("## Failed cells\n\n" + "\n".join(failed))
    parts.append("## Provenance\n\n" + "\n".join(f"- {name}: {value}" for name, value in provenance_facts(results)))
    if run.command:
        parts.append(f"Command: `{run.command}`")
    return "\n\n".join(part for part in parts if part) + "\n"


def _paper_rows(beside: paper.Beside) -> str:
    groups = [f"{name} {head}" for (name, _), head in zip(_spread_groups(), paper.HEAD, strict=True)]
    lines = [f"### Beside the paper: {beside.title}", "", "| method | " + " | ".join(groups) + " |"]
    lines.append("|---|" + "---:|" * len(groups))
    lines += ["| " + " | ".join(row) + " |" for row in beside.rows]
    lines += ["", *(f"- Kendall's tau, {tables.SPLIT_TITLES[a.split].lower()}: {a.text}" for a in beside.agreements)]
    return "\n".join(lines)


def _spread_groups() -> list[tuple[str, int]]:
    return [group for group in paper.GROUPS for _ in range(group[1])]


def _stability_rows(found: courses.StabilityReport) -> str:
    lines = [f"### Where methods fail on {found.scene}", ""]
    for index, (title, _) in enumerate(found.charts):
        lines += [f"![{title}](chart_stability_{found.scene}_{index}.svg)", ""]
    lines += ["Breakdown point (the worst loss along the axis):", ""]
    lines += ["| axis | split | " + " | ".join(found.methods) + " |", "|---|---|" + "---|" * len(found.methods)]
    lines += [f"| {row.axis} | {row.split} | " + " | ".join(row.entries) + " |" for row in found.breakdowns]
    lines += [
        "",
        "| method | failed cells | 95 % interval of the rate | diverged | spread over seeds |",
        "|---|---|---|---|---|",
    ]
    for row in found.reliability:
        spread = "n/a" if row.spread_db is None else f"{row.spread_db:.2f} dB"
        rate = f"{100 * row.rate[0]:.0f} to {100 * row.rate[1]:.0f} %"
        lines.append(f"| {row.title} | {row.failures} of {row.cells} | {rate} | {row.diverged} | {spread} |")
    return "\n".join(lines)


def _need_rows(matrix: necessity.Matrix) -> str:
    lines = [f"### What each scene needs: {matrix.title}, dB lost without the part", ""]
    lines += ["| scene | " + " | ".join(matrix.parts) + " |", "|---|" + "---|" * len(matrix.parts)]
    for row in matrix.rows:
        cells = ["n/a" if loss is None else f"{loss.text} {loss.verdict}" for loss in row.losses]
        lines.append(f"| {row.scene} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _contrast_rows(found: Sequence[Contrast]) -> str:
    lines = ["| ASH minus | split | dB | 95 % interval | p (Holm) | detectable |", "|---|---|---:|---:|---:|---:|"]
    for c in found:
        interval = f"[{c.test.low:+.2f}, {c.test.high:+.2f}]"
        split = tables.SPLIT_TITLES[c.split]
        lines.append(
            f"| {c.title} | {split} | {c.test.mean:+.2f} | {interval} | {c.p_adjusted:.2g} | {c.test.detectable:.2f} |"
        )
    return "\n".join(lines) if found else ""


def latex_of(scenes: Sequence[SceneReport]) -> str:
    """All tables for a paper."""
    head = "% Needs booktabs and colortbl, and \\definecolor{antiquebrass}{rgb}{0.98, 0.92, 0.84}\n"
    return (
        head
        + "\n\n".join(f"% {t.title}\n{tables.latex(t)}" for s in scenes for t in (s.quality, s.cost, *s.more))
        + "\n"
    )


def provenance_facts(results: Sequence[CellResult]) -> list[tuple[str, str]]:
    """Where the numbers come from; cells made at several places are listed with all of them."""
    known = [result.provenance for result in results if result.provenance is not None]
    facts = [("protocol", PROTOCOL), ("commit", _all_of(p.commit for p in known))]
    for name in ("processor", "cores", "memory_gb", "system", "gpu", "python"):
        facts.append((name.replace("_gb", " [GB]"), _all_of(p.machine.get(name, "unknown") for p in known)))
    for name in sorted({name for p in known for name in p.versions}):
        facts.append((name, _all_of(p.versions.get(name, "unknown") for p in known)))
    facts.append(("captures", _all_of(f"{r.config.scene} {r.config.size} {r.config.capture[:12]}" for r in results)))
    facts.append(("seeds", ", ".join(str(seed) for seed in sorted({r.config.seed for r in results}))))
    facts.append(("sum of all cells [min]", f"{sum(p.wall_s for p in known) / 60:.1f}"))
    return facts


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))
