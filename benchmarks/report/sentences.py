"""The sentences that head a report, computed from its numbers. Differences are taken before anything is rounded."""

import math
from collections.abc import Sequence
from itertools import chain

from benchmarks.analysis import paper, pareto
from benchmarks.analysis.results import FRAME_MS, RANKED_SPLITS, Quantity, RunTables, compare, foreground
from benchmarks.analysis.statistics import Comparison
from benchmarks.analysis.style import EXACT, PAIRS, SPLIT_NAMES, style_of
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import CellResult
from synth.person.cast import VALIDATION

TOO_CLOSE_DB = 0.1
CLOCKS_APART_S, CLOCKS_APART = 5.0, 0.5  # seconds, and share of the shorter: what a busy machine does not explain
FEW_METHODS = 6
FOR_VALIDATION = (
    f"Subjects from {VALIDATION} on are for validation: choose by these numbers, confirm on other subjects."
)
DRAWN_BY = {
    "display": "frames are timed as its display draws them, by OpenGL",
    "trainer": "frames are timed as its training renderer draws them, for this machine opens no OpenGL display",
}


def titles(methods: Sequence[str]) -> str:
    """Methods for readers."""
    return listed([style_of(method).title for method in methods])


def listed(texts: Sequence[str]) -> str:
    """A list, with semicolons where an item has a comma of its own."""
    return ("; " if any("," in text for text in texts) else ", ").join(texts)


def sentence(text: str) -> str:
    """Closed by one full stop, also where it ends with a name such as `w/o mot.`."""
    return text.removesuffix(".") + "."


def headline(tables: RunTables, scene: str) -> str:
    """Whose training had not reached its plateau; then the finding of a scene, with its certainty."""
    short = _with_outcome(tables, scene, "not plateau")
    first = f"Not at their plateau when training ended: {sentence(titles(short))} " if short else ""
    return first + _finding(tables, scene)


def _finding(tables: RunTables, scene: str) -> str:
    if pairs := [pair for pair in PAIRS if set(pair) <= set(tables.methods(scene))]:
        return " ".join(_pair(tables, scene, *pair) for pair in pairs)
    means = tables.values(scene, foreground(), tables.methods(scene, oracles=False))
    ranked = sorted(means, key=lambda name: -means[name])
    if not ranked:
        return f"On {scene}, no method was ranked on novel views."
    if len(ranked) == 1:
        return f"On {scene}, {sentence(f'{style_of(ranked[0]).title} has {means[ranked[0]]:.1f} dB on novel views')}"
    return _pair(tables, scene, *ranked[:2], splits=("novel_view",))


def _pair(tables: RunTables, scene: str, first: str, second: str, *, splits: Sequence[str] = RANKED_SPLITS) -> str:
    """Two methods by split: what is known of the difference, and both means."""
    names = style_of(first).title, style_of(second).title
    if lost := [method for method in (first, second) if tables.failed(scene, method)]:
        return f"On {scene}, {titles(lost)} failed: {names[0]} and {names[1]} cannot be compared."
    parts = []
    for split in splits:
        means = tables.values(scene, foreground(split), (first, second))
        compared = compare(tables.of(scene), first, second, foreground(split))
        if len(means) == 2 and compared is not None:
            numbers = f"{means[first]:.1f} and {means[second]:.1f} dB"
            parts.append(f"{_standing(compared, numbers)} on {SPLIT_NAMES[split].words}")
    if not parts:
        return f"On {scene}, {names[0]} and {names[1]} were not both scored."
    verdict = "" if tables.unit(scene) else "; one value of each, hence no verdict"
    return f"On {scene}, {names[0]} against {names[1]}: {' and '.join(parts)}{verdict}."


def _standing(compared: Comparison, numbers: str) -> str:
    """The verdict on a difference of PSNR, with its interval; of single values the difference alone."""
    difference = f"{compared.mean:+.1f} dB"
    if math.isnan(compared.p):
        return f"{difference} ({numbers})"
    words = "not shown to differ" if compared.verdict == "unclear" else compared.verdict
    return f"{words} ({difference} [{compared.low:+.1f}, {compared.high:+.1f}]; {numbers})"


