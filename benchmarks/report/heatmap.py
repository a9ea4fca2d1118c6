"""A matrix as a picture: a cell per row and column, coloured by its value, with its interval."""

from collections.abc import Sequence
from typing import Any

import altair as alt
import pandas as pd

from benchmarks.report.charts import inline, layered, tooltips

# Cells keep their light colours on dark pages, and so does what stands in them.
WRITING, FRAME = "#17202c", "#c2415c"  # The frame is seen on light cells and on dark paper.
RANGE = ("#e8995a", "#f1f3f6", "#6f9ceb")
CELL = (70, 40)  # pixels
LEAST = 0.7  # Of its size: what stands in the cells is hardly read below it.


def heatmap(
    cells: pd.DataFrame, *, rows: Sequence[str], columns: Sequence[str], limit: float, title: str
) -> tuple[alt.LayerChart, ...]:
    """`cells`: row, column, value, text, interval, verdict, framed. Colours end at the limit on both sides."""
    at = {
        "x": alt.X(
            "column:N",
            title=None,
            scale=alt.Scale(domain=list(columns), paddingInner=0.06, paddingOuter=0.03),
            axis=alt.Axis(orient="top", labelAngle=-35, ticks=False, domain=False, labelPadding=6),
        ),
        "y": alt.Y(
            "row:N",
            title=None,
            scale=alt.Scale(domain=list(rows), paddingInner=0.1, paddingOuter=0.05),
            axis=alt.Axis(ticks=False, domain=False),
        ),
    }
    colour = alt.Fill(
        "value:Q",
        scale=alt.Scale(domain=[-limit, 0, limit], range=list(RANGE), clamp=True, interpolate="rgb"),
        legend=None,
    )
    tips = tooltips(
        [("row", "", ""), ("column", "", ""), ("text", "dB lost", ""), ("interval", "95 %", ""), ("verdict", "", "")]
    )
    seen = alt.Chart(inline(cells))
    framed = seen.transform_filter("datum.framed")
    sure = "indexof(['needed', 'harmful'], datum.verdict)"
    above: dict[str, Any] = {"dy": -6, "fontSize": 13, "color": WRITING}
    layers = [
        seen.mark_rect(cornerRadius=2).encode(**at, fill=colour, tooltip=tips),
        framed.mark_rect(filled=False, stroke=FRAME, strokeWidth=2.5, cornerRadius=2).encode(**at),
        seen.transform_filter(f"{sure} >= 0").mark_text(fontWeight="bold", **above).encode(**at, text="text:N"),
        seen.transform_filter(f"{sure} < 0").mark_text(**above).encode(**at, text="text:N"),
        seen.mark_text(dy=9, fontSize=10, color=WRITING).encode(**at, text="interval:N"),
    ]
    return (layered(layers, title, (CELL[0] * len(columns), CELL[1] * len(rows))),)


def least_width(columns: int) -> int:
    """Pixels that a matrix of so many columns and the names of its rows need at least."""
    return round(LEAST * CELL[0] * (columns + 2))
