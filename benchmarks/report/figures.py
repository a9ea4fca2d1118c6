"""The charts of a scene: its numbers as the tables that `charts.py` draws, with their captions."""

import math
from collections import Counter
from collections.abc import Sequence

import pandas as pd

from benchmarks.analysis import contrasts, pareto
from benchmarks.analysis.scores import FRAME_MS, RANKED_SPLITS, Quantity, Score, Scores, foreground
from benchmarks.analysis.statistics import Difference, intervals
from benchmarks.analysis.style import EXACT, SPLIT_NAMES, style_of
from benchmarks.cell.methods import WRONG_BY_MM
from benchmarks.report import charts, vega
from benchmarks.report.vega import Figure, Series

STAGES = {
    "stg1_ms": Series(title="Stg.1 template", colour="#2f6fde"),
    "stg2_ms": Series(title="Stg.2 textures", colour="#2a9d8f"),
    "stg3_ms": Series(title="Stg.3 decoders", colour="#dd6b20"),
    "stg4_ms": Series(title="Stg.4 skin and draw", colour="#9b59b6"),
    "": Series(title="other", colour="#8a94a3"),
}
STAGE_METRICS = tuple(stage for stage in STAGES if stage)
MANY_CONTRASTS = 5  # Rows from which contrasts are drawn as well as listed.
UNKNOWN = "which has one seed on one capture: another seed moves a score by a few tenths of a dB."
PLANTED = {method for mm, row in WRONG_BY_MM.items() if mm > 0 for method in row}  # They have a chart of their own.
SPAN_DB = 9.0  # that a chart shows below its best point: what lies lower would press the rest together


def speed_figure(scores: Scores, scene: str) -> Figure | None:
    """Foreground PSNR against milliseconds per frame, for held-out views and held-out motion."""
    methods = [m for m in scores.methods(scene) if m not in PLANTED and scores.whole(scene, m)]
    looks = dict(zip(methods, vega.series_of(methods), strict=True))
    points, front, links = [], [], []
    notes: dict[str, str] = {}
    for split in RANKED_SPLITS:
        panel = SPLIT_NAMES[split].words.capitalize()
        competing = contrasts.candidates(scores, scene, split)
        sufficient = pareto.smallest_sufficient(competing)
        here = {
            m: (frame, score) for m in methods for frame, score in [_pair(scores, scene, m, split)] if frame and score
        }
        spans = intervals({m: scores.samples(scene, m, foreground(split)) for m in here}) if here else {}
        for method, (frame, score) in here.items():
            ends = {"low": spans[method].low, "high": spans[method].high}
            ringed = sufficient is not None and sufficient.name == method
            where = {
                "panel": panel,
                "series": looks[method].title,
                "ms": frame.mean,
                "psnr": score.mean,
                "ringed": ringed,
            }
            points.append({**where, **ends})
        front += [{"panel": panel, "ms": here[m][0].mean, "psnr": here[m][1].mean} for m in pareto.front(competing)]
        pairs = [pair for pair in EXACT.items() if set(pair) <= set(here)]
        links += [
            {"panel": panel, "link": pair[0], "ms": here[m][0].mean, "psnr": here[m][1].mean}
            for pair in pairs
            for m in pair
        ]
        ceilings = [c.mean for m in here if (c := scores.get(scene, m, foreground(split, "noise_ceiling")))]
        notes |= {panel: f"noise ceiling {ceilings[0]:.1f} dB"} if ceilings else {}
    if not points:
        return None
    columns = {"front": ["panel", "ms", "psnr"], "links": ["panel", "link", "ms", "psnr"]}
    panels, named = charts.speed(
        _lifted(pd.DataFrame(points)),
        pd.DataFrame(front, columns=columns["front"]),
        pd.DataFrame(links, columns=columns["links"]),
        tuple(looks.values()),
        notes=notes,
    )
    caption = _speed_caption(exact=bool(links), over=scores.unit(scene) if scores.repeated(scene) else "")
    title = "Accuracy against speed"
    return Figure(name=scene, title=title, caption=caption, panels=panels, series=tuple(looks.values()), named=named)


def _speed_caption(*, exact: bool, over: str) -> str:
    """What the chart shows, and no mark that it has not. `over`: what its whiskers are over; empty without them."""
    caption = "Up and to the left is better."
    if exact:
        caption += (
            " Hollow: given the exact surface, a bound and no competitor; the dashed line joins it with the honest "
            "method, so its length is what the template's error costs."
        )
    caption += " Grey staircase: the front of those that no other beats in both."
    if over:
        apart = ", what these add to all methods taken out" if over == "captures" else ""
        caption += f" Whiskers: 95 % interval over {over}{apart}; one that reaches the edge goes on beyond it."
        caption += " Ringed: the smallest sufficient method."
    return caption


