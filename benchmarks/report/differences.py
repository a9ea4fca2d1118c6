"""Which differences between ASH and the other methods are established, and which a run of its size could have found."""

import math
from collections.abc import Sequence

from benchmarks.analysis import contrasts
from benchmarks.analysis.contrasts import Contrast
from benchmarks.analysis.scores import RANKED_SPLITS, Scores
from benchmarks.analysis.style import SPLIT_NAMES
from benchmarks.report import figures
from benchmarks.report.content import Block, Chart, Entry, Head, Row, Section, Table, Text

NOTE = (
    "Foreground PSNR. Bold: chance is excluded at 5 % among all rows of a table. Detectable: the smallest true "
    "difference that this design would find four times in five."
)
DETECTABLE_NOTE = (
    "The smallest true difference that so many captures (subjects in this outfit) would show four times in five, from "
    "how the differences spread over the captures here: of the middle row, and of the row that spreads most. A single "
    "capture shows none: whatever is found on it may be its own."
)


def sections(scores: Scores, scene: str, found: Sequence[Contrast], beside: Sequence[Contrast] = ()) -> list[Section]:
    """The differences with their intervals, and what more captures would show; of one seed a chart of many rows alone.

    `beside`: those on splits that are not ranked, in a table of their own.
    """
    told = [(c.split, c.method, c.test) for c in found] or contrasts.differences(scores, scene)
    figure = figures.effects_figure(told, scene, over=scores.unit(scene))
    charted: tuple[Block, ...] = (Chart(figure=figure),) if figure else ()
    if not found:
        return [Section(title=f"Differences to ASH on {scene}", blocks=charted)] if charted else []
    apart = (_table(scores, scene, beside, title="On near and far motion"),) if beside else ()
    blocks = (*charted, _table(scores, scene, found), *apart, Text(text=NOTE, note=True), *_detectable(found))
    return [Section(title=f"Which differences are established on {scene}", blocks=blocks)]


def note(scores: Scores, scene: str, found: Sequence[Contrast]) -> str:
    """What a table of the scene can show at all, in one sentence."""
    smallest = []
    for split in RANKED_SPLITS:
        here = sorted(contrast.test.detectable for contrast in found if contrast.split == split)
        if here:
            smallest.append(f"{here[len(here) // 2]:.2f} dB on {SPLIT_NAMES[split].words}")
    if not smallest:
        return "One value per row: no difference between rows is established."
    words = f"Smallest detectable difference to ASH, middle row: {' and '.join(smallest)}"
    if scores.captures(scene) > 1:
        return f"{words} ({scores.captures(scene)} captures, compared in pairs)."
    return f"{words} (seeds of one capture, which say nothing about other people)."


def _table(scores: Scores, scene: str, found: Sequence[Contrast], *, title: str = "") -> Table:
    pairs = scores.captures(scene) > 1
    heads = (
        Head(title="split"),
        Head(title="difference", unit="dB"),
        Head(title="95 % interval", unit="captures, paired t", term="paired t")
        if pairs
        else Head(title="95 % interval", unit="seeds, Welch", term="Welch"),
        Head(title="95 % interval of images", unit="bootstrap", term="hierarchical bootstrap"),
        Head(title="p", unit="Holm", term="Holm"),
        Head(title="effect", unit="standard deviations"),
        Head(title="detectable", unit="dB", term="detectable"),
    )
    return Table(title=title, corner="ASH minus", columns=heads, rows=tuple(map(_row, found)))


def _row(c: Contrast) -> Row:
    numbers = (
        Entry(text=SPLIT_NAMES[c.split].title),
        Entry(text=f"{c.test.mean:+.2f}", sort=c.test.mean, mark="strong" if c.significant else ""),
        Entry(text=f"[{c.test.low:+.2f}, {c.test.high:+.2f}]", sort=c.test.low),
        Entry(text="n/a" if math.isnan(c.bootstrap[0]) else f"[{c.bootstrap[0]:+.2f}, {c.bootstrap[1]:+.2f}]"),
        Entry(text=f"{c.p_adjusted:.2g}", sort=c.p_adjusted),
        Entry(text=f"{c.test.effect:.1f}", sort=c.test.effect),
        Entry(text=f"{c.test.detectable:.2f}", sort=c.test.detectable),
    )
    return Row(name=c.title, entries=numbers)


def _detectable(found: Sequence[Contrast]) -> tuple[Block, ...]:
    by_split = {split: contrasts.detectable_effects(found, split) for split in RANKED_SPLITS}
    rows = tuple(
        Row(name=SPLIT_NAMES[split].title, entries=tuple(map(_detectable_entry, detectable_effects)))
        for split, detectable_effects in by_split.items()
        if detectable_effects
    )
    if not rows:
        return ()
    heads = tuple(
        Head(title=f"{count} {'capture' if count == 1 else 'captures'}", unit="dB") for count in contrasts.COUNTS
    )
    table = Table(title="What more captures would show", corner="split", columns=heads, rows=rows)
    return table, Text(text=DETECTABLE_NOTE, note=True)


def _detectable_entry(effect: contrasts.DetectableEffect) -> Entry:
    if math.isinf(effect.middle):
        return Entry(text="none")
    return Entry(text=f"{effect.middle:.2f} to {effect.worst:.2f}", sort=effect.middle)
