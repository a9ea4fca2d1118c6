"""Writes the report of a run: one self-contained page, and the same tables as Markdown, CSV and LaTeX.

Everything comes from the results of the run's cells; the page needs no network and no other file.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ash.dataset import load_capture
from ash.files import InputError, write_atomic
from benchmarks import charts, contrasts, conventions, findings, necessity, pareto, tables
from benchmarks.cells import Cell, CellResult
from benchmarks.charts import Bar, Line, Panel, Point
from benchmarks.contrasts import Contrast
from benchmarks.metrics import METRICS, PROTOCOL
from benchmarks.names import EXACT, is_oracle, look_of
from benchmarks.pictures import Comparison, comparisons_of, contact_sheet, missing_pictures, png
from benchmarks.results import tidy, write_csv
from benchmarks.runs import Run, failures, results_of
from benchmarks.scores import Score, Scores
from benchmarks.tables import Column, Table

STAGES = ("stg1_ms", "stg2_ms", "stg3_ms", "stg4_ms")
COSTS = ("frame_ms", *STAGES, "train_s", "peak_rss_mb", "params", "gaussians")
STAGE_NAMES = ("Stg.1 template", "Stg.2 textures", "Stg.3 decoders", "Stg.4 skin and draw", "other")
STAGE_COLOURS = ("#2f6fde", "#2a9d8f", "#dd6b20", "#9b59b6", "#8a94a3")
PICTURED = ("ash", "ddc", "ash_truth", "ddc_truth")
SMOOTH = 7  # Points of the training log under the running median: single batches differ by decibels.


@dataclass(frozen=True, kw_only=True, slots=True)
class Exact:
    """The pair of methods with the honest template and with the exact surface, on one split."""

    split: str
    rows: tuple[tuple[str, str, str, str], ...]  # method, honest dB, exact dB, gain
    margin: tuple[str, str]


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneReport:
    """Everything that the page shows about one scene."""

    name: str
    headline: str
    remarks: tuple[str, ...]
    chart: str
    quality: Table
    cost: Table
    more: tuple[Table, ...]
    exact: tuple[Exact, ...]
    contrasts: tuple[Contrast, ...]
    frontier: tuple[str, ...]
    conventions: tuple[conventions.Comparison, ...]
    comparisons: tuple[Comparison, ...]
    no_pictures: str
    curves: str
    stages: str


def write_report(run: Run) -> list[str]:
    """Write report.html, report.md, tables.tex, results.csv and the pictures; returns what to tell the user.

    Raises:
        InputError: no cell is finished, or a result is damaged; nothing is written then.
    """
    results = results_of(run)
    scores = Scores(results)
    scenes = [scene_report(run, scores, scene) for scene in scores.scenes]
    folder = run.folder
    write_csv(folder / "results.csv", tidy(results))
    for scene in scenes:
        write_atomic(folder / f"chart_{scene.name}.svg", scene.chart.encode())
        if scene.comparisons:
            write_atomic(folder / f"pictures_{scene.name}.png", png(contact_sheet(scene.comparisons)))
    write_atomic(folder / "tables.tex", latex_of(scenes).encode())
    write_atomic(folder / "report.md", markdown_of(run, results, scenes).encode())
    write_atomic(folder / "report.html", html_of(run, results, scenes).encode())
    lines = []
    for scene in scenes:
        columns = [*tables.quality_columns(("psnr", "flip")), *tables.cost_columns(("frame_ms", "train_s"))]
        short = tables.build(scores, scene.name, columns, title="")
        lines += [scene.headline, *(f"- {remark}" for remark in scene.remarks), "", tables.plain(short), ""]
    return [*lines, f"report: {folder / 'report.html'}"]


def scene_report(run: Run, scores: Scores, scene: str) -> SceneReport:
    """Compute the part of one scene."""
    comparisons, no_pictures = _pictures(run, scores, scene)
    return SceneReport(
        name=scene,
        headline=findings.headline(scores, scene),
        remarks=tuple(findings.remarks(scores, scene)),
        chart=speed_chart(scores, scene),
        quality=tables.build(scores, scene, _quality_columns(), title=f"Accuracy on {scene}"),
        cost=tables.build(scores, scene, tables.cost_columns(COSTS), title=f"Cost on {scene}"),
        more=_more_tables(scores, scene),
        exact=tuple(_exact_pairs(scores, scene)),
        contrasts=contrasts.contrasts(scores, scene),
        frontier=findings.frontier(scores, scene),
        conventions=_conventions(scores, scene),
        comparisons=tuple(comparisons),
        no_pictures=no_pictures,
        curves=training_curves(scores, scene),
        stages=stage_bars(scores, scene),
    )


def speed_chart(scores: Scores, scene: str) -> str:
    """Foreground PSNR against milliseconds per frame, for held-out views and held-out motion."""
    titles = {"novel_view": "Held-out views", "novel_pose": "Held-out motion"}
    panels = [_panel(scores, scene, split, title) for split, title in titles.items()]
    shown = [panel for panel in panels if panel.points]
    return charts.scatter(shown, x_title="ms per frame, one core (log)", y_title="foreground PSNR [dB]")


def training_curves(scores: Scores, scene: str) -> str:
    """Foreground PSNR of the training batches over seconds of training, first seed."""
    lines = []
    for method in scores.methods(scene):
        curve = scores.cells(scene, method)[0].curve
        points = [(point.seconds, point.psnr) for point in curve if point.psnr is not None and point.seconds > 0]
        look = look_of(method)
        smooth = tuple((x, y) for (x, _), y in zip(points, _running_median([y for _, y in points]), strict=True))
        lines.append(Line(label=look.title, colour=look.colour, points=smooth, dashed=is_oracle(method)))
    return charts.curves(lines, x_title="seconds of training (log)", y_title="foreground PSNR, training batches [dB]")


def stage_bars(scores: Scores, scene: str) -> str:
    """Milliseconds per frame by stage; what no stage claims is shown as other."""
    rows = []
    for method in scores.methods(scene):
        whole = scores.get(scene, method, "speed", "", "frame_ms")
        found = [scores.get(scene, method, "speed", "", stage) for stage in STAGES]
        if whole is None or scores.failed(scene, method) or not any(found):
            continue
        parts = [stage.mean if stage else 0.0 for stage in found]
        rows.append(Bar(label=look_of(method).title, parts=(*parts, max(0.0, whole.mean - sum(parts)))))
    return charts.bars(rows, STAGE_NAMES, STAGE_COLOURS, unit="ms")


def html_of(run: Run, results: Sequence[CellResult], scenes: Sequence[SceneReport]) -> str:
    """The page."""
    environment = Environment(
        loader=PackageLoader("benchmarks"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["inline"] = Markup
    scores = Scores(results)
    return environment.get_template("report.html").render(
        needs=needs_of(scores),
        run=run,
        scenes=scenes,
        results=results,
        failed=failures(results),
        facts=provenance_facts(results),
        protocol=PROTOCOL,
        missing=len(run.cells) - len(results),
        ways=conventions.CONVENTIONS,
    )


def needs_of(scores: Scores) -> list[necessity.Matrix]:
    """The necessity matrices of a run over several scenes."""
    found = [
        necessity.matrix(scores, split, title=tables.SPLIT_TITLES[split]) for split in ("novel_view", "novel_pose")
    ]
    return [matrix for matrix in found if matrix is not None]


def markdown_of(run: Run, results: Sequence[CellResult], scenes: Sequence[SceneReport]) -> str:
    """The report for places that show Markdown."""
    parts = [f"# Report of suite {run.suite}", run.about[:1].upper() + run.about[1:] + "."]
    parts += [_need_rows(matrix) for matrix in needs_of(Scores(results))]
    for scene in scenes:
        parts += [f"## {scene.name}", f"**{scene.headline}**", "\n".join(f"- {remark}" for remark in scene.remarks)]
        parts.append(_contrast_rows(scene.contrasts))
        parts.append(f"![Accuracy against speed](chart_{scene.name}.svg)")
        parts += [
            f"### {table.title}\n\n{tables.markdown(table)}" for table in (scene.quality, scene.cost, *scene.more)
        ]
        parts.append("Best in bold, second best in italics; methods given the exact surface are not ranked.")
        if scene.comparisons:
            parts.append(f"![Truth, methods and errors](pictures_{scene.name}.png)")
    failed = [f"- {result.config.title}: {result.status}: {result.reason}" for result in failures(results)]
    if failed:
        parts.append("## Failed cells\n\n" + "\n".join(failed))
    parts.append("## Provenance\n\n" + "\n".join(f"- {name}: {value}" for name, value in provenance_facts(results)))
    if run.command:
        parts.append(f"Command: `{run.command}`")
    return "\n\n".join(part for part in parts if part) + "\n"


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


def _quality_columns() -> list[Column]:
    silhouette = [Column(split=s, region="full", metric="iou", group=g) for s, g in tables.SPLIT_TITLES.items()]
    quality = tables.quality_columns()
    half = len(quality) // 2
    return [*quality[:half], silhouette[0], *quality[half:], silhouette[1]]


def _more_tables(scores: Scores, scene: str) -> tuple[Table, ...]:
    splits = tables.SPLIT_TITLES
    geometry = [
        Column(split=split, region="", metric=metric, group=group)
        for split, group in list(splits.items())[:2]
        for metric in ("template_mm", "surface_mm")
    ]
    geometry.append(Column(split="novel_pose", region="foreground", metric="flicker", group="Novel pose"))
    whole = [
        Column(split=split, region=region, metric=metric, group=group)
        for split, group in splits.items()
        for region, metric in (("full", "psnr"), ("release_crop", "psnr"), ("full", "ssim"), ("full", "flip"))
    ]
    training = [
        Column(split="train_view", region="foreground", metric=m, group="Training view")
        for m in ("psnr", "ssim", "flip")
    ]
    ceiling = [Column(split=s, region="foreground", metric="noise_ceiling", group=g) for s, g in splits.items()]
    found = [
        tables.build(scores, scene, geometry, title="Geometry against the truth, and flicker beyond the truth's own"),
        tables.build(scores, scene, whole, title="Whole frame, and the crop of the released ASH code"),
        tables.build(
            scores, scene, [*training, *ceiling], title="Training views, and the noise ceiling of the renders"
        ),
    ]
    return tuple(table for table in found if table.columns)


def _conventions(scores: Scores, scene: str) -> tuple[conventions.Comparison, ...]:
    asked = [(split, metric) for split in ("novel_view", "novel_pose") for metric in ("psnr", "ssim")]
    titles = [f"{tables.SPLIT_TITLES[split]}, {METRICS[metric].title}" for split, metric in asked]
    found = [conventions.compare(scores, scene, *pair, title=t) for pair, t in zip(asked, titles, strict=True)]
    return tuple(comparison for comparison in found if comparison is not None)


def _panel(scores: Scores, scene: str, split: str, title: str) -> Panel:
    points: list[Point] = []
    index: dict[str, int] = {}
    for method in scores.methods(scene):
        frame, quality = scores.get(scene, method, "speed", "", "frame_ms"), scores.fg(scene, method, split)
        if frame is None or quality is None or scores.failed(scene, method):
            continue
        index[method] = len(points)
        points.append(_point(method, frame, quality))
    links = tuple((index[a], index[b]) for a, b in EXACT.items() if a in index and b in index)
    ceiling = next((c for m in index if (c := scores.fg(scene, m, split, "noise_ceiling"))), None)
    competing = contrasts.candidates(scores, scene, split)
    best = pareto.front(competing)
    sufficient = pareto.smallest_sufficient(competing)
    if sufficient is not None:
        points[index[sufficient.name]] = replace(points[index[sufficient.name]], ringed=True)
    note = f"noise ceiling {ceiling.mean:.1f} dB" if ceiling else ""
    return Panel(title=title, points=tuple(points), links=links, front=tuple(index[m] for m in best), note=note)


def _point(method: str, frame: Score, quality: Score) -> Point:
    look, spread = look_of(method), quality.half_width
    return Point(
        x=frame.mean,
        y=quality.mean,
        label=look.title,
        colour=look.colour,
        hollow=is_oracle(method),
        low=None if spread is None else quality.mean - spread,
        high=None if spread is None else quality.mean + spread,
    )


def _exact_pairs(scores: Scores, scene: str) -> list[Exact]:
    found = []
    for split, title in list(tables.SPLIT_TITLES.items())[:2]:
        quads = [[scores.fg(scene, name, split) for name in pair] for pair in EXACT.items()]
        failed = any(scores.failed(scene, name) for pair in EXACT.items() for name in pair)
        if failed or any(score is None for pair in quads for score in pair):
            continue
        values = [[score.mean for score in pair if score] for pair in quads]
        rows = tuple(
            (look_of(method).title, f"{honest:.2f}", f"{exact:.2f}", f"{exact - honest:+.2f}")
            for method, (honest, exact) in zip(EXACT, values, strict=True)
        )
        margins = tuple(f"{values[0][i] - values[1][i]:+.2f}" for i in (0, 1))
        found.append(Exact(split=title, rows=rows, margin=(margins[0], margins[1])))
    return found


def _pictures(run: Run, scores: Scores, scene: str) -> tuple[list[Comparison], str]:
    """Comparisons of the pictured methods, first seed; or the reason why there are none."""
    done = {r.config.key: r for r in scores.results if r.config.scene == scene and r.status == "done"}
    cells: dict[str, Cell] = {}
    for cell in run.cells:
        if cell.config.key in done:
            cells.setdefault(cell.config.method, cell)
    names = [name for name in PICTURED if name in cells] or list(cells)[:4]
    chosen = [cells[name] for name in names]
    if not chosen:
        return [], "No pictures: every cell failed."
    try:
        capture = load_capture(chosen[0].capture_folder)
        return comparisons_of(capture, chosen, [done[cell.config.key] for cell in chosen]), ""
    except InputError as error:
        return [], missing_pictures(run.folder, error)


def _running_median(values: Sequence[float]) -> list[float]:
    half = min(SMOOTH // 2, len(values) // 12)  # A short log is shown as it is.
    windows = [sorted(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]
    return [window[len(window) // 2] for window in windows]


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))
