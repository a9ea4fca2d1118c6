"""Which differences between ASH and the other methods are established, and which a run of its size could have found."""

import math
from collections.abc import Iterator, Sequence

from benchmarks.analysis import contrasts
from benchmarks.analysis.contrasts import Contrast
from benchmarks.analysis.names import SPLIT_NAMES, look_of
from benchmarks.analysis.scores import RANKED_SPLITS, Scores, foreground
from benchmarks.analysis.statistics import spreads
from benchmarks.cell.methods import is_oracle
from benchmarks.report import figures
from benchmarks.report.content import Block, Chart, Entry, Head, Row, Section, Table, Text

NOTE = (
    "Foreground PSNR. Bold: chance is excluded at 5 % among all rows of a table. Detectable: the smallest true "
    "difference that this design would find four times in five."
)
SIGHT_NOTE = (
    "The smallest true difference that so many captures (subjects in this outfit) would show four times in five, from "
    "how the differences spread over the captures here: of the middle row, and of the row that spreads most. A single "
    "capture shows none: whatever is found on it may be its own."
)

SPREAD_NOTE = (
    "Standard deviations of foreground PSNR: between captures (people in their outfits), and between trainings of one "
    "capture from other seeds. n/a: no capture has two seeds, and the spread between captures holds theirs too."
)


def sections(scores: Scores, scene: str, found: Sequence[Contrast], beside: Sequence[Contrast] = ()) -> list[Section]:
    """The differences with their intervals, and what more captures would show; none without two seeds or captures.

    `beside`: those on splits that are not ranked, in a table of their own.
    """
    if not found:
        return []
    figure = figures.effects_figure(found, scene, over=scores.unit(scene))
    charted: tuple[Block, ...] = (Chart(figure=figure),) if figure else ()
    apart = (_table(scores, scene, beside, title="On near and far motion"),) if beside else ()
    table = _table(scores, scene, found)
    blocks = (*charted, table, *apart, Text(text=NOTE, note=True), *_sights(found), *_spreads(scores, scene))
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
        Entry(text=f"{c.test.mean:+.2f}", sort=c.test.mean, mark="strong" if c.established else ""),
        Entry(text=f"[{c.test.low:+.2f}, {c.test.high:+.2f}]", sort=c.test.low),
        Entry(text="n/a" if math.isnan(c.bootstrap[0]) else f"[{c.bootstrap[0]:+.2f}, {c.bootstrap[1]:+.2f}]"),
        Entry(text=f"{c.p_adjusted:.2g}", sort=c.p_adjusted),
        Entry(text=f"{c.test.effect:.1f}", sort=c.test.effect),
        Entry(text=f"{c.test.detectable:.2f}", sort=c.test.detectable),
    )
    return Row(name=c.title, entries=numbers)


def _sights(found: Sequence[Contrast]) -> tuple[Block, ...]:
    by_split = {split: contrasts.sights(found, split) for split in RANKED_SPLITS}
    rows = tuple(
        Row(name=SPLIT_NAMES[split].title, entries=tuple(map(_sight, sights)))
        for split, sights in by_split.items()
        if sights
    )
    if not rows:
        return ()
    heads = tuple(
        Head(title=f"{count} {'capture' if count == 1 else 'captures'}", unit="dB") for count in contrasts.COUNTS
    )
    table = Table(title="What more captures would show", corner="split", columns=heads, rows=rows)
    return table, Text(text=SIGHT_NOTE, note=True)


def _spreads(scores: Scores, scene: str) -> tuple[Block, ...]:
    """How far scores differ between people, and how far by chance of training; none on a single capture."""
    if scores.captures(scene) < 2:
        return ()
    methods = [method for method in scores.methods(scene) if scores.whole(scene, method) and not is_oracle(method)]
    rows = tuple(
        Row(name=look_of(method).title, entries=tuple(_spread_entries(scores, scene, method))) for method in methods
    )
    heads = tuple(
        Head(title=title, unit="dB", group=SPLIT_NAMES[split].title)
        for split in RANKED_SPLITS
        for title in ("between captures", "between seeds")
    )
    table = Table(title="How far scores spread", columns=heads, rows=rows)
    return table, Text(text=SPREAD_NOTE, note=True)


def _spread_entries(scores: Scores, scene: str, method: str) -> Iterator[Entry]:
    for split in RANKED_SPLITS:
        found = spreads(scores.samples(scene, method, foreground(split)))
        for value in (found.captures, found.seeds):
            yield Entry(text="n/a" if value is None else f"{value:.2f}", sort=value)


def _sight(sight: contrasts.Sight) -> Entry:
    if math.isinf(sight.middle):
        return Entry(text="none")
    return Entry(text=f"{sight.middle:.2f} to {sight.worst:.2f}", sort=sight.middle)
