"""What a report says about a run as a whole, beside its scenes: effects, stability, the template's error, the paper."""

from collections.abc import Iterable, Sequence

import pandas as pd

from benchmarks.analysis import data_scaling, novelty, paper, stability, template_error, time_to_quality
from benchmarks.analysis.scores import FRAME_MS, RANKED_SPLITS, Quantity, Scores, foreground
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.cells import CellResult
from benchmarks.cell.metrics import METRICS, PROTOCOL
from benchmarks.report import charts, vega
from benchmarks.report.content import Block, Bullets, Chart, Entry, Head, Row, Section, Table, Text, texts
from benchmarks.report.glossary import GLOSSARY
from benchmarks.report.tables import entry_of
from benchmarks.report.vega import Figure, Series

WHISKERS = "Whiskers: 95 % interval over seeds, or over captures where there are several."
FIXED_MESH = "A fixed mesh with the best texture shows what the geometry alone is worth. "
KEPT = "Avatars kept on the way, at learning rates that fall only at the end."


def margins(scores: Scores) -> list[Section]:
    """Quality and margin against the template's error, where templates of known error were run."""
    curves = template_error.margin_curves(scores)
    if not curves:
        return []
    levels = pd.DataFrame(
        [
            _sample(c, template_error.LEVEL_TITLES[level.method], mm, psnr.mean, psnr.low, psnr.high)
            for c in curves
            for level in c.levels
            for mm, psnr in level.qualities
        ]
    )
    known, own = "planted error", "learned template"
    margins = [(c, known, m) for c in curves for m in c.known] + [(c, own, m) for c in curves for m in c.learned]
    differences = pd.DataFrame([_sample(c, name, m.error_mm, m.mean, m.low, m.high) for c, name, m in margins])
    rules = [(_place(c), 0.0, "") for c in curves]
    rules += [(_place(c), c.paper_db, f"the paper's {c.paper_db:+.1f} dB") for c in curves if c.paper_db is not None]
    run = {level.method for curve in curves for level in curve.levels}
    titles = {method: title for method, title in template_error.LEVEL_TITLES.items() if method in run}
    looks = [Series(title=title, colour=style_of(method).colour) for method, title in titles.items()]
    pair = [Series(title=known, colour=vega.BLUE), Series(title=own, colour=vega.ORANGE, shape="square")]
    size = (390, 240)
    figures = (
        Figure(
            name="levels",
            title="Quality against the template's error",
            caption="Foreground PSNR when a method is given a template that is wrong by a known amount (the exact "
            f"surface, displaced smoothly). {FIXED_MESH if 'oracle_texture' in run else ''}{WHISKERS}",
            panels=charts.lines(levels, looks, y="foreground PSNR [dB]", size=size),
            series=tuple(looks),
        ),
        Figure(
            name="margin",
            title="ASH minus DDC against the template's error",
            caption="Foreground PSNR of ASH minus DDC when both are given such a template, and on templates that both "
            f"learned. {WHISKERS}",
            panels=charts.lines(
                differences,
                pair,
                y="ASH minus DDC [dB]",
                size=size,
                rules=pd.DataFrame(rules, columns=["panel", "y", "text"]),
            ),
            series=tuple(pair),
        ),
    )
    placed = [placement for curve in curves if (placement := template_error.placement(curve))]
    findings = Bullets(items=(*map(template_error.sentence, curves), *placed))
    return [Section(title="The margin explained", blocks=(*map(_chart, figures), findings))]


def spent(results: Sequence[CellResult]) -> list[Section]:
    """Quality against training seconds and against training frames, where a suite made them."""
    found = []
    if len(table := time_to_quality.curves(results)):
        title = "Accuracy against training seconds"
        figure = _spent_figure(table, "budget", title, "seconds", "seconds of training", KEPT)
        found.append((figure, time_to_quality.sentences(table)))
    if len(table := data_scaling.curves(results)):
        title = "Held-out motion against the number of training frames"
        found.append(
            (_spent_figure(table, "footage", title, "frames", "training frames"), data_scaling.sentences(table))
        )
    return [Section(title=f.title, blocks=(_chart(f), Bullets(items=tuple(said)))) for f, said in found]


