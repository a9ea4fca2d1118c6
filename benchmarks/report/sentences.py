"""The sentences that head a report, computed from its numbers. Differences are taken before anything is rounded."""

from collections.abc import Sequence

import numpy as np

from benchmarks.analysis import contrasts, paper, pareto
from benchmarks.analysis.scores import FRAME_MS, RANKED_SPLITS, Quantity, Scores, foreground
from benchmarks.analysis.style import EXACT, SPLIT_NAMES, style_of
from benchmarks.cell.cells import CellResult
from benchmarks.cell.methods import is_oracle
from synth.person.cast import VALIDATION

TOO_CLOSE_DB = 0.1
CLOCKS_APART_S, CLOCKS_APART = 5.0, 0.5  # seconds, and share of the shorter: what a busy machine does not explain
FEW_METHODS = 6
CHOOSING = (
    f"People from {VALIDATION} on: these numbers are there to choose by, and no verdict. What they choose, others must"
    " confirm."
)
DRAWN_BY = {
    "display": "frames are timed as its display draws them, by OpenGL",
    "trainer": "frames are timed as its training renderer draws them, for this machine opens no OpenGL display",
}


def headline(scores: Scores, scene: str) -> str:
    """The finding of a scene: who is ahead, by how much, where it changes; and who had not finished learning."""
    short = _told(scores, scene, "not finished")
    left = _sentence(f" Not at their plateau when training ended: {short}") if short else ""
    return _finding(scores, scene) + left


def _sentence(text: str) -> str:
    """Closed by one full stop, also where it ends with a name such as `w/o mot.`."""
    return text.removesuffix(".") + "."


def _finding(scores: Scores, scene: str) -> str:
    if {"ash", "ddc"} <= set(scores.methods(scene)):
        return _duel(scores, scene)
    ranked = sorted(_means(scores, scene, foreground()), key=lambda pair: -pair[1])
    if not ranked:
        return f"On {scene}, no method was ranked on held-out views."
    (best, most), *others = ranked
    text = f"On {scene}, {style_of(best).title} is best on held-out views with {most:.1f} dB"
    if others and most - others[0][1] < TOO_CLOSE_DB:
        text += f", level with {style_of(others[0][0]).title} (within {TOO_CLOSE_DB:g} dB)"
    elif others:
        text += f", {most - others[0][1]:.1f} dB ahead of {style_of(others[0][0]).title}"
    return _sentence(text)


def remarks(scores: Scores, scene: str) -> list[str]:
    """What else must be known to read the numbers: the exact surface, cost, template, noise, seeds, failures."""
    found = [CHOOSING] if scores.for_choosing(scene) else []
    found += [_exact(scores, scene), _cost(scores, scene), _template(scores, scene), _noise(scores, scene)]
    found.append(_supervision(scores, scene))
    dead = _told(scores, scene, "dead")
    found.append(_sentence(f"Decoders carry nothing, the same output in every frame: {dead}") if dead else "")
    failed = [style_of(method).title for method in scores.methods(scene) if scores.failed(scene, method)]
    found.append(_sentence(f"Failed, and scored with the worst value: {', '.join(failed)}") if failed else "")
    if not scores.repeated(scene):
        found.append("One seed: a difference of a few tenths of a dB may be chance; --seeds 3 gives intervals.")
    elif scores.captures(scene) == 1:
        found.append("One capture: intervals are over seeds, and say nothing about other people; --subjects 8 does.")
    return [remark for remark in found if remark]


def views_seen(scores: Scores, scene: str) -> tuple[str, ...]:
    """What training saw, of rows that the paper trained on a part of its views: a sentence each."""
    found = []
    for method in scores.methods(scene):
        counts = [_count_seen(scores, scene, method, what) for what in ("cameras", "frames")]
        if method in paper.SEEN and all(counts):
            seen = ", ".join(counts)
            found.append(f"{style_of(method).title}: training saw {seen} (paper: {paper.SEEN[method]}).")
    return tuple(found)


