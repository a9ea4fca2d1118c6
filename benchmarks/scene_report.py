"""What a report shows of one scene: findings, tables, charts and pictures, computed from the results."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ash.dataset import load_capture
from ash.files import InputError
from benchmarks import charts, contrasts, conventions, findings, pareto, tables
from benchmarks.cells import Cell
from benchmarks.charts import Bar, Line, Panel, Point
from benchmarks.contrasts import Contrast
from benchmarks.experiments import WRONG_BY_MM
from benchmarks.forest import Effect, ForestPanel, forest
from benchmarks.metrics import METRICS
from benchmarks.names import EXACT, is_oracle, look_of
from benchmarks.pictures import Comparison, comparisons_of, gallery, missing_pictures
from benchmarks.runs import Run
from benchmarks.scores import Score, Scores
from benchmarks.tables import Column, Table

STAGES = ("stg1_ms", "stg2_ms", "stg3_ms", "stg4_ms")
COSTS = ("frame_ms", *STAGES, "train_s", "peak_rss_mb", "params", "gaussians")
STAGE_NAMES = ("Stg.1 template", "Stg.2 textures", "Stg.3 decoders", "Stg.4 skin and draw", "other")
STAGE_COLOURS = ("#2f6fde", "#2a9d8f", "#dd6b20", "#9b59b6", "#8a94a3")
PICTURED = ("ash", "ddc", "ash_truth", "ddc_truth")
MANY_CONTRASTS = 5  # Rows from which contrasts are drawn as well as listed.
MANY_POINTS = 18  # Methods from which only those that matter to accuracy against speed are named in its chart.
PLANTED = {method for mm, row in WRONG_BY_MM.items() if mm > 0 for method in row}  # They have a chart of their own.
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
    effects: str
    frontier: tuple[str, ...]
    conventions: tuple[conventions.Comparison, ...]
    comparisons: tuple[Comparison, ...]
    worst: tuple[Comparison, ...]
    no_pictures: str
    curves: str
    stages: str


def scene_report(run: Run, scores: Scores, scene: str) -> SceneReport:
    """Compute the part of one scene."""
    comparisons, worst, no_pictures = _pictures(run, scores, scene)
    established = contrasts.contrasts(scores, scene)
    return SceneReport(
        name=scene,
        headline=findings.headline(scores, scene),
        remarks=tuple(findings.remarks(scores, scene)),
        chart=speed_chart(scores, scene),
        quality=tables.build(scores, scene, _quality_columns(), title=f"Accuracy on {scene}"),
        cost=tables.build(scores, scene, tables.cost_columns(COSTS), title=f"Cost on {scene}"),
        more=_more_tables(scores, scene),
        exact=tuple(_exact_pairs(scores, scene)),
        contrasts=established,
        effects=_effects(established),
        frontier=findings.frontier(scores, scene),
        conventions=_conventions(scores, scene),
        comparisons=tuple(comparisons),
        worst=tuple(worst),
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
        if frame is None or quality is None or scores.failed(scene, method) or method in PLANTED:
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
    if len(points) > MANY_POINTS:
        named = {*best, *EXACT, *EXACT.values(), sufficient.name if sufficient else ""}
        points = [replace(point, named=method in named) for method, point in zip(index, points, strict=True)]
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


def _effects(found: Sequence[Contrast]) -> str:
    """The contrasts as a chart, where they are many enough for a table to be hard to read."""
    panels = []
    for split in contrasts.RANKED_SPLITS:
        effects = tuple(
            Effect(label=c.title, mean=c.test.mean, low=c.test.low, high=c.test.high) for c in found if c.split == split
        )
        panels.append(ForestPanel(title=tables.SPLIT_TITLES[split], effects=effects))
    many = max(len(panel.effects) for panel in panels) >= MANY_CONTRASTS
    return forest(panels, x_title="ASH minus the row [dB]") if many else ""


def _exact_pairs(scores: Scores, scene: str) -> list[Exact]:
    found = []
    for split in contrasts.RANKED_SPLITS:
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
        found.append(Exact(split=tables.SPLIT_TITLES[split], rows=rows, margin=(margins[0], margins[1])))
    return found


def _pictures(run: Run, scores: Scores, scene: str) -> tuple[list[Comparison], list[Comparison], str]:
    """Comparisons of the pictured methods, first seed, and the first one's worst frames; or why there are none."""
    done = {r.config.key: r for r in scores.results if r.config.scene == scene and r.status == "done"}
    cells: dict[str, Cell] = {}
    for cell in run.cells:
        if cell.config.key in done:
            cells.setdefault(cell.config.method, cell)
    names = [name for name in PICTURED if name in cells] or list(cells)[:4]
    chosen = [cells[name] for name in names]
    if not chosen:
        return [], [], "No pictures: every cell failed."
    try:
        capture = load_capture(chosen[0].capture_folder)
        results = [done[cell.config.key] for cell in chosen]
        return comparisons_of(capture, chosen, results), gallery(capture, chosen[0], results[0]), ""
    except InputError as error:
        return [], [], missing_pictures(run.folder, error)


def _running_median(values: Sequence[float]) -> list[float]:
    half = min(SMOOTH // 2, len(values) // 12)  # A short log is shown as it is.
    windows = [sorted(values[max(0, i - half) : i + half + 1]) for i in range(len(values))]
    return [window[len(window) // 2] for window in windows]