def novelties(scores: Scores) -> list[Section]:
    """Quality by how far a pose lies from training's, where the held-out motion is wide enough for a curve."""
    table = novelty.curves(scores.images)
    if not len(table):
        return []
    methods = list(table["method"].unique())
    looks = vega.series_of(methods)
    names = {method: look.title for method, look in zip(methods, looks, strict=True)}
    samples = pd.DataFrame(
        {
            "panel": table["scene"],
            "scale": table["scene"],
            "x_title": "novelty of the pose [degrees]",
            "series": table["method"].map(names),
            "x": table["novelty_deg"].round(1),
            "y": table["psnr"],
            "low": table["low"],
            "high": table["high"],
            "crossed": False,
        }
    )
    figure = Figure(
        name="novelty",
        title="Quality against novelty",
        caption="Foreground PSNR by how far a pose lies from the nearest training pose: the mean over the joints of "
        "the angle between their rotations, the heading removed. At zero: held-out views of training poses. The frames "
        f"of near, new and far motion stand in bins of equal number, each at its mean. {WHISKERS} "
        "What captures add to all methods is taken out.",
        panels=charts.lines(samples, looks, y="foreground PSNR [dB]", size=(390, 240)),
        series=looks,
    )
    return [Section(title=figure.title, blocks=(_chart(figure), Bullets(items=tuple(novelty.sentences(table)))))]


def _spent_figure(table: pd.DataFrame, name: str, title: str, spent: str, x_title: str, told: str = "") -> Figure:
    """A panel per scene and split: a line with intervals per method, over the logarithm of what was spent."""
    methods = list(table["method"].unique())
    looks = vega.series_of(methods)
    names = {method: look.title for method, look in zip(methods, looks, strict=True)}
    samples = pd.DataFrame(
        {
            "panel": table["scene"] + ", " + table["split"].map(lambda split: SPLIT_NAMES[split].words),
            "scale": table["scene"],
            "x_title": x_title,
            "series": table["method"].map(names),
            "x": table[spent].astype(float),
            "y": table["psnr"],
            "low": table["low"],
            "high": table["high"],
            "crossed": False,
        }
    )
    panels = charts.lines(samples, looks, y="foreground PSNR [dB]", size=(390, 240), log=True)
    caption = " ".join(filter(None, ("Foreground PSNR.", told, WHISKERS)))
    return Figure(name=name, title=title, caption=caption, panels=panels, series=looks)


def stabilities(scores: Scores) -> list[Section]:
    """Where methods fail, per scene that was stressed."""
    curves = stability.curves(scores)
    return [
        _stability(scores, scene, [curve for curve in curves if curve.scene == scene])
        for scene in dict.fromkeys(curve.scene for curve in curves)
    ]


def beside_the_paper(scores: Scores, suite: str) -> list[Section]:
    """Our rows beside those of the paper's tables."""
    blocks: list[Block] = []
    for table, agreements in paper.tables_beside(scores):
        blocks.append(_paper_table(scores, table))
        taus = (f"Kendall's tau, {SPLIT_NAMES[a.split].title.lower()}: {a.text}" for a in agreements)
        blocks.append(Bullets(items=(*taus, *(row.note for row in table.rows if row.note))))
    note = (
        "The paper: captured data at 1285x940 and weeks on a GPU, PSNR of the release's convention. Ours: "
        "foreground PSNR "
        f"on {suite}. Levels cannot be compared, orders can; interval of Kendall's tau: captures, or seeds of a "
        "single one, drawn anew."
    )
    return [Section(title="Beside the paper", blocks=(*blocks, Text(text=note, note=True)))] if blocks else []


