"""Quality against the error of the template that methods are given, and ASH minus DDC: where the two are equal.

Planted errors have the statistics of learned templates (`ash.config.TemplateConfig`), so that a learned template has a
place on the curve. A fixed mesh with the best texture shows what geometry of such an error allows by itself.
"""

from itertools import pairwise, product

import numpy as np
import pandas as pd

from benchmarks.analysis.results import Quantity, RunTables, compare, foreground, samples_of
from benchmarks.analysis.statistics import intervals
from benchmarks.analysis.style import SPLIT_NAMES, style_of
from benchmarks.cell.registry import ON_EXACT, WRONG_BY_MM

# ASH (CVPR 2024), Table 1: PSNR of ASH minus DDC, tight and loose clothes.
PAPER_DB = {"novel_view": {"tight": 4.6, "loose": 7.4}, "novel_pose": {"tight": 1.1, "loose": 0.7}}
LEARNED = {"images": ("ash", "ddc"), "scans": ("by_scans", "ddc_by_scans")}  # rows by what their templates learned from
PLACED = ("ash", "by_scans", "by_graph", "unlearned")  # ASH on other templates
PLANTED = "planted"


def margins(tables: RunTables) -> pd.DataFrame:
    """ASH minus DDC in dB: scene, split, template (`planted` or what it was learned from), error_mm, mean, low, high.

    Of scenes on which both ran on two planted errors or more.
    """
    rows = []
    for scene, split in product(tables.scenes, PAPER_DB):
        pairs = [(PLANTED, float(mm), row[0], row[1]) for mm, row in WRONG_BY_MM.items()]
        for template, (ash, ddc) in LEARNED.items():
            error = tables.get(scene, ash, Quantity(split, "", "template_mm"))
            pairs += [] if error is None else [(template, float(error.value), ash, ddc)]
        records = [
            (scene, split, template, error, each.mean, each.low, each.high)
            for template, error, ash, ddc in pairs
            if (each := compare(tables.of(scene), ash, ddc, foreground(split))) is not None
        ]
        rows += records if sum(row[2] == PLANTED for row in records) > 1 else []
    return pd.DataFrame(rows, columns=["scene", "split", "template", "error_mm", "mean", "low", "high"])


def levels(tables: RunTables) -> pd.DataFrame:
    """Foreground PSNR in dB on templates of known error: scene, split, method, error_mm, psnr, low, high.

    Without what a capture does to all rows (`benchmarks.analysis.statistics.intervals`).
    """
    rows = []
    for scene, split in product(tables.scenes, PAPER_DB):
        samples = samples_of(tables.of(scene), foreground(split))
        found = intervals({name: each for name, each in samples.items() if tables.whole(scene, name)})
        for column, method in enumerate(ON_EXACT):
            for mm, names in WRONG_BY_MM.items():
                if names[column] in found:
                    rows.append((scene, split, method, float(mm), *found[names[column]]))
    return pd.DataFrame(rows, columns=["scene", "split", "method", "error_mm", "psnr", "low", "high"])


def interpolated(x: pd.Series, y: pd.Series, at: float) -> float | None:
    """The value between measured points in rising order; None beyond them."""
    return float(np.interp(at, x, y)) if len(x) and x.iloc[0] <= at <= x.iloc[-1] else None


def error_at(planted: pd.DataFrame, margin_db: float) -> float | None:
    """The least error, mm, at which the margin is reached, linear between measured errors; None: it never is."""
    points = list(zip(planted["error_mm"], planted["mean"], strict=True))
    for (x, y), (x_next, y_next) in pairwise(points):
        if (y - margin_db) * (y_next - margin_db) <= 0 and y != y_next:
            return float(x + (margin_db - y) / (y_next - y) * (x_next - x))
    return None


def sentences(tables: RunTables, table: pd.DataFrame) -> list[str]:
    """The findings on `margins`, and where ASH on other templates lies."""
    lines, placed = [], []
    curves = levels(tables)
    for (scene, split), here in table.groupby(["scene", "split"], sort=False):
        where = f"On {scene}, {SPLIT_NAMES[split].words}"
        planted = here[here["template"] == PLANTED]
        first, last = planted.iloc[0], planted.iloc[-1]
        text = f"{where}: ASH minus DDC is {first['mean']:+.1f} dB at {first.error_mm:g} mm of template error and"
        text += f" {last['mean']:+.1f} dB at {last.error_mm:g} mm"
        equal = error_at(planted, 0.0)
        text += "; one leads throughout" if equal is None else f"; the two are equal at {equal:.1f} mm"
        if (paper_db := PAPER_DB[split].get(scene)) is not None:
            at = error_at(planted, paper_db)
            text += (
                f"; the paper's {paper_db:+.1f} dB {'is not reached' if at is None else f'is reached at {at:.1f} mm'}"
            )
        for row in here[here["template"] != PLANTED].itertuples():
            text += f"; on the template learned from {row.template} ({row.error_mm:.1f} mm) it is {row.mean:+.1f} dB"
            same = interpolated(planted["error_mm"], planted["mean"], row.error_mm)
            text += "" if same is None else f", on a planted error of that size {same:+.1f} dB"
        lines.append(text + ".")
        ash = curves.query("scene == @scene and split == @split and method == @ON_EXACT[0]")
        parts = []
        for method in PLACED:
            error = tables.get(scene, method, Quantity(split, "", "template_mm"))
            psnr = tables.get(scene, method, foreground(split))
            if error is not None and psnr is not None and tables.whole(scene, method):
                same = interpolated(ash["error_mm"], ash["psnr"], error.value)
                part = f"{style_of(method).title} {psnr.value:.1f} dB at {error.value:.1f} mm"
                parts.append(part if same is None else f"{part} ({same:.1f})")
        if parts:
            placed.append(f"{where}, by template (in brackets: a planted error of that size): {'; '.join(parts)}.")
    return lines + placed