def exposed(results: Sequence[CellResult]) -> tuple[str, ...]:
    """Methods that could not be locked in; oracles are not meant to be."""
    found = (r.config.method for r in results if r.isolated is False and not is_oracle(r.config.method))
    return tuple(dict.fromkeys(found))


def doubts(results: Sequence[CellResult]) -> tuple[str, ...]:
    """What could not be enforced, and clocks that contradict each other: notes under the tables."""
    found = []
    if titles := [style_of(method).title for method in exposed(results)]:
        found.append(
            f"Not isolated: {', '.join(titles)}. The system had no room to lock the method in, so the truth was out of"
            " effect, and opening it was watched, but not impossible."
        )
    for result in results:
        if result.evaluated_code:
            found.append(f"{result.config.title}: scored by other code ({result.evaluated_code}) than trained it.")
    for kind, words in DRAWN_BY.items():
        timed = (r.config.method for r in results if r.timing is not None and r.timing.drawn_by == kind)
        if names := [style_of(method).title for method in dict.fromkeys(timed)]:
            found.append(f"{', '.join(names)}: {words}.")
    for device in sorted({r.drawn_on for r in results} - {"", "cpu"}):
        names = list(dict.fromkeys(style_of(r.config.method).title for r in results if r.drawn_on == device))
        found.append(f"{', '.join(names)}: drawn on {device}, so that milliseconds are not those of one core.")
    for result in results:
        wall, cpu = (result.value("speed", "", f"train_{clock}_s") for clock in ("wall", "cpu"))
        if wall is None or cpu is None or abs(wall - cpu) < CLOCKS_APART_S + CLOCKS_APART * min(wall, cpu):
            continue
        why = "it was stopped, or shared its core" if wall > cpu else "it used more than one core"
        found.append(f"{result.config.title} trained {wall:.0f} s by the clock and {cpu:.0f} s of CPU time: {why}.")
    return tuple(found)


def frontier(scores: Scores, scene: str) -> tuple[str, ...]:
    """Who is beaten by nobody in accuracy and speed together, what the field covers, and what would have sufficed."""
    found = []
    for split in RANKED_SPLITS:
        competing = contrasts.candidates(scores, scene, split)
        if len(competing) < 2:
            continue
        names = ", ".join(style_of(name).title for name in pareto.front(competing))
        area = f"hypervolume {pareto.hypervolume(competing):.1f} dB·decades"
        if scores.repeated(scene):
            low, high = pareto.hypervolume_interval(competing, rng=np.random.default_rng(0))
            area += f" [{low:.1f}, {high:.1f}]"
        sentence = f"On {SPLIT_NAMES[split].words}, nobody beats {names} in both accuracy and speed ({area})."
        sufficient = pareto.smallest_sufficient(competing)
        if sufficient is not None:
            bound = f"{pareto.SUFFICIENT_DB} dB to {style_of(sufficient.best).title}"
            cheapest = f"{style_of(sufficient.name).title}, the cheapest that loses less than {bound}"
            sentence += f" Smallest sufficient: {cheapest} (95 % bound {sufficient.loss_bound_db:.2f} dB)."
        found.append(sentence)
    return tuple(found)


def _duel(scores: Scores, scene: str) -> str:
    fallen = [style_of(method).title for method in ("ash", "ddc") if scores.failed(scene, method)]
    if fallen:
        return f"On {scene}, {' and '.join(fallen)} failed, so ASH and DDC cannot be compared."
    parts = []
    for split in RANKED_SPLITS:
        ours, theirs = (scores.get(scene, method, foreground(split)) for method in ("ash", "ddc"))
        if ours and theirs:
            standing = _standing(ours.mean - theirs.mean)
            parts.append(f"{standing} on {SPLIT_NAMES[split].words} ({ours.mean:.1f} against {theirs.mean:.1f} dB)")
    return f"On {scene}, ASH is {' and '.join(parts)}." if parts else f"On {scene}, ASH and DDC were not both scored."


