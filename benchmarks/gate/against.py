"""Times against another revision of this checkout, interleaved: the only comparison that a shared machine allows."""

import shutil
import subprocess
from functools import partial
from pathlib import Path

from ash.files import InputError
from benchmarks.cell.schema import Cell, CellResult, result_of
from benchmarks.gate.baseline import Entry, drawn_again
from benchmarks.gate.checks import Check
from benchmarks.gate.statistical import least_times, time_checks

ROUNDS = 5


def checkout_of(revision: str, out: Path) -> Path:
    """A work tree of a revision of this checkout, with an environment of its own; made if it is not there.

    Raises:
        InputError: this is no checkout, git does not know the revision, or its set-up fails.
    """
    root = Path(__file__).parents[2]
    if not (root / ".git").exists() or shutil.which("git") is None:
        raise InputError("--against: expected a checkout of ash-bench with git")
    git = ["git", "-C", str(root)]
    named = subprocess.run(
        [*git, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}"],
        capture_output=True,
        text=True,
        check=False,
    )
    if named.returncode:
        raise InputError(f"--against {revision}: expected a revision that git knows")
    tree = (out / named.stdout.strip()[:12]).resolve()
    if not (tree / "ash-bench").is_file():
        tree.parent.mkdir(parents=True, exist_ok=True)
        added = [*git, "worktree", "add", "--force", "--detach", str(tree), named.stdout.strip()]
        subprocess.run(added, capture_output=True, check=True)
    if subprocess.run([str(tree / "ash-bench"), "--version"], stdout=subprocess.DEVNULL, check=False).returncode:
        raise InputError(f"{tree}: the set-up of {revision} failed; its own message stands above")
    return tree


def interleaved(row: str, entry: Entry, here: Cell, out: Path, tree: Path) -> list[Check]:
    """Times of a baseline's avatar, drawn in turn by another checkout and by this code; `here`: see `drawn_again`."""
    before, after = [], []
    for _ in range(ROUNDS):
        before.append(drawn_again(entry, here, out / "against", partial(_drawn_by, tree)))
        after.append(drawn_again(entry, here, out))
    least = [least_times(r.timing for r in results if r.timing is not None) for results in (before, after)]
    return time_checks(row, *least)


def _drawn_by(tree: Path, cell: Cell) -> CellResult:
    """The result of a cell that another checkout drew again.

    Raises:
        InputError: it cannot draw the avatar.
    """
    command = [str(tree / "ash-bench"), "eval", str(cell.folder.resolve())]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    result = result_of(cell)
    if done.returncode or result is None:
        last = done.stderr.strip().rpartition("\n")[2]
        raise InputError(f"--against: {tree.name} cannot draw {cell.config.title}: {last}")
    return result