def remarks(tables: RunTables, scene: str) -> list[str]:
    """What else must be known to read the numbers: the exact surface, cost, template, noise, seeds, failures."""
    lines = [FOR_VALIDATION] if tables.for_validation(scene) else []
    lines += [_exact(tables, scene), _cost(tables, scene), _template(tables, scene), _noise(tables, scene)]
    outcomes = tables.outcomes[tables.outcomes["scene"] == scene]
    learned = outcomes[outcomes["template"] != ""].drop_duplicates(["method", "template"])
    kinds = [f"{template} ({titles([*rows['method']])})" for template, rows in learned.groupby("template", sort=False)]
    lines.append(f"Templates: {'; '.join(kinds)}." if kinds else "")
    if dead := _with_outcome(tables, scene, "dead"):
        lines.append(sentence(f"The decoders have the same output in every frame: {titles(dead)}"))
    if failed := [method for method in tables.methods(scene) if tables.failed(scene, method)]:
        lines.append(sentence(f"Failed, and scored with the worst value: {titles(failed)}"))
    if not tables.unit(scene):
        lines.append("One value per row: no verdicts. --seeds 3 gives intervals over seeds, --subjects 8 over people.")
    elif tables.captures(scene) == 1:
        lines.append("One capture: intervals are over seeds and hold for this subject; --subjects 8 adds others.")
    return [remark for remark in lines if remark]


def _exact(tables: RunTables, scene: str) -> str:
    means = tables.values(scene, foreground(), EXACT.values())
    if len(means) < 2 or not tables.whole(scene, *EXACT.values()):
        return ""
    ash, ddc = means.values()
    numbers = f"(ASH {ash:.1f}, DDC {ddc:.1f} dB on novel views)"
    if abs(ash - ddc) < TOO_CLOSE_DB:
        return f"Given the exact surface, the two are level {numbers}."
    return f"Given the exact surface, {'ASH' if ash > ddc else 'the mesh'} leads by {abs(ash - ddc):.1f} dB {numbers}."


def _cost(tables: RunTables, scene: str) -> str:
    """Of many methods only the main two, the fastest and the slowest."""
    names = [method for method in tables.methods(scene, oracles=False) if tables.whole(scene, method)]
    frame_ms = tables.values(scene, FRAME_MS, names)
    if len(frame_ms) > FEW_METHODS:
        ends = [pick(frame_ms, key=lambda name: frame_ms[name]) for pick in (min, max)]
        frame_ms = {name: ms for name, ms in frame_ms.items() if name in (*chain(*PAIRS), *ends)}
    parts = [f"{style_of(method).title} {ms:.0f} ms" for method, ms in frame_ms.items()]
    return f"A frame takes {listed(parts)} on one core." if parts else ""


def _template(tables: RunTables, scene: str) -> str:
    names = tables.methods(scene, oracles=False)
    views, poses = (tables.values(scene, Quantity(split, "", "template_mm"), names) for split in RANKED_SPLITS)
    if not views:
        return ""
    stood_on: dict[str, list[str]] = {}  # methods by what is said of their template
    for method, error in views.items():
        later = f", {poses[method]:.1f} mm on novel poses" if method in poses else ""
        stood_on.setdefault(f"{error:.1f} mm on novel views{later}", []).append(method)
    parts = [f"{text} ({titles(methods)})" if len(stood_on) > 1 else text for text, methods in stood_on.items()]
    return f"Error of the template that methods were given, root mean square: {'; '.join(parts)}."


def _noise(tables: RunTables, scene: str) -> str:
    ceilings = tables.values(scene, foreground(metric="noise_ceiling"), tables.methods(scene))
    first = next(iter(ceilings.values()), None)
    return "" if first is None else f"Noise of the true images allows at most {first:.1f} dB on the foreground."


def _with_outcome(tables: RunTables, scene: str, condition: str) -> list[str]:
    """The methods of which a training ended so."""
    methods = set(tables.outcomes.query(f"scene == @scene and {condition}")["method"])
    return [method for method in tables.methods(scene) if method in methods]