def _standing(margin: float) -> str:
    if abs(margin) < TOO_CLOSE_DB:
        return "level with DDC"
    return f"{abs(margin):.1f} dB {'ahead of' if margin > 0 else 'behind'} DDC"


def _exact(scores: Scores, scene: str) -> str:
    ours, theirs = (scores.get(scene, EXACT[method], foreground()) for method in ("ash", "ddc"))
    if ours is None or theirs is None or not scores.whole(scene, *EXACT.values()):
        return ""
    margin = ours.mean - theirs.mean
    figures = f"(ASH {ours.mean:.1f}, DDC {theirs.mean:.1f} dB on held-out views)"
    if abs(margin) < TOO_CLOSE_DB:
        return f"Given the exact surface, the two are level {figures}."
    return f"Given the exact surface, {'ASH' if margin > 0 else 'the mesh'} leads by {abs(margin):.1f} dB {figures}."


def _cost(scores: Scores, scene: str) -> str:
    """Of many methods only the main two, the fastest and the slowest."""
    known = [(method, ms) for method, ms in _means(scores, scene, FRAME_MS) if scores.whole(scene, method)]
    if len(known) > FEW_METHODS:
        ends = [pair(known, key=lambda each: each[1])[0] for pair in (min, max)]
        known = [(method, ms) for method, ms in known if method in ("ash", "ddc", *ends)]
    parts = [f"{style_of(method).title} {ms:.0f} ms" for method, ms in known]
    return f"A frame takes {', '.join(parts)} on one core." if parts else ""


def _template(scores: Scores, scene: str) -> str:
    errors = {split: _means(scores, scene, Quantity(split, "", "template_mm")) for split in RANKED_SPLITS}
    if not errors["novel_view"]:
        return ""
    method, error = errors["novel_view"][0]
    later = dict(errors["novel_pose"]).get(method)
    test = "" if later is None else f", {later:.1f} mm on held-out motion"
    return f"The template that methods were given is off by {error:.1f} mm (root mean square){test}."


def _supervision(scores: Scores, scene: str) -> str:
    """What each row's template was learned from."""
    rows = scores.outcomes.query("scene == @scene and template != ''").drop_duplicates(["method", "template"])
    said = [
        f"{template} ({', '.join(style_of(method).title for method in group['method'])})"
        for template, group in rows.groupby("template", sort=False)
    ]
    return f"Templates: {'; '.join(said)}." if said else ""


def _told(scores: Scores, scene: str, what: str) -> str:
    """The methods of which a cell tells so of its training."""
    methods = scores.outcomes.query(f"scene == @scene and {what}")["method"].unique()
    return ", ".join(style_of(method).title for method in scores.methods(scene) if method in methods)


def _count_seen(scores: Scores, scene: str, method: str, what: str) -> str:
    """How many cameras or frames a training saw, of those that ASH's saw; empty where either is unknown."""
    seen, whole = (scores.get(scene, name, Quantity("speed", "", f"train_{what}")) for name in (method, "ash"))
    if seen is None or whole is None:
        return ""
    count = dict.fromkeys(f"{value:.0f}" for value in (seen.least, seen.greatest))  # Captures may differ.
    return f"{' to '.join(count)} of {whole.mean:.0f} {what}"


def _noise(scores: Scores, scene: str) -> str:
    ceiling = foreground(metric="noise_ceiling")
    found = [score for method in scores.methods(scene) if (score := scores.get(scene, method, ceiling))]
    return f"Noise of the true images allows at most {found[0].mean:.1f} dB on the foreground." if found else ""


def _means(scores: Scores, scene: str, quantity: Quantity) -> list[tuple[str, float]]:
    """What each method that is no oracle has of a quantity."""
    names = [method for method in scores.methods(scene) if not is_oracle(method)]
    return [(method, score.mean) for method in names if (score := scores.get(scene, method, quantity))]
