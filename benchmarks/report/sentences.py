"""The sentences that head a report, computed from its numbers. Differences are taken before anything is rounded."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain

import pandas as pd

from benchmarks.analysis import paper, pareto
from benchmarks.analysis.differences import differences
from benchmarks.analysis.results import (
    FRAME_MS,
    HELD_OUT_SPLITS,
    RANKED_SPLITS,
    Quantity,
    RunTables,
    compare,
    fewer_captures,
    foreground,
)
from benchmarks.analysis.statistics import corrected
from benchmarks.analysis.style import EXACT, PAIRS, SPLIT_NAMES, listed, style_of
from benchmarks.cell.metrics import METRICS
from benchmarks.cell.registry import is_oracle
from benchmarks.cell.schema import CellResult
from synth.person.cast import VALIDATION

MARGIN_DB = METRICS["psnr"].abs_tol
CLOCKS_APART_S, CLOCKS_APART = 5.0, 0.5  # seconds, and share of the shorter: what a busy machine does not explain
FEW_METHODS = 6
SMOKE_TESTS = ("ci",)  # sizes and presets
FEW_NAMED = 3  # in a headline
PSNR_IS = "PSNR on the person's pixels; higher is better, 1 dB more is an error smaller by a fifth."
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


def sentence(text: str) -> str:
    """Closed by one full stop, also where it ends with a name such as `w/o mot.`."""
    return text.removesuffix(".") + "."


def headline(tables: RunTables, scene: str, *, smoke: bool = False) -> str:
    """What a scene shows, with its certainty; first of all whose training had not reached its plateau.

    `smoke`: sizes or steps are those of a smoke test, of which no method is said to be better.
    """
    if smoke:
        return f"Smoke test on {scene}: it shows that every part runs, and not which method is better."
    short, count = _with_outcome(tables, scene, "not plateau"), len(tables.methods(scene))
    names = titles(short) if len(short) <= FEW_NAMED else f"{len(short)} of {count} methods"
    names = "every method" if len(short) == count > 1 else names
    first = f"Not at their plateau when training ended: {sentence(names)} " if short else ""
    return first + _finding(tables, scene)


def _finding(tables: RunTables, scene: str) -> str:
    """The verdict on each pair; where there is none, those on the rows of an ablation, or on the two best methods."""
    ranked = differences(tables.of(scene))
    if pairs := [pair for pair in PAIRS if set(pair) <= set(tables.methods(scene))]:
        first, *others = (_pair(tables, scene, ranked, *pair) for pair in pairs)
        return " ".join([f"On {scene}, {first}", *(text[0].upper() + text[1:] for text in others)])
    if len(ranked) and ranked["p"].notna().all():
        return sentence(f"On {scene}, {'; '.join(_ablation(ranked))}")
    means = tables.values(scene, foreground(), tables.methods(scene, oracles=False))
    first, *others = sorted(means, key=lambda name: -means[name]) or [""]
    if not first:
        return f"On {scene}, no method was ranked on novel views."
    if not others:
        return f"On {scene}, {sentence(f'{style_of(first).title} has {means[first]:.1f} dB on novel views')}"
    compared = {other: compare(tables.of(scene), first, other, foreground()) for other in others}
    tests = {other: each for other, each in compared.items() if each is not None}
    rows = [
        {"method": other, "reference": first, "split": "novel_view", **asdict(each), "verdict": each.verdict}
        for other, each in zip(tests, corrected([*tests.values()]), strict=True)
    ]
    return f"On {scene}, {_pair(tables, scene, pd.DataFrame(rows), first, others[0])}"


def _ablation(ranked: pd.DataFrame) -> list[str]:
    """By split and reference: the rows it is better or worse than, and how many show no difference to it."""
    words = {"better": "better than", "worse": "worse than", "equivalent": f"equal within {MARGIN_DB:g} dB to"}
    texts = []
    for (split, reference), rows in ranked.groupby(["split", "reference"], sort=False):
        by_verdict = {verdict: list(group["method"]) for verdict, group in rows.groupby("verdict")}
        clauses = [f"{text} {titles(by_verdict[verdict])}" for verdict, text in words.items() if verdict in by_verdict]
        if unclear := by_verdict.get("unclear", []):
            named = titles(unclear) if len(unclear) <= FEW_NAMED else f"{len(unclear)} methods"
            clauses.append(f"not known to differ from {named}")
        texts.append(f"on {SPLIT_NAMES[split].words} {style_of(reference).title} is {', '.join(clauses)}")
    return texts


def _pair(tables: RunTables, scene: str, ranked: pd.DataFrame, first: str, second: str) -> str:
    """Two methods by split: the verdict of `ranked`, the table of differences; of single values the numbers alone."""
    names = style_of(first).title, style_of(second).title
    if lost := [method for method in (first, second) if tables.failed(scene, method)]:
        return f"{titles(lost)} failed: {names[0]} and {names[1]} cannot be compared."
    parts: dict[str, list[str]] = {}  # by what is said of the splits
    own = ranked[(ranked["method"] == second) & (ranked["reference"] == first)] if len(ranked) else ranked
    for row in own.itertuples():
        words = f"on {SPLIT_NAMES[row.split].words}"
        if math.isnan(row.p):
            means = tables.values(scene, foreground(row.split), (first, second))
            numbers = f"{means[first]:.1f} and {means[second]:.1f} dB {words}"
            parts.setdefault(f"{names[0]} and {names[1]} have ", []).append(numbers)
            continue
        best, worst = names if row.mean > 0 else names[::-1]
        ends = sorted((abs(row.low), abs(row.high)))
        how = f"{best} is better than {worst} "
        text = f"{words} by {abs(row.mean):.1f} dB (95 % interval {ends[0]:.1f} to {ends[1]:.1f})"
        if row.verdict == "equivalent":
            how, text = f"{names[0]} and {names[1]} are equal within {MARGIN_DB:g} dB ", words
        elif row.verdict == "unclear":
            how = f"no difference between {names[0]} and {names[1]} is shown "
            text = f"{words} ({row.mean:+.1f} dB, 95 % interval {row.low:+.1f} to {row.high:+.1f}"
            text += f"; p {row.p:.2g}, corrected for all rows)" if row.low * row.high > 0 else ")"
        parts.setdefault(how, []).append(text)
    if not parts:
        return f"{names[0]} and {names[1]} were not both scored."
    text = "; ".join(how + " and ".join(texts) for how, texts in parts.items())
    return f"{text}{'' if tables.unit(scene) else ', one training of each: chance is not ruled out'}."


def facts(tables: RunTables, scene: str) -> list[tuple[str, str]]:
    """What else must be known to read the numbers: a label and a text each."""
    lines = [
        ("Scores", f"{PSNR_IS} {_scores(tables, scene)} {_exact(tables, scene)}"),
        ("How sure", _certainty(tables, scene)),
        ("Smallest sufficient", _sufficient(tables, scene)),
        ("Weakest", _weakest(tables, scene)),
        ("Time", f"{_training(tables, scene)} {_cost(tables, scene)}"),
        ("Limits", f"{_noise(tables, scene)} {_template(tables, scene)}"),
        ("Missing", _missing(tables, scene)),
    ]
    return [(label, text.strip()) for label, text in lines if text.strip()]


def _ranked(tables: RunTables, scene: str) -> list[str]:
    fewer = fewer_captures(tables.of(scene))
    return [name for name in tables.methods(scene, oracles=False) if tables.whole(scene, name) and name not in fewer]


def _scores(tables: RunTables, scene: str) -> str:
    """Foreground PSNR of the methods, the best first; of many, the main pairs and the best."""
    parts = []
    for split in RANKED_SPLITS:
        means = tables.values(scene, foreground(split), _ranked(tables, scene))
        order = sorted(means, key=lambda name: -means[name])
        if len(order) > FEW_METHODS:
            order = [name for name in order if name in (order[0], *chain(*PAIRS))]
        if order:
            scores = listed([f"{style_of(name).title} {means[name]:.1f} dB" for name in order])
            parts.append(f"On {SPLIT_NAMES[split].words}: {scores}.")
    return " ".join(parts)


def _certainty(tables: RunTables, scene: str) -> str:
    people, seeds = tables.captures(scene), tables.seeds(scene)
    note = f" {FOR_VALIDATION}" if tables.for_validation(scene) else ""
    if people == seeds == 1:
        return f"One training of each method on one person: no verdicts. --seeds 3 or --subjects 8 gives them.{note}"
    text = f"{seeds} trainings (seeds) of each method, on one person: other people may differ (--subjects 8)."
    if people > 1:
        each = "one training" if seeds == 1 else f"{seeds} trainings"
        text = f"{people} people, {each} of each method per person; methods are compared on the same person."
    return f"{text} A 95 % interval holds the true difference in 95 of 100 such experiments.{note}"


def _sufficient(tables: RunTables, scene: str) -> str:
    """The cheapest method that loses next to nothing, by split."""
    parts: dict[str, list[str]] = {}
    for split in RANKED_SPLITS:
        competing = pareto.candidates(tables, scene, split)
        if len(competing) < 2:
            continue
        if (sufficient := pareto.smallest_sufficient(competing)) is None:
            return "Not known from one value of each."
        title, best = style_of(sufficient.name).title, style_of(sufficient.best).title
        text = f"{title}, the fastest that loses less than {pareto.SUFFICIENT_DB} dB to {best} (95 % confidence)"
        if sufficient.name == sufficient.best:
            text = f"{title}, the best; no faster method is known to lose less than {pareto.SUFFICIENT_DB} dB"
        parts.setdefault(text, []).append(SPLIT_NAMES[split].words)
    return " ".join(f"On {' and '.join(words)}: {text}." for text, words in parts.items())


def _weakest(tables: RunTables, scene: str) -> str:
    """The split on which the methods score lowest, and the methods that draw every frame alike."""
    means = {split: tables.values(scene, foreground(split), _ranked(tables, scene)) for split in HELD_OUT_SPLITS}
    means = {split: values for split, values in means.items() if values}
    text = ""
    if len(means) > 1:
        split = min(means, key=lambda split: sum(means[split].values()) / len(means[split]))
        order = sorted(means[split], key=lambda name: means[split][name])
        ends = dict.fromkeys((order[0], order[-1]))
        scores = " to ".join(f"{means[split][name]:.1f} dB ({style_of(name).title})" for name in ends)
        text = f"Scores are lowest on {SPLIT_NAMES[split].words}: {scores}. The worst frames are shown below."
    if dead := _with_outcome(tables, scene, "dead"):
        text += sentence(f" The decoders have the same output in every frame: {titles(dead)}")
    return text


def _training(tables: RunTables, scene: str) -> str:
    rows = tables.of(scene)
    rows = rows[(rows["metric"] == "train_s") & (rows["status"] == "done")]
    spans = []
    for place, seconds in rows.groupby(rows["method"].map(tables.trained_on), sort=False)["value"]:
        span = dict.fromkeys(f"{value:.0f}" for value in (seconds.min(), seconds.max()))
        spans.append(f"{' to '.join(span)} s on {place}")
    return f"A training took {listed(spans)}." if spans else ""


def _missing(tables: RunTables, scene: str) -> str:
    lines = []
    if failed := [method for method in tables.methods(scene) if tables.failed(scene, method)]:
        lines.append(sentence(f"Failed, and scored with the worst value: {titles(failed)}"))
    if not (tables.of(scene)["metric"] == "lpips").any():
        lines.append("LPIPS was not measured.")
    if short := _with_outcome(tables, scene, "not plateau"):
        names = titles(short) if set(short) < set(tables.methods(scene)) else "every method"
        lines.append(sentence(f"Training ended before its plateau: {names}"))
    return " ".join(lines)


def templates(tables: RunTables, scene: str) -> str:
    """What each template was learned from."""
    outcomes = tables.outcomes[tables.outcomes["scene"] == scene]
    learned = outcomes[outcomes["template"] != ""].drop_duplicates(["method", "template"])
    kinds = [f"{template} ({titles([*rows['method']])})" for template, rows in learned.groupby("template", sort=False)]
    return f"Templates: {'; '.join(kinds)}." if kinds else ""


def _exact(tables: RunTables, scene: str) -> str:
    means = tables.values(scene, foreground(), EXACT.values())
    if len(means) < 2 or not tables.whole(scene, *EXACT.values()):
        return ""
    ash, ddc = means.values()
    return f"Given the exact surface, on novel views: ASH {ash:.1f}, DDC {ddc:.1f} dB."


def _cost(tables: RunTables, scene: str) -> str:
    """Of many methods only the main two, the fastest and the slowest."""
    frame_ms = tables.values(scene, FRAME_MS, _ranked(tables, scene))
    if len(frame_ms) > FEW_METHODS:
        ends = [pick(frame_ms, key=lambda name: frame_ms[name]) for pick in (min, max)]
        frame_ms = {name: ms for name, ms in frame_ms.items() if name in (*chain(*PAIRS), *ends)}
    by_place: dict[str, list[str]] = {}
    for method, ms in frame_ms.items():
        by_place.setdefault(tables.drawn_on[method], []).append(f"{style_of(method).title} {ms:.0f} ms")
    parts = [f"{listed(times)} on {place}" for place, times in by_place.items()]
    return f"A frame takes {'; '.join(parts)}." if parts else ""


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


def smoke(results: Sequence[CellResult]) -> bool:
    """Whether sizes or presets are those of smoke tests."""
    return any(r.config.size in SMOKE_TESTS or (r.brought is None and r.config.preset in SMOKE_TESTS) for r in results)


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
    return (*lines, *_clocks(results))


def _clocks(results: Sequence[CellResult]) -> list[str]:
    """Trainings whose two clocks contradict each other: the farthest apart in words, the others as a count."""
    apart: dict[str, list[tuple[float, str]]] = {}
    for result in results:
        wall, cpu = (result.value("speed", "", f"train_{clock}_s") for clock in ("wall", "cpu"))
        if wall is None or cpu is None or abs(wall - cpu) < CLOCKS_APART_S + CLOCKS_APART * min(wall, cpu):
            continue
        why = "it was stopped, or shared its core" if wall > cpu else "it used more than one core"
        text = f"{result.config.title} trained {wall:.0f} s by the clock and {cpu:.0f} s of CPU time: {why}"
        apart.setdefault(why, []).append((abs(wall - cpu), text))
    return [f"{max(cells)[1]}{f'; likewise {len(cells) - 1} more' if cells[1:] else ''}." for cells in apart.values()]


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