def training_views(tables: RunTables, scene: str) -> list[str]:
    """How much of the capture training saw, of rows that the paper trained on a part of it: a sentence each."""
    lines = []
    for method in [name for name in tables.methods(scene) if name in paper.SEEN]:
        counts = []
        for what in ("cameras", "frames"):
            seen, whole = (tables.get(scene, m, Quantity("speed", "", f"train_{what}")) for m in (method, "ash"))
            if seen is not None and whole is not None:
                span = dict.fromkeys(f"{value:.0f}" for value in (seen.least, seen.greatest))  # Captures may differ.
                counts.append(f"{' to '.join(span)} of {whole.value:.0f} {what}")
        if len(counts) == 2:
            lines.append(f"{style_of(method).title}: training saw {', '.join(counts)} (paper: {paper.SEEN[method]}).")
    return lines


def exposed(results: Sequence[CellResult]) -> tuple[str, ...]:
    """Methods that were not isolated; oracles are not meant to be."""
    methods = (r.config.method for r in results if r.isolated is False and not is_oracle(r.config.method))
    return tuple(dict.fromkeys(methods))


def doubts(results: Sequence[CellResult]) -> tuple[str, ...]:
    """What was not enforced, other renderers and devices, and clocks that contradict each other."""
    lines = []
    if names := exposed(results):
        lines.append(
            f"Not isolated: {titles(names)}. The system could not isolate the method's process: the truth was not given"
            " to it, and access to it was watched, but not made impossible."
        )
    for result in results:
        if result.evaluated_code:
            lines.append(f"{result.config.title}: scored by other code ({result.evaluated_code}) than trained it.")
    lines += dict.fromkeys(_reported(result) for result in results if result.brought is not None)
    for kind, words in DRAWN_BY.items():
        timed = dict.fromkeys(r.config.method for r in results if r.timing is not None and r.timing.drawn_by == kind)
        lines += [f"{titles([*timed])}: {words}."] if timed else []
    for device in sorted({r.drawn_on for r in results} - {"", "cpu"}):
        drawn = dict.fromkeys(r.config.method for r in results if r.drawn_on == device)
        lines.append(f"{titles([*drawn])}: drawn on {device}, so that milliseconds are not those of one core.")
    for result in results:
        wall, cpu = (result.value("speed", "", f"train_{clock}_s") for clock in ("wall", "cpu"))
        if wall is None or cpu is None or abs(wall - cpu) < CLOCKS_APART_S + CLOCKS_APART * min(wall, cpu):
            continue
        why = "it was stopped, or shared its core" if wall > cpu else "it used more than one core"
        lines.append(f"{result.config.title} trained {wall:.0f} s by the clock and {cpu:.0f} s of CPU time: {why}.")
    return tuple(lines)


def _reported(result: CellResult) -> str:
    """What the authors of brought pictures say of them, never among what was measured."""
    brought = result.brought
    assert brought is not None
    parts = [f"training {brought.training_s:g} s"] if brought.training_s is not None else []
    parts += [f"{brought.frame_ms:g} ms per frame"] if brought.frame_ms is not None else []
    parts += [f"{brought.parameters} parameters"] if brought.parameters is not None else []
    parts += [f"{name} {value}" for name in ("device", "commit") if (value := getattr(brought, name))]
    text = f"{style_of(result.config.method).title}: brought pictures, rendered elsewhere; what it saw is not known."
    text += " Without alpha: only the whole frame is scored." if brought.alpha == "none" else ""
    return f"{text} Reported by its authors, not measured here: {', '.join(parts)}." if parts else text


def frontier(tables: RunTables, scene: str) -> tuple[str, ...]:
    """The front of accuracy and speed, and the smallest sufficient method, by split."""
    lines = []
    for split in RANKED_SPLITS:
        competing = pareto.candidates(tables, scene, split)
        if len(competing) < 2:
            continue
        text = f"On {SPLIT_NAMES[split].words}, no method beats {titles(pareto.front(competing))} in both accuracy and"
        text += " speed."
        if (sufficient := pareto.smallest_sufficient(competing)) is not None:
            text += f" Smallest sufficient: {style_of(sufficient.name).title}, the cheapest that loses less than"
            text += f" {pareto.SUFFICIENT_DB} dB to {style_of(sufficient.best).title}"
            text += f" (95 % bound {sufficient.loss_bound_db:.2f} dB)."
        lines.append(text)
    return tuple(lines)
