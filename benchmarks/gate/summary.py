"""What the gate says: on the terminal, as Markdown for a pull request, as JUnit, and as pictures."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ash.files import write_atomic
from benchmarks.gate.baseline import Baseline
from benchmarks.gate.checks import FAILING, LAYERS, Check, Verdict, outcome
from benchmarks.gate.exact import Worst
from benchmarks.gate.gate import Judgement
from benchmarks.provenance import commit, processor_name
from benchmarks.report import escaping
from benchmarks.report.pictures import Frame, Frames, crop_of, on_paper, sheet

WORDS: dict[Verdict, str] = {
    "unchanged": "unchanged",
    "not worse": "changed, and not worse",
    "worse": "worse",
    "better than explained": "better than explained: a leak looks like progress",
    "not judged": "incomplete: nothing could be judged",
}
BRIGHTER = 4  # The difference of two pictures is shown so many times as large.


def verdict(checks: Sequence[Check]) -> str:
    """One line."""
    judgement = outcome(checks)
    bad = sum(check.verdict in FAILING for check in checks)
    judged = sum(check.verdict != "not judged" for check in checks)
    count = f"{bad} of {judged} checks fail" if bad else f"{judged} checks"
    return f"gate: {'FAILED' if judgement in FAILING else 'passed'}, {WORDS[judgement]} ({count})"


def terminal(baseline: Baseline, judged: Judgement) -> str:
    """The verdict, what changed and by how much, and the verdict again."""
    checks = judged.checks
    shown = [check for check in checks if check.verdict != "unchanged"] or checks
    lines = [verdict(checks), f"suite {judged.run.suite}, commit {commit()} against baseline {baseline.commit}"]
    lines += [f"  {check.verdict:22} {check.title}: {check.detail}" for check in _in_order(shown)]
    lines += [f"Accepted at {a.commit}: {a.row}: {a.because}" for a in baseline.file.accepted]
    return "\n".join(escaping.CONTROLS.sub(" ", line) for line in [*lines, verdict(checks)])


def markdown(baseline: Baseline, judged: Judgement) -> str:
    """A summary for a pull request: the verdict, what changed, and all checks folded away."""
    checks = judged.checks
    texts = (judged.run.suite, commit(), baseline.commit, processor_name())
    suite, here, before, machine = map(escaping.markdown, texts)
    lines = [f"## {escaping.markdown(verdict(checks))}", ""]
    lines.append(f"Suite {suite}, commit {here} against baseline {before}, on {machine}.")
    if news := [check for check in checks if check.verdict != "unchanged"]:
        lines += ["", *_table(news)]
    for accepted in baseline.file.accepted:
        acceptance = (accepted.row, accepted.commit, accepted.because)
        lines += ["", "Accepted: {} at {}: {}".format(*map(escaping.markdown, acceptance))]
    lines += ["", "<details><summary>All checks</summary>", "", *_table(checks), "", "</details>", ""]
    return "\n".join(lines)


def junit(checks: Sequence[Check]) -> str:
    """The checks as a JUnit file."""
    failing, skipped = (sum(c.verdict in kinds for c in checks) for kinds in (FAILING, ("not judged",)))
    counts = {"tests": len(checks), "failures": failing, "errors": 0, "skipped": skipped}
    texts = {name: str(count) for name, count in counts.items()}
    suite = ElementTree.Element("testsuite", {"name": "ash-bench gate", **texts})
    for check in checks:
        row, layer, name, detail = map(escaping.one_line, (check.row, check.layer, check.name, check.detail))
        case = ElementTree.SubElement(suite, "testcase", classname=row, name=": ".join(filter(None, (layer, name))))
        if check.verdict == "not judged":
            ElementTree.SubElement(case, "skipped", message=detail)
        elif check.verdict in FAILING:
            ElementTree.SubElement(case, "failure", message=check.verdict).text = detail
    ElementTree.indent(suite)
    return ElementTree.tostring(suite, encoding="UTF-8", xml_declaration=True).decode() + "\n"


def write_pictures(judged: Judgement, out: Path) -> list[Path]:
    """For each row whose rendering changed, its worst picture before and after, and their difference."""
    paths = []
    for number, (row, worst) in enumerate(judged.worst.items()):
        path = out / f"rendering_{number}.png"
        write_atomic(path, sheet([_frames(row, worst)], form="PNG"))
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


def _in_order(checks: Sequence[Check]) -> list[Check]:
    """By row, the failing layers first."""
    return sorted(checks, key=lambda check: (check.row, LAYERS.index(check.layer)))


def _table(checks: Sequence[Check]) -> list[str]:
    texts = [(check.title, check.verdict, check.detail) for check in _in_order(checks)]
    rows = ["| {} | {} | {} |".format(*map(escaping.markdown, row)) for row in texts]
    return ["| check | verdict | detail |", "|---|---|---|", *rows]
