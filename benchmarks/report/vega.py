"""A figure in Vega-Lite: common configuration, the SVG file, and the interactive version of the page.

A `Figure` is made of panels. `svg` sets them side by side in a file for Markdown; the page shows the same panels below
each other where it is narrow, with values on hover, zoom, and a legend whose entries hide and show a series. Colours of
paper, ink and grid are replaced on dark pages by those of `DARK`, in the file and in the page alike.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, ClassVar
from xml.sax.saxutils import escape

import altair as alt
import vl_convert

from ash.files import write_atomic
from benchmarks.analysis.style import style_of
from benchmarks.cell.registry import is_oracle
from synth.person.anny_body import cache_folder

VERSION = "6.4"  # of Vega-Lite, among those that vl-convert brings
PAPER, INK, DIM, GRID, LINE = "#fffffe", "#1f2733", "#5d6878", "#dfe4eb", "#8a94a3"
DARK = {PAPER: "#12171f", INK: "#e6eaf0", DIM: "#9aa6b6", GRID: "#2c3543"}
BLUE, ORANGE = "#2f6fde", "#dd6b20"
SHAPES = ("circle", "square", "triangle-up", "diamond", "cross", "triangle-down")
CONFIG: dict[str, Any] = {
    "font": "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif",
    "background": PAPER,
    "view": {"stroke": None},
    "axis": {
        "labelColor": DIM,
        "titleColor": DIM,
        "gridColor": GRID,
        "domainColor": LINE,
        "tickColor": LINE,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "titleFontWeight": "normal",
        "labelLimit": 260,
    },
    "title": {"color": INK, "subtitleColor": DIM, "anchor": "start", "fontSize": 14, "subtitleFontSize": 12},
    "legend": {
        "labelColor": INK,
        "labelFontSize": 12,
        "labelLimit": 300,
        "symbolLimit": 0,
        "orient": "bottom",
        "columns": 5,
    },
    "text": {"color": INK, "fontSize": 12},
    "rule": {"color": LINE},
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Series:
    """How one series is drawn. A hollow one is a bound and no competitor."""

    title: str
    colour: str
    hollow: bool = False
    shape: str = "circle"


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """A chart: its file is `chart_NAME.svg`. `least`: the width in pixels below which the page scrolls it."""

    kind: ClassVar[str] = "chart"
    name: str
    title: str
    caption: str
    panels: tuple[alt.LayerChart, ...]
    series: tuple[Series, ...] = ()
    columns: int = 2
    least: int = 0

    @property
    def file(self) -> str:
        """The file's name."""
        return f"chart_{self.name}.svg"

    def svg(self) -> str:
        """The drawing as a file: the same bytes each time, without any network."""
        chart = alt.concat(*self.panels, columns=self.columns, spacing=24).resolve_scale(
            fill="shared", stroke="shared", shape="shared"
        )
        spec: dict[str, Any] = chart.to_dict(validate=False) | {"config": CONFIG}
        drawn = vl_convert.vegalite_to_svg(spec, vl_version=VERSION, allowed_base_urls=[])
        return drawn.replace(">", f"><title>{escape(self.title)}</title><style>{dark_rules()}</style>", 1)

    def specs(self) -> list[dict[str, Any]]:
        """The panels as the page shows them."""
        return [_interactive(panel) for panel in self.panels]


def series_of(methods: Iterable[str]) -> dict[str, Series]:
    """The series of each method; those of one colour differ in shape."""
    series: dict[str, Series] = {}
    for method in methods:
        style, hollow = style_of(method), is_oracle(method)
        alike = sum((other.colour, other.hollow) == (style.colour, hollow) for other in series.values())
        title = method if any(other.title == style.title for other in series.values()) else style.title
        shape = SHAPES[alike % len(SHAPES)]
        series[method] = Series(title=title, colour=style.colour, hollow=hollow, shape=shape)
    return series


def dark_rules(scope: str = "") -> str:
    """CSS that repaints a chart on dark pages."""
    rules = [
        f'{scope}[{mark}="{light}"]{{{mark}:{dark}}}' for light, dark in DARK.items() for mark in ("fill", "stroke")
    ]
    return f"@media (prefers-color-scheme:dark){{{''.join(rules)}}}"


@cache
def library() -> str:
    """The JavaScript that draws specifications in a page: Vega, Vega-Lite, and their interpreter of expressions."""
    kept = cache_folder() / f"vega-{VERSION}-{version('vl-convert-python')}.js"  # Bundling takes seconds.
    with suppress(OSError, UnicodeDecodeError):
        return kept.read_text(encoding="utf-8")
    bundle: str = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=VERSION)
    with suppress(OSError):
        write_atomic(kept, bundle.encode())
    return bundle


def _interactive(panel: alt.LayerChart) -> dict[str, Any]:
    """A panel for the page: as wide as its box, on the page's paper, with zoom, its legend left to the page."""
    spec: dict[str, Any] = _without_legends(panel.properties(width="container").to_dict(validate=False))
    zoom = {"type": "interval", "zoom": "wheel![event.ctrlKey || event.metaKey]"}
    at = next(i for i, layer in enumerate(spec["layer"]) if layer["mark"]["type"] in ("point", "bar", "rect"))
    if spec["layer"][at]["mark"]["type"] == "point" and _is_continuous(spec["layer"][at]["encoding"]):
        spec["layer"][at]["params"] = [{"name": "zoom", "select": zoom, "bind": "scales"}]
    return spec | {"config": {**CONFIG, "background": None}, "autosize": {"type": "fit-x", "contains": "padding"}}


def _without_legends(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: None if key == "legend" else _without_legends(value) for key, value in node.items()}
    return [_without_legends(value) for value in node] if isinstance(node, list) else node


def _is_continuous(encoding: dict[str, Any]) -> bool:
    return all(encoding[axis]["type"] == "quantitative" for axis in ("x", "y"))