def failed_cells(results: Sequence[CellResult], missing: int) -> list[Section]:
    """What did not come through, and what is not there yet."""
    items = [f"{r.config.title}: {r.status}: {r.reason}" for r in results if r.status != "done"]
    blocks: list[Block] = [Bullets(items=tuple(items))] if items else []
    if items:
        blocks.append(Text(text="A failed cell has the worst score in every quality; it is never left out.", note=True))
    if missing:
        blocks.append(Text(text=f"{missing} cells are not finished; the tables show those that are.", note=True))
    return [Section(title="Failed cells" if items else "Unfinished", blocks=tuple(blocks))] if blocks else []


def provenance(results: Sequence[CellResult], command: str) -> Section:
    """Where the numbers come from; cells made at several places are listed with all of them."""
    known = [result.provenance for result in results if result.provenance is not None]
    facts = [("protocol", PROTOCOL), ("commit", _all_of(p.commit for p in known))]
    facts.append(("code", _all_of(r.config.code for r in results)))
    for name in ("processor", "cores", "memory_gb", "system", "gpu", "python"):
        facts.append((name.replace("_gb", " [GB]"), _all_of(p.machine.get(name, "unknown") for p in known)))
    for name in sorted({name for p in known for name in p.versions}):
        facts.append((name, _all_of(p.versions.get(name, "unknown") for p in known)))
    facts.append(("captures", _all_of(f"{r.config.scene} {r.config.size} {r.config.capture[:12]}" for r in results)))
    facts.append(("seeds", ", ".join(str(seed) for seed in sorted({r.config.seed for r in results}))))
    facts.append(("sum of all cells [min]", f"{sum(p.wall_s for p in known) / 60:.1f}"))
    facts += [("command", command)] if command else []
    note = (
        f"Protocol {PROTOCOL}: predictions are quantised to 8 bits on black before anything is compared. "
        "Code: hash of the sources that decide a cell. "
        "results.csv beside "
        "this report has every number; each cell's result.json the scores of every image. Differences are taken before "
        "numbers are rounded."
    )
    return Section(title="Provenance", blocks=(_facts("fact", facts), Text(text=note, note=True)))


def glossary() -> Section:
    """Every term with its meaning."""
    return Section(title="Glossary", blocks=(_facts("term", list(GLOSSARY.items())),), folded=True)


def _facts(corner: str, facts: Sequence[tuple[str, str]]) -> Table:
    rows = tuple(Row(name=name, entries=texts(value)) for name, value in facts)
    return Table(title="", corner=corner, columns=(Head(title=""),), rows=rows)


def _all_of(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))


def _chart(figure: Figure) -> Chart:
    return Chart(figure=figure)


def _place(curve: template_error.MarginCurve) -> str:
    return f"{curve.scene}, {SPLIT_NAMES[curve.split].words}"


def _sample(
    curve: template_error.MarginCurve, name: str, mm: float, mean: float, low: float | None, high: float | None
) -> dict[str, object]:
    where = {"panel": _place(curve), "x_title": "template error [mm rms]", "series": name, "crossed": False}
    return {**where, "x": mm, "y": mean, "low": low, "high": high}


def _stability(scores: Scores, scene: str, curves: Sequence[stability.Curve]) -> Section:
    methods = [m for m in dict.fromkeys(c.method for curve in curves for c in curve.courses) if m != stability.TRIVIAL]
    looks = vega.series_of(methods)
    names = {method: look.title for method, look in zip(methods, looks, strict=True)}
    caption = "Accuracy against severity, the clean capture at 0. A failed cell counts with the worst score."
    if any(curve.trivial is not None for curve in curves):
        caption += " Crossed: the breakdown point."
    blocks: list[Block] = []
    for index, split in enumerate(RANKED_SPLITS):
        shown = [curve for curve in curves if curve.split == split]
        samples = pd.DataFrame([row for curve in shown for row in _steps(curve, names)])
        floor = style_of(stability.TRIVIAL).title
        rules = [(curve.title, curve.trivial, floor) for curve in shown if curve.trivial is not None]
        panels = charts.lines(
            samples, looks, y="PSNR [dB]", size=(240, 150), rules=pd.DataFrame(rules, columns=["panel", "y", "text"])
        )
        title = SPLIT_NAMES[split].words.capitalize()
        name = f"stability_{scene}_{index}"
        figure = Figure(
            name=name, title=title, caption=f"{title}. {caption} {WHISKERS}", panels=panels, series=looks, columns=3
        )
        blocks.append(_chart(figure))
    blocks += [_breakdowns(curves, methods), _reliability(scores, scene)]
    return Section(title=f"Where methods fail on {scene}", blocks=tuple(blocks))


