"""The sentences that head a report, computed from its numbers. Differences are taken before anything is rounded."""

from collections.abc import Sequence
from itertools import chain

from benchmarks.analysis import paper, pareto
from benchmarks.analysis.results import FRAME_MS, RANKED_SPLITS, Quantity, RunTables, foreground
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
    return ", ".join(style_of(method).title for method in methods)


def sentence(text: str) -> str:
    """Closed by one full stop, also where it ends with a name such as `w/o mot.`."""
    return text.removesuffix(".") + "."


def headline(tables: RunTables, scene: str) -> str:
    """The finding of a scene: who is ahead and by how much; and whose training had not reached its plateau."""
    short = _with_outcome(tables, scene, "not plateau")
    rest = f" Not at their plateau when training ended: {sentence(titles(short))}" if short else ""
    return _finding(tables, scene) + rest


def _finding(tables: RunTables, scene: str) -> str:
    if pairs := [pair for pair in PAIRS if set(pair) <= set(tables.methods(scene))]:
        return " ".join(_pair(tables, scene, *pair) for pair in pairs)
    means = tables.values(scene, foreground(), tables.methods(scene, oracles=False))
    ranked = sorted(means.items(), key=lambda pair: -pair[1])
    if not ranked:
        return f"On {scene}, no method was ranked on novel views."
    (best, most), *others = ranked
    text = f"On {scene}, {style_of(best).title} is best on novel views with {most:.1f} dB"
    if others and most - others[0][1] < TOO_CLOSE_DB:
        text += f", level with {style_of(others[0][0]).title} (within {TOO_CLOSE_DB:g} dB)"
    elif others:
        text += f", {most - others[0][1]:.1f} dB ahead of {style_of(others[0][0]).title}"
    return sentence(text)


def _pair(tables: RunTables, scene: str, splats: str, mesh: str) -> str:
    names = style_of(splats).title, style_of(mesh).title
    if lost := [method for method in (splats, mesh) if tables.failed(scene, method)]:
        return f"On {scene}, {titles(lost)} failed: {names[0]} and {names[1]} cannot be compared."
    parts = []
    for split in RANKED_SPLITS:
        means = tables.values(scene, foreground(split), (splats, mesh))
        if len(means) == 2:
            lead = means[splats] - means[mesh]
            far = f"{abs(lead):.1f} dB {'ahead of' if lead > 0 else 'behind'} {names[1]}"
            standing = f"level with {names[1]}" if abs(lead) < TOO_CLOSE_DB else far
            parts.append(f"{standing} on {SPLIT_NAMES[split].words} ({means[splats]:.1f} and {means[mesh]:.1f} dB)")
    if not parts:
        return f"On {scene}, {names[0]} and {names[1]} were not both scored."
    return f"On {scene}, {names[0]} is {' and '.join(parts)}."


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
    return f"A frame takes {', '.join(parts)} on one core." if parts else ""


def _template(tables: RunTables, scene: str) -> str:
    names = tables.methods(scene, oracles=False)
    views, poses = (tables.values(scene, Quantity(split, "", "template_mm"), names) for split in RANKED_SPLITS)
    if not views:
        return ""
    method, error = next(iter(views.items()))
    later = f", {poses[method]:.1f} mm on novel poses" if method in poses else ""
    return f"The error of the template that methods were given is {error:.1f} mm (root mean square){later}."


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
