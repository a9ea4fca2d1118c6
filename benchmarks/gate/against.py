"""Times against an earlier revision, drawn in turn with today's code: the only comparison that a shared machine allows.

The revision is one of the repository that holds the method. For a method under a `--method-path`, today's ash-bench
draws with the method as it was; ash-bench's own methods are drawn by a checkout with an environment of its own.
"""

import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ash.files import InputError
from benchmarks.cell.registry import find_method, find_spec_of
from benchmarks.cell.run import evaluate_cell
from benchmarks.cell.sandbox import METHOD_PATH
from benchmarks.cell.schema import Cell, Timing, result_of
from benchmarks.gate.baseline import Entry, copied
from benchmarks.gate.checks import Check
from benchmarks.gate.statistical import SLOWER, SLOWER_STORED, least_times, rises, time_checks
from benchmarks.provenance import commit

ROUNDS = 5  # and up to as many more while a time fails by less than would be told of stored times
ROOT = Path(__file__).resolve().parents[2]  # of ash-bench's checkout
WHERE = """\
import sys
from benchmarks.cell.registry import find_spec_of
from benchmarks.cell.sandbox import add_method_paths
add_method_paths()
spec = find_spec_of(sys.argv[1])
print(spec.origin if spec else "")
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Revision:
    """An earlier revision of a repository, and how to draw by it."""

    name: str
    command: tuple[str, ...]  # ash-bench: of the revision, or today's
    method_path: str  # folders of methods, as in PATH
    methods: frozenset[str]  # whose code the repository holds


class CannotDraw(InputError):
    """The revision does not draw an avatar."""


def revision_of(name: str, methods: Iterable[str], out: Path) -> Revision:
    """A revision of the repository that holds `methods`; its work tree in `out` is made if it is not there.

    Raises:
        InputError: a method is in no repository, two are in different ones, one is found elsewhere as well, git does
            not know the revision, or its set-up fails.
    """
    homes = {method: _repository_of(method) for method in methods}
    others = sorted({*homes.values()} - {ROOT})
    if len(others) > 1:
        raise InputError(f"--against: expected methods in one repository, got {', '.join(map(str, others))}")
    root = others[0] if others else ROOT
    tree = _work_tree(root, name, out)
    folders = [tree / path.relative_to(root) if path.is_relative_to(root) else path for path in _method_paths()]
    command = (str(tree / "ash-bench"),) if root == ROOT else (sys.executable, "-P", "-m", "benchmarks.cli")
    if root == ROOT and subprocess.run([*command, "run", "--help"], stdout=subprocess.DEVNULL, check=False).returncode:
        raise InputError(f"{tree}: the set-up of {name} failed; its own message stands above")
    revision = Revision(
        name=name,
        command=command,
        method_path=os.pathsep.join(map(str, folders)),
        methods=frozenset(method for method, home in homes.items() if home == root),
    )
    if root != ROOT:
        _require_from(tree, revision)
    return revision


def commit_of(methods: Iterable[str]) -> str:
    """The commit of the git repository that holds methods of others, where it is one; else that of ash-bench."""
    try:
        homes = {_repository_of(method) for method in methods} - {ROOT}
    except InputError:
        homes = set()
    return commit(homes.pop() if len(homes) == 1 else None)


def _method_paths() -> list[Path]:
    return [Path(path).resolve() for path in os.environ.get(METHOD_PATH, "").split(os.pathsep) if path]


def _repository_of(method: str) -> Path:
    """The git repository that holds a method's code."""
    source = find_method(method)
    if source.is_ours and (ROOT / ".git").exists():
        return ROOT
    spec = find_spec_of(source.target)
    file = Path(spec.origin if spec and spec.origin else os.devnull).resolve()
    for folder in _method_paths():
        if file.is_relative_to(folder) and (root := _git(folder, "rev-parse", "--show-toplevel")):
            return Path(root).resolve()
    raise InputError(
        f"--against: expected {method} in a checkout of ash-bench or under a --method-path in a git repository"
    )


def _work_tree(root: Path, name: str, out: Path) -> Path:
    commit = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}")
    if not commit:
        raise InputError(f"--against {name}: expected a revision that git knows in {root}")
    tree = (out / commit[:12]).resolve()
    if not (tree / ".git").exists():
        tree.parent.mkdir(parents=True, exist_ok=True)
        _git(root, "worktree", "prune")  # Forgets those that were deleted with their folder of results.
        if _git(root, "worktree", "add", "--force", "--detach", str(tree), commit) is None:
            raise InputError(f"{tree}: git could not make a work tree of {name} of {root}")
    return tree


def _require_from(tree: Path, revision: Revision) -> None:
    """Refuse methods that processes would import from elsewhere: what is installed comes before `--method-path`."""
    for method in revision.methods:
        command = [sys.executable, "-P", "-c", WHERE, find_method(method).target]
        done = subprocess.run(command, env=_environment(revision), capture_output=True, text=True, check=False)
        origin = done.stdout.strip().rpartition("\n")[2]
        if origin and not Path(origin).resolve().is_relative_to(tree):
            raise InputError(
                f"--against: {method} is imported from {origin}, whatever --method-path says; expected it not to be"
                " installed (pip uninstall)"
            )


def _environment(revision: Revision) -> dict[str, str]:
    return {**os.environ, METHOD_PATH: revision.method_path}


def _git(folder: Path, *words: str) -> str | None:
    """What git prints; None where it fails or is not installed."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def interleaved(
    row: str, entry: Entry, here: Cell, out: Path, revision: Revision
) -> tuple[list[Check], dict[str, float]]:
    """Checks of the times of a baseline's avatar, drawn in turn by a revision and by today's code; today's least times.

    What is drawn first alternates. `here`: see `copied`.
    """
    before: list[Timing] = []
    after: list[Timing] = []
    turns = [
        lambda: before.append(_timed_by(revision, copied(entry, here, out / "against"))),
        lambda: after.append(_timed_today(copied(entry, here, out))),
    ]
    for number in range(1, 2 * ROUNDS + 1):
        try:
            for draw in turns:
                draw()
        except CannotDraw as error:
            return [Check(row, "cost", "not judged", str(error), "times")], {}
        turns.reverse()
        least = least_times(before, beside=after), least_times(after, beside=before)
        unclear = any(SLOWER <= rise < SLOWER_STORED for rise in rises(*least).values())
        if number >= ROUNDS and not unclear:
            break
    return time_checks(row, *least, stored=False), least[1]


def _timed_today(cell: Cell) -> Timing:
    timing = evaluate_cell(cell).timing
    assert timing is not None
    return timing


def _timed_by(revision: Revision, cell: Cell) -> Timing:
    """The times of a cell that a revision drew again.

    Raises:
        CannotDraw: it does not.
    """
    command = [*revision.command, "eval", str(cell.folder.resolve())]
    done = subprocess.run(command, env=_environment(revision), capture_output=True, text=True, check=False)
    result = result_of(cell)
    if done.returncode or result is None or result.timing is None:
        last = done.stderr.strip().rpartition("\n")[2]
        raise CannotDraw(f"--against: {revision.name} cannot draw {cell.config.title}: {last}")
    return result.timing
