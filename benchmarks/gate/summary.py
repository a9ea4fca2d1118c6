"""The gate's output for the terminal: the verdict first and last, what changed, and likely sources."""

from collections.abc import Sequence

from ash.files import InputError
from benchmarks.cell.registry import DECIDING_PACKAGES, find_method, named_method
from benchmarks.gate.gate import FINE, Baseline, Check
from benchmarks.report import escaping

# Sources that decide a time, by its name, and a template; for the rest, the module of a method's factory.
STAGES = {
    "stg1": ("ash/template/",),
    "stg2": ("ash/textures.py", "ash/native/"),
    "stg3": ("ash/decoders.py", "ash/native/"),
    "stg4": ("ash/gaussians/", "ash/native/"),
    "training": ("ash/training/",),
    "frame": ("ash/",),
}
TEMPLATE = ("ash/template/", "ash/template_learning/")
MAKING_SCENES = ("synth/", "ash/capture/")
SHARED = ("ash/", "synth/", "benchmarks/cell/")  # by all methods
SOURCES = ("ash/", "baselines/", "synth/", "benchmarks/cell/", "pyproject.toml", "constraints.txt")
SHOWN_FILES = 20


def terminal(baseline: Baseline, head: Baseline, checks: Sequence[Check], changed: Sequence[str] | None) -> str:
    """The verdict, what changed by how much, likely sources, and the verdict again."""
    bad = [check for check in checks if check.verdict not in FINE]
    lines = [verdict(checks), f"suite {head.suite}, commit {head.commit} against baseline {baseline.commit}"]
    for check in bad:
        lines.append(f"  {check.verdict:22} {check.what}: {check.detail}")
    if bad:
        one_of_many = len({c.scene for c in bad}) < len({c.scene for c in checks})
        lines += ["", f"What changed: {pattern(checks)}.", *likely_sources(bad, changed, one_of_many=one_of_many)]
    else:
        lines += [f"  {check.what}: {check.detail}" for check in checks]
    not_judged: dict[str, list[str]] = {}
    for check in checks:
        if check.verdict == "not judged":
            not_judged.setdefault(check.detail, []).append(f"{check.what.partition(': ')[0]}")
    lines += [f"Not judged: {', '.join(rows)}: {detail}." for detail, rows in not_judged.items()]
    lines.append(verdict(checks))
    return "\n".join(escaping.CONTROLS.sub(" ", line) for k, line in enumerate(lines) if line or k)


def verdict(checks: Sequence[Check]) -> str:
    """One line."""
    bad = sum(check.verdict not in FINE for check in checks)
    judged = sum(check.verdict != "not judged" for check in checks)
    return f"gate: FAILED, {bad} of {judged} checks did not pass" if bad else f"gate: passed, {judged} checks"


def pattern(checks: Sequence[Check]) -> str:
    """Whether one method or all changed, on one scene or on all, in quality or in cost."""
    bad = [check for check in checks if check.verdict not in FINE]
    methods = _share("method", {c.method for c in bad}, {c.method for c in checks})
    scenes = _share("scene", {c.scene for c in bad}, {c.scene for c in checks})
    kinds = " and ".join(sorted({c.kind for c in bad}))
    better = all(check.verdict == "unexplained improvement" for check in bad)
    return f"{methods}, on {scenes}, in {kinds}{', for the better: a leak looks like progress' if better else ''}"


def likely_sources(bad: Sequence[Check], changed: Sequence[str] | None, *, one_of_many: bool) -> list[str]:
    """Likely sources, and which of them changed since the baseline."""
    places = _places(bad, one_of_many)
    lines = [f"Look at: {', '.join(places)}."]
    if changed is None:
        return [*lines, "Which files changed since the baseline is not known here (no git, or not its commit)."]
    deciding = [name for name in changed if name.startswith(SOURCES)]
    near = [name for name in deciding if name.startswith(places)]
    other = [name for name in deciding if name not in near]
    if not deciding:
        return [*lines, "No source that decides a result changed since the baseline: look at the machine and versions."]
    lines.append(f"{len(deciding)} sources changed since the baseline, {len(near)} of them there:")
    shown = [f"  * {name}" for name in near] + [f"    {name}" for name in other]
    more = [f"    and {len(shown) - SHOWN_FILES} more"] if len(shown) > SHOWN_FILES else []
    return [*lines, *shown[:SHOWN_FILES], *more]


def _share(word: str, changed: set[str], judged: set[str]) -> str:
    if changed == judged:
        return f"the only {word} ({', '.join(changed)})" if len(judged) == 1 else f"all {len(judged)} {word}s"
    if len(changed) == 1:
        return f"one {word} of {len(judged)} ({', '.join(changed)})"
    return f"{len(changed)} of {len(judged)} {word}s ({', '.join(sorted(changed))})"


def _places(bad: Sequence[Check], one_of_many: bool) -> tuple[str, ...]:
    """Folders and files that can change these numbers; `one_of_many`: some scenes changed and others did not."""
    places: list[str] = []
    methods = {check.method for check in bad}
    for check in bad:
        if check.kind == "time" and check.name in STAGES:
            places += STAGES[check.name]
        elif check.name.endswith("template_mm"):
            places += TEMPLATE
        elif len(methods) > 1:
            places += MAKING_SCENES if one_of_many else SHARED
        else:
            places += sources_of(check.method)
    return tuple(dict.fromkeys(places))


def sources_of(row: str) -> tuple[str, ...]:
    """The module of a row's factory, and the package that all methods of ours are made of."""
    try:
        module = find_method(named_method(row)).target.partition(":")[0]
    except InputError:  # A suite gave the row a name of its own.
        return ("the method's own sources",)
    package = module.split(".")[0]
    if package not in DECIDING_PACKAGES:
        return (f"{package}, the method's own package",)
    return tuple(dict.fromkeys(("ash/" if package == "ash" else f"{module.replace('.', '/')}.py", "ash/")))
