"""The report's sections on stability and on the template's error, as charts and rows."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks import margin, stability
from benchmarks.cells import CellResult
from benchmarks.names import SPLIT_WORDS, look_of
from benchmarks.scores import Scores
from benchmarks.small_multiples import Multiple, Rule, Sample, Series, small_multiples
from benchmarks.stability import Course, Curve, Reliability

MARGIN_COLOUR, HONEST_COLOUR = "#2f6fde", "#dd6b20"


@dataclass(frozen=True, kw_only=True, slots=True)
class Breakdown:
    """A row of the table of breakdown points: one axis and split, an entry per method."""

    axis: str
    split: str
    entries: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class StabilityReport:
    """One scene's section on stability."""

    scene: str
    charts: tuple[tuple[str, str], ...]  # split's title, SVG
    methods: tuple[str, ...]
    breakdowns: tuple[Breakdown, ...]
    reliability: tuple[Reliability, ...]
    trivial: bool  # whether the trivial baseline was run, without which there are no breakdown points


@dataclass(frozen=True, kw_only=True, slots=True)
class MarginReport:
    """The section on quality and margin against the template's error: two SVG charts, and what they say."""

    levels: str
    chart: str
    sentences: tuple[str, ...]


def stability_reports(results: Sequence[CellResult]) -> tuple[StabilityReport, ...]:
    """A section per scene that was stressed."""
    curves = stability.curves(results)
    return tuple(
        _stability(scene, [c for c in curves if c.scene == scene], [r for r in results if r.config.scene == scene])
        for scene in dict.fromkeys(curve.scene for curve in curves)
    )


def margin_report(scores: Scores) -> MarginReport | None:
    """The charts and findings, or None where no templates of known error were run."""
    curves = margin.margin_curves(scores)
    if not curves:
        return None
    levels = small_multiples([_level_chart(curve) for curve in curves], y_title="foreground PSNR [dB]", columns=2)
    chart = small_multiples([_margin_chart(curve) for curve in curves], y_title="ASH minus DDC [dB]", columns=2)
    sentences = tuple(margin.sentence(curve) for curve in curves)
    return MarginReport(levels=levels, chart=chart, sentences=sentences)


def _stability(scene: str, curves: Sequence[Curve], results: Sequence[CellResult]) -> StabilityReport:
    charts = []
    for split, title in SPLIT_WORDS.items():
        shown = [_stress_chart(curve) for curve in curves if curve.split == split]
        charts.append((title, small_multiples(shown, y_title="foreground PSNR [dB]")))
    methods = [m for m in dict.fromkeys(c.method for curve in curves for c in curve.courses) if m != stability.TRIVIAL]
    rows = []
    for curve in curves:
        own = {course.method: course for course in curve.courses}
        entries = tuple(_entry(own.get(method)) for method in methods)
        rows.append(Breakdown(axis=curve.title, split=SPLIT_WORDS[curve.split], entries=entries))
    return StabilityReport(
        scene=scene,
        charts=tuple(charts),
        methods=tuple(look_of(method).title for method in methods),
        breakdowns=tuple(rows),
        reliability=stability.reliability(results),
        trivial=any(curve.trivial is not None for curve in curves),
    )


def _entry(course: Course | None) -> str:
    if course is None:
        return "n/a"
    point = "n/a" if course.midpoint is None else "none" if course.breakdown is None else f"{course.breakdown:g}"
    return f"{point} ({course.loss:.1f} dB lost at worst)"


def _stress_chart(curve: Curve) -> Multiple:
    """Severities at even distances: their scales differ by orders of magnitude."""
    severities = sorted({step.severity for course in curve.courses for step in course.steps})
    place = {severity: float(index) for index, severity in enumerate(severities)}
    series = []
    for course in curve.courses:
        if course.method == stability.TRIVIAL:
            continue
        samples = tuple(
            Sample(
                x=place[step.severity],
                y=step.quality.mean,
                low=step.quality.low,
                high=step.quality.high,
                crossed=step.severity == course.breakdown,
            )
            for step in course.steps
        )
        series.append(Series(label=course.title, colour=look_of(course.method).colour, samples=samples))
    return Multiple(
        title="",
        x_title=curve.title,
        ticks=tuple((place[severity], f"{severity:g}") for severity in severities),
        series=tuple(series),
        rules=() if curve.trivial is None else (Rule(y=curve.trivial, label=look_of(stability.TRIVIAL).title),),
    )


def _level_chart(curve: margin.MarginCurve) -> Multiple:
    series = []
    for level in curve.levels:
        samples = tuple(Sample(x=mm, y=psnr.mean, low=psnr.low, high=psnr.high) for mm, psnr in level.qualities)
        look = look_of(level.method)
        series.append(Series(label=margin.LEVEL_TITLES[level.method], colour=look.colour, samples=samples))
    return _against_error(curve, series)


def _margin_chart(curve: margin.MarginCurve) -> Multiple:
    samples = tuple(Sample(x=m.error_mm, y=m.mean, low=m.low, high=m.high) for m in curve.known)
    series = [Series(label="template of known error", colour=MARGIN_COLOUR, samples=samples)]
    if curve.honest is not None:
        honest = Sample(x=curve.honest.error_mm, y=curve.honest.mean, low=curve.honest.low, high=curve.honest.high)
        series.append(Series(label="the method's own template", colour=HONEST_COLOUR, samples=(honest,), joined=False))
    rules = [Rule(y=0.0, label="")]
    if curve.paper_db is not None:
        rules.append(Rule(y=curve.paper_db, label=f"the paper's {curve.paper_db:+.1f} dB"))
    return _against_error(curve, series, rules)


def _against_error(curve: margin.MarginCurve, series: Sequence[Series], rules: Sequence[Rule] = ()) -> Multiple:
    return Multiple(
        title=f"{curve.scene}, {SPLIT_WORDS[curve.split]}",
        x_title="template error [mm rms]",
        ticks=tuple((m.error_mm, f"{m.error_mm:g}") for m in curve.known),
        series=tuple(series),
        rules=tuple(rules),
    )
