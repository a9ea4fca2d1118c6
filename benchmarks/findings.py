"""The sentences that head a report, computed from its numbers."""

import numpy as np

from benchmarks import contrasts, pareto
from benchmarks.names import EXACT, SPLIT_WORDS, is_oracle, look_of
from benchmarks.scores import Score, Scores

TOO_CLOSE_DB = 0.1
FEW_METHODS = 6


def headline(scores: Scores, scene: str) -> str:
    """The finding of a scene in one sentence: who is ahead, by how much, where it changes."""
    if "ash" in scores.methods(scene) and "ddc" in scores.methods(scene):
        return _duel(scores, scene)
    ranked = _ranked(scores, scene, "novel_view")
    if not ranked:
        return f"On {scene}, no method was ranked on held-out views."
    best = f"On {scene}, {look_of(ranked[0][0]).title} is best on held-out views with {ranked[0][1].mean:.1f} dB"
    if len(ranked) == 1:
        return best + "."
    ahead = ranked[0][1].mean - ranked[1][1].mean
    return f"{best}, {ahead:.1f} dB ahead of {look_of(ranked[1][0]).title}."


def remarks(scores: Scores, scene: str) -> list[str]:
    """What else must be known to read the numbers: the exact surface, cost, template, noise, seeds, failures."""
    found = [_exact(scores, scene), _cost(scores, scene), _template(scores, scene), _noise(scores, scene)]
    found.append(_failures(scores, scene))
    if scores.seeds == 1:
        found.append("One seed: a difference of a few tenths of a dB may be chance; --seeds 3 gives intervals.")
    return [remark for remark in found if remark]


def frontier(scores: Scores, scene: str) -> tuple[str, ...]:
    """Who is beaten by nobody in accuracy and speed together, what the field covers, and what would have sufficed."""
    found = []
    for split, where in SPLIT_WORDS.items():
        competing = contrasts.candidates(scores, scene, split)
        if len(competing) < 2:
            continue
        names = ", ".join(look_of(name).title for name in pareto.front(competing))
        area = f"hypervolume {pareto.hypervolume(competing):.1f} dB·decades"
        if scores.seeds > 1:
            low, high = pareto.hypervolume_interval(competing, rng=np.random.default_rng(0))
            area += f" [{low:.1f}, {high:.1f}]"
        sentence = f"On {where}, nobody beats {names} in both accuracy and speed ({area})."
        sufficient = pareto.smallest_sufficient(competing)
        if sufficient is not None:
            bound = f"{pareto.SUFFICIENT_DB} dB to {look_of(sufficient.best).title}"
            sentence += (
                f" Smallest sufficient: {look_of(sufficient.name).title}, the cheapest that loses less than {bound}"
            )
            sentence += f" (95 % bound {sufficient.loss_bound_db:.2f} dB)."
        found.append(sentence)
    return tuple(found)


def _duel(scores: Scores, scene: str) -> str:
    fallen = [look_of(method).title for method in ("ash", "ddc") if scores.failed(scene, method)]
    if fallen:
        return f"On {scene}, {' and '.join(fallen)} failed, so ASH and DDC cannot be compared."
    parts = []
    for split, where in SPLIT_WORDS.items():
        ours, theirs = scores.fg(scene, "ash", split), scores.fg(scene, "ddc", split)
        if ours and theirs:
            parts.append(f"{_standing(ours, theirs)} on {where} ({ours.mean:.1f} against {theirs.mean:.1f} dB)")
    return f"On {scene}, ASH is {' and '.join(parts)}." if parts else f"On {scene}, ASH and DDC were not both scored."


def _standing(ours: Score, theirs: Score) -> str:
    margin = ours.mean - theirs.mean
    if abs(margin) < TOO_CLOSE_DB:
        return "level with DDC"
    return f"{abs(margin):.1f} dB {'ahead of' if margin > 0 else 'behind'} DDC"


def _exact(scores: Scores, scene: str) -> str:
    if any(scores.failed(scene, EXACT[method]) for method in ("ash", "ddc")):
        return ""
    pairs = [scores.fg(scene, EXACT[method]) for method in ("ash", "ddc")]
    if pairs[0] is None or pairs[1] is None:
        return ""
    ours, theirs = pairs[0].mean, pairs[1].mean
    figures = f"(ASH {ours:.1f}, DDC {theirs:.1f} dB on held-out views)"
    if abs(ours - theirs) < TOO_CLOSE_DB:
        return f"Given the exact surface, the two are level {figures}."
    leader = "ASH leads" if ours > theirs else "the mesh leads"
    return f"Given the exact surface, {leader} by {abs(ours - theirs):.1f} dB {figures}."


def _cost(scores: Scores, scene: str) -> str:
    """Of many methods only the main two, the fastest and the slowest."""
    found = [(method, scores.get(scene, method, "speed", "", "frame_ms")) for method in scores.methods(scene)]
    known = [
        (method, frame.mean)
        for method, frame in found
        if frame and not is_oracle(method) and not scores.failed(scene, method)
    ]
    if len(known) > FEW_METHODS:
        ranked = sorted(known, key=lambda pair: pair[1])
        known = [pair for pair in known if pair[0] in ("ash", "ddc") or pair in (ranked[0], ranked[-1])]
    parts = [f"{look_of(method).title} {ms:.0f} ms" for method, ms in known]
    return f"A frame takes {', '.join(parts)} on one core." if parts else ""


def _template(scores: Scores, scene: str) -> str:
    for method in scores.methods(scene):
        error = scores.get(scene, method, "novel_view", "", "template_mm")
        if error and not is_oracle(method):
            test = scores.get(scene, method, "novel_pose", "", "template_mm")
            later = f", {test.mean:.1f} mm on held-out motion" if test else ""
            return f"The template that methods were given is off by {error.mean:.1f} mm (root mean square){later}."
    return ""


def _noise(scores: Scores, scene: str) -> str:
    for method in scores.methods(scene):
        ceiling = scores.fg(scene, method, "novel_view", "noise_ceiling")
        if ceiling:
            return f"Noise of the true images allows at most {ceiling.mean:.1f} dB on the foreground."
    return ""


def _failures(scores: Scores, scene: str) -> str:
    failed = [look_of(method).title for method in scores.methods(scene) if scores.failed(scene, method)]
    return f"Failed, and scored with the worst value: {', '.join(failed)}." if failed else ""


def _ranked(scores: Scores, scene: str, split: str) -> list[tuple[str, Score]]:
    found = [(method, scores.fg(scene, method, split)) for method in scores.methods(scene) if not is_oracle(method)]
    known = [(method, score) for method, score in found if score is not None]
    return sorted(known, key=lambda pair: -pair[1].mean)
