"""Charts of differences with intervals."""

import re
from xml.etree import ElementTree

from benchmarks.forest import ABOVE, BELOW_ZERO, UNSURE, Effect, ForestPanel, forest

EFFECTS = (
    Effect(label="worse", mean=1.0, low=0.5, high=1.5),
    Effect(label="equal", mean=0.1, low=-0.4, high=0.6),
    Effect(label="better", mean=-1.0, low=-1.5, high=-0.5),
)


def circles(chart: str) -> dict[str, tuple[float, str]]:
    """Position on x and colour of every dot, from the top, by what its title says first."""
    found = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"[^>]*fill="(#\w+)"><title>(\w+):', chart)
    rows = sorted(found, key=lambda dot: float(dot[1]))
    return {label: (float(x), colour) for x, _, colour, label in rows}


def test_rows_are_sorted_dots_lie_where_the_means_are_and_colours_say_who_is_ahead() -> None:
    chart = forest([ForestPanel(title="views", effects=EFFECTS[::-1])], x_title="dB")
    ElementTree.fromstring(chart)
    dots = circles(chart)
    assert [colour for _, colour in dots.values()] == [ABOVE, UNSURE, BELOW_ZERO]
    assert list(dots) == ["worse", "equal", "better"]
    pixels_per_db = (dots["worse"][0] - dots["better"][0]) / 2.0
    assert abs(dots["equal"][0] - dots["better"][0] - 1.1 * pixels_per_db) < 0.2
    assert "+0.10 [-0.40, +0.60]" in chart


def test_one_wide_interval_does_not_press_the_rest_together_and_is_pointed_at() -> None:
    usual = [Effect(label=f"row{i}", mean=0.1 * i, low=0.1 * i - 0.2, high=0.1 * i + 0.2) for i in range(9)]
    wide = Effect(label="wide", mean=30.0, low=-5.0, high=65.0)
    plain, both = (
        forest([ForestPanel(title="", effects=tuple(effects))], x_title="dB") for effects in (usual, [*usual, wide])
    )
    spread = [circles(chart)["row8"][0] - circles(chart)["row0"][0] for chart in (plain, both)]
    assert spread[1] > 0.3 * spread[0]
    assert "wide" in both and "wide" not in circles(both), "its mean lies beyond the scale"
    assert "l-5 4l5 4" in both and "l5 4l-5 4" in both and "l-5 4l5 4" not in plain


def test_a_label_that_one_panel_lacks_keeps_its_row_in_the_other() -> None:
    panels = [ForestPanel(title="a", effects=EFFECTS), ForestPanel(title="b", effects=EFFECTS[:1])]
    chart = forest(panels, x_title="dB")
    assert chart.count("<circle") == 4 and chart.count(">equal<") == 1
    assert forest([], x_title="dB") == "" == forest([ForestPanel(title="a", effects=())], x_title="dB")
