"""What the gate says: on the terminal, as Markdown for a pull request, as JUnit, and as pictures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ash.files import InputError, write_atomic
from benchmarks import provenance
from benchmarks.cell.registry import DECIDING_PACKAGES, find_method, named_method
from benchmarks.gate.baseline import Baseline
from benchmarks.gate.checks import FAILING, LAYERS, Check, Verdict, outcome
from benchmarks.gate.exact import Worst
from benchmarks.gate.gate import Judgement
from benchmarks.report import escaping
from benchmarks.report.pictures import Frame, Frames, crop_of, on_paper, sheet

WORDS: dict[Verdict, str] = {
    "unchanged": "unchanged",
    "not worse": "changed, and not worse",
    "worse": "worse",
    "better than explained": "better than explained: a leak looks like progress",
    "not judged": "incomplete: nothing could be judged",
}
# Sources that decide a time, by its name, and what is shared by all methods.
STAGES = {
    "stg1": ("ash/template/",),
    "stg2": ("ash/textures.py", "ash/native/"),
    "stg3": ("ash/decoders.py", "ash/native/"),
    "stg4": ("ash/gaussians/", "ash/native/"),
    "training": ("ash/training/",),
    "frame": ("ash/",),
}
TEMPLATE = ("ash/template/", "ash/template_learning/")
SHARED = ("ash/", "synth/", "benchmarks/cell/")
SOURCES = ("ash/", "baselines/", "synth/", "benchmarks/cell/", "pyproject.toml", "constraints.txt")
SHOWN_FILES = 20
BRIGHTER = 4  # The difference of two pictures is shown so many times as large.


def verdict(checks: Sequence[Check]) -> str:
    """One line."""
    found = outcome(checks)
    bad = sum(check.verdict in FAILING for check in checks)
    judged = sum(check.verdict != "not judged" for check in checks)
    count = f"{bad} of {judged} checks fail" if bad else f"{judged} checks"
    return f"gate: {'FAILED' if found in FAILING else 'passed'}, {WORDS[found]} ({count})"


def terminal(baseline: Baseline, judged: Judgement, changed: Sequence[str] | None) -> str:
    """The verdict, what changed and by how much, likely sources, and the verdict again."""
    checks = judged.checks
    shown = [check for check in checks if check.verdict != "unchanged"] or checks
    here = provenance.commit()
    lines = [verdict(checks), f"suite {judged.run.suite}, commit {here} against baseline {baseline.commit}"]
    lines += [f"  {check.verdict:22} {check.title}: {check.detail}" for check in _in_order(shown)]
    if bad := [check for check in checks if check.verdict in FAILING]:
        lines += ["", *likely_sources(bad, changed)]
    lines += [f"Accepted at {a.commit}: {a.row}: {a.because}" for a in baseline.file.accepted]
    lines.append(verdict(checks))
    return "\n".join(escaping.CONTROLS.sub(" ", line) for line in lines)


def markdown(baseline: Baseline, judged: Judgement) -> str:
    """A summary for a pull request: the verdict, what changed, and all checks folded away."""
    checks = judged.checks
    texts = (judged.run.suite, provenance.commit(), baseline.commit, provenance.processor_name())
    suite, here, before, machine = map(escaping.markdown, texts)
    lines = [f"## {escaping.markdown(verdict(checks))}", ""]
    lines.append(f"Suite {suite}, commit {here} against baseline {before}, on {machine}.")
    if news := [check for check in checks if check.verdict != "unchanged"]:
        lines += ["", *_table(news)]
    for accepted in baseline.file.accepted:
        told = (accepted.row, accepted.commit, accepted.because)
        lines += ["", "Accepted: {} at {}: {}".format(*map(escaping.markdown, told))]
    lines += ["", "<details><summary>All checks</summary>", "", *_table(checks), "", "</details>", ""]
    return "\n".join(lines)


def junit(checks: Sequence[Check]) -> str:
    """The checks as a JUnit file."""
    bad = sum(check.verdict in FAILING for check in checks)
    skipped = sum(check.verdict == "not judged" for check in checks)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    numbers = f'tests="{len(checks)}" failures="{bad}" errors="0" skipped="{skipped}"'
    lines.append(f'<testsuite name="ash-bench gate" {numbers}>')
    for check in checks:
        name = ": ".join(part for part in (check.layer, check.name) if part)
        head = f'  <testcase classname="{escaping.xml(check.row)}" name="{escaping.xml(name)}"'
        detail = escaping.xml(check.detail)
        if check.verdict == "not judged":
            lines.append(f'{head}><skipped message="{detail}"/></testcase>')
        elif check.verdict in FAILING:
            lines.append(f'{head}><failure message="{escaping.xml(check.verdict)}">{detail}</failure></testcase>')
        else:
            lines.append(f"{head}/>")
    return "\n".join([*lines, "</testsuite>", ""])


def write_pictures(judged: Judgement, out: Path) -> list[Path]:
    """For each row whose rendering changed, its worst picture before and after, and their difference."""
    paths = []
    for number, (row, worst) in enumerate(judged.worst.items()):
        path = out / f"rendering_{number}.png"
        write_atomic(path, sheet([_frames(row, worst)]))
        paths.append(path)
    return paths


def _frames(row: str, worst: Worst) -> Frames:
    crop = crop_of([worst.before, worst.after])
    before, after = (on_paper(image[crop]) for image in (worst.before, worst.after))
    difference = np.clip(BRIGHTER * np.abs(before.astype(int) - after), 0, 255).astype(np.uint8)
    images = (
        Frame(caption="before", score="", pixels=before),
        Frame(caption="after", score=f"{worst.psnr:.1f} dB to before", pixels=after),
        Frame(caption=f"difference x {BRIGHTER}", score="", pixels=difference),
    )
    return Frames(title=f"{row}, {worst.view.split}, {worst.view.camera}, frame {worst.view.frame}", images=images)


def likely_sources(bad: Sequence[Check], changed: Sequence[str] | None) -> list[str]:
    """Likely sources, and which of them changed since the baseline."""
    places = _places(bad)
    lines = [f"Look at: {', '.join(places)}."]
    if changed is None:
        return [*lines, "Which files changed since the baseline is not known here (no git, or not its commit)."]
    deciding = [name for name in changed if name.startswith(SOURCES)]
    near = [name for name in deciding if name.startswith(places)]
    other = [name for name in deciding if name not in near]
    if not deciding:
        told = "No source of ash-bench that decides a result changed since the baseline"
        return [*lines, f"{told}: look at methods of your own, the machine and versions."]
    lines.append(f"{len(deciding)} sources changed since the baseline, {len(near)} of them there:")
    shown = [f"  * {name}" for name in near] + [f"    {name}" for name in other]
    more = [f"    and {len(shown) - SHOWN_FILES} more"] if len(shown) > SHOWN_FILES else []
    return [*lines, *shown[:SHOWN_FILES], *more]


def _places(bad: Sequence[Check]) -> tuple[str, ...]:
    """Folders and files that can change these numbers."""
    places: list[str] = []
    methods = {check.row.rpartition(" · ")[2] for check in bad if check.row}
    for check in bad:
        stage = check.name.removeprefix("time of ")
        if stage in STAGES:
            places += STAGES[stage]
        elif check.name.endswith("template_mm"):
            places += TEMPLATE
        elif check.layer == "protocol":
            places.append("benchmarks/cell/")
        elif check.layer == "rendering":
            places += ("ash/gaussians/", "ash/model.py", *_sources_of(check.row))
        elif len(methods) > 1:
            places += SHARED
        else:
            places += _sources_of(check.row)
    return tuple(dict.fromkeys(places))


def _sources_of(row: str) -> tuple[str, ...]:
    """The module of a row's factory, and the package that all methods of ours are made of."""
    try:
        module = find_method(named_method(row.rpartition(" · ")[2])).target.partition(":")[0]
    except InputError:  # A suite gave the row a name of its own.
        return ("the method's own sources",)
    package = module.split(".")[0]
    if package not in DECIDING_PACKAGES:
        return (f"{package}, the method's own package",)
    return tuple(dict.fromkeys(("ash/" if package == "ash" else f"{module.replace('.', '/')}.py", "ash/")))


def _in_order(checks: Sequence[Check]) -> list[Check]:
    """By row, the failing layers first."""
    return sorted(checks, key=lambda check: (check.row, LAYERS.index(check.layer)))


def _table(checks: Sequence[Check]) -> list[str]:
    texts = [(check.title, check.verdict, check.detail) for check in _in_order(checks)]
    rows = ["| {} | {} | {} |".format(*map(escaping.markdown, row)) for row in texts]
    return ["| check | verdict | detail |", "|---|---|---|", *rows]