def _pair(scores: Scores, scene: str, method: str, split: str) -> tuple[Score | None, Score | None]:
    return scores.get(scene, method, FRAME_MS), scores.get(scene, method, foreground(split))


def _lifted(points: pd.DataFrame) -> pd.DataFrame:
    """Points that lie far below all others, raised to the floor of the chart with their value in `note`.

    `level` counts those of a panel from 1, so that no note is written over another.
    """
    floor = points["psnr"].max() - SPAN_DB
    far = points["psnr"] < floor
    note = points["series"] + points["psnr"].map(": {:.1f} ↓".format)
    level = far.groupby(points["panel"]).cumsum().where(far)
    lifted = points.assign(note=note.where(far), level=level, psnr=points["psnr"].clip(lower=floor))
    return lifted.assign(**{end: points[end].where(~far) for end in ("low", "high")})


AHEAD = (
    Series(title="ASH is ahead", colour=vega.BLUE),
    Series(title="the row is ahead", colour=vega.ORANGE),
    Series(title="the interval holds zero", colour=vega.LINE),
)
UNTOLD = Series(title="one seed: no interval", colour=vega.LINE)


def effects_figure(found: Sequence[tuple[str, str, Difference]], scene: str, *, over: str) -> Figure | None:
    """What ASH is ahead by (split, method, difference), where rows are so many that a table is hard to read.

    `over`: what intervals are taken over; where there are none, the differences alone are shown.
    """
    if max(Counter(split for split, _, _ in found).values(), default=0) < MANY_CONTRASTS:
        return None
    told = not any(math.isnan(test.p) for _, _, test in found)
    rows = [
        {
            "panel": SPLIT_NAMES[split].title,
            "row": style_of(method).title,
            "mean": test.mean,
            "low": test.low if told else test.mean,
            "high": test.high if told else test.mean,
            "series": _ahead(test).title,
        }
        for split, method, test in found
    ]
    series = AHEAD if told else (UNTOLD,)
    known = f"with the 95 % interval over {over}. Arrows: it goes on beyond the scale." if told else UNKNOWN
    return Figure(
        name=f"effects_{scene}",
        title="Differences with intervals" if told else "Differences of one seed",
        caption=f"Foreground PSNR of ASH minus that of the row, {known}",
        panels=charts.forest(pd.DataFrame(rows), series, x="ASH minus the row [dB]"),
        series=series,
    )


def _ahead(test: Difference) -> Series:
    if math.isnan(test.p):
        return UNTOLD
    return AHEAD[0 if test.low > 0 else 1 if test.high < 0 else 2]


def training_figure(scores: Scores, curves: pd.DataFrame, scene: str) -> Figure | None:
    """Foreground PSNR of reserved training views over seconds of training, first seed of the first capture.

    `curves`: see `curves_of`.
    """
    curves = curves[curves["capture"] == curves.groupby("method")["capture"].transform("first")]
    curves = curves[curves["seed"] == curves.groupby("method")["seed"].transform("min")]
    methods = [m for m in scores.methods(scene) if (curves["method"] == m).sum() > 1]
    if not methods:
        return None
    looks = vega.series_of(methods)
    names = {method: look.title for method, look in zip(methods, looks, strict=True)}
    points = curves[curves["method"].isin(methods)]
    points = pd.DataFrame({"series": points["method"].map(names), "x": points["seconds"], "y": points["psnr"]})
    panels, named = charts.curves(points, looks, x="seconds of training", y="PSNR of views that no step sees [dB]")
    return Figure(
        name=f"training_{scene}",
        title="Training",
        caption="Foreground PSNR of training views that are reserved, so that no step sees them, over seconds of "
        "training: what stopping earlier would have given. First seed; warm-up included.",
        panels=panels,
        series=looks,
        columns=1,
        named=named,
    )


def stage_figure(scores: Scores, scene: str) -> Figure | None:
    """Milliseconds per frame by stage; what no stage claims is shown as other."""
    rows = []
    for method in scores.methods(scene):
        whole = scores.get(scene, method, FRAME_MS)
        found = {stage: scores.get(scene, method, Quantity("speed", "", stage)) for stage in STAGE_METRICS}
        if whole is None or scores.failed(scene, method) or not any(found.values()):
            continue
        parts = {stage: score.mean if score else 0.0 for stage, score in found.items()}
        parts[""] = max(0.0, whole.mean - sum(parts.values()))
        name = style_of(method).title
        rows += [{"row": name, "series": STAGES[stage].title, "value": value} for stage, value in parts.items()]
    if not rows:
        return None
    series = tuple(STAGES.values())
    return Figure(
        name=f"stages_{scene}",
        title="Time per stage",
        caption="One frame on one core, median after warm-up, by the paper's stages.",
        panels=charts.bars(pd.DataFrame(rows), series, x="ms per frame"),
        series=series,
        columns=1,
    )