def _steps(curve: stability.Curve, names: dict[str, str]) -> list[dict[str, object]]:
    return [
        {
            "panel": curve.title,
            "x_title": "severity",
            "series": names[course.method],
            "x": f"{step.severity:g}",
            "y": step.quality.mean,
            "low": step.quality.low,
            "high": step.quality.high,
            "crossed": step.severity == course.breakdown,
        }
        for course in curve.courses
        if course.method in names
        for step in course.steps
    ]


def _breakdowns(curves: Sequence[stability.Curve], methods: Sequence[str]) -> Table:
    def entry(course: stability.Course | None) -> Entry:
        if course is None:
            return Entry(text="n/a")
        point = "n/a" if course.midpoint is None else "none" if course.breakdown is None else f"{course.breakdown:g}"
        return Entry(text=f"{point} ({course.loss:.1f} dB lost at worst)", sort=course.breakdown)

    rows = []
    for curve in curves:
        own = {course.method: course for course in curve.courses}
        name = f"{curve.title}, {SPLIT_NAMES[curve.split].words}"
        rows.append(Row(name=name, entries=tuple(entry(own.get(method)) for method in methods)))
    columns = tuple(Head(title=style_of(method).title) for method in methods)
    return Table(
        title="Breakdown point (and the worst loss along the axis)", corner="axis", columns=columns, rows=tuple(rows)
    )


def _reliability(scores: Scores, scene: str) -> Table:
    rows = tuple(
        Row(
            name=row.title,
            entries=(
                Entry(text=f"{row.failures} of {row.cells}", sort=float(row.failures)),
                Entry(text=f"{100 * row.rate[0]:.0f} to {100 * row.rate[1]:.0f} %", sort=row.rate[0]),
                Entry(text=str(row.diverged), sort=float(row.diverged)),
                Entry(text="n/a" if row.spread_db is None else f"{row.spread_db:.2f} dB", sort=row.spread_db),
            ),
        )
        for row in stability.reliability(scores, scene)
    )
    titles = (
        "failed cells",
        "95 % interval of the rate",
        "diverged",
        "spread over the seeds of a capture, clean, held-out views",
    )
    return Table(title="Reliability", columns=tuple(Head(title=title) for title in titles), rows=rows)


def _paper_table(scores: Scores, table: paper.PaperTable) -> Table:
    quantities = [
        q
        for split in RANKED_SPLITS
        for q in (foreground(split), foreground(split, "flip"), Quantity(split, "full", "lpips"))
    ]
    quantities.append(FRAME_MS)
    groups = ("paper, seen motion", "paper, unseen motion", "novel view", "novel pose", "cost")
    heads = [Head(title=title, group=group) for group in groups[:2] for title in ("PSNR", "LPIPS")]
    heads += [Head(title=title, group=group) for group in groups[2:4] for title in ("PSNR", "FLIP", "LPIPS")]
    heads.append(Head(title="ms per frame", group="cost"))
    rows = []
    for row in table.rows:
        theirs = [Entry(text=f"{value:.2f}", sort=value) for pair in (row.view, row.pose) for value in pair]
        ours = [entry_of(scores.get(table.scene, row.method or "", q), METRICS[q.metric]) for q in quantities]
        rows.append(Row(name=row.title, entries=(*theirs, *ours)))
    return Table(title=table.title, columns=tuple(heads), rows=tuple(rows))
