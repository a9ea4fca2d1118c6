"""What is published under reports/ says of itself whether today's code made it."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.cell.registry import code_version

REPORTS = Path(__file__).parents[3] / "reports"
ROW = re.compile(r"^\| \[.+?\]\((?P<file>[^)]+)\).*? \| (?P<state>[^|]+) \|", re.MULTILINE)
FACT = r"^(?:\| {0} \| |- {0}: )(.*?)(?: \|)?$"  # of a report's provenance, as a table's row or a list's item
NO_CELLS = ("no cells", "reference")  # pictures, times; the gate's baseline, which judges code that is younger than it


def fact(report: str, name: str) -> str:
    """A fact of a report's provenance; none where it was made before there was such a fact."""
    found = re.search(FACT.format(name), report, re.MULTILINE)
    return found.group(1) if found else ""


def untrue_states(reports: Path, code: str) -> Iterator[str]:
    """What the table of reports/README.md says wrongly, given the hash of today's code."""
    states = {found["file"]: found["state"] for found in ROW.finditer((reports / "README.md").read_text())}
    for path in sorted(reports.glob("*/report.md")):
        name, text = path.relative_to(reports).as_posix(), path.read_text()
        expected = "current" if fact(text, "code") == code else f"stale, {fact(text, 'commit')}"
        if states.get(name) != expected:
            yield f"{name}: expected the state {expected!r} in reports/README.md, got {states.get(name)!r}"
    for name, state in states.items():
        if not (reports / name).exists():
            yield f"{name}: is not there"
        elif not name.endswith("/report.md") and state not in NO_CELLS and not state.startswith("stale, "):
            yield f"{name}: {state!r}, expected one of {', '.join(NO_CELLS)}, or stale with what made it"


def test_a_report_of_other_code_is_marked_as_stale_with_its_commit() -> None:
    assert list(untrue_states(REPORTS, code_version("ash"))) == []


@pytest.mark.parametrize(
    ("report", "state", "expected"),
    [
        ("| commit | abc |\n| code | 1234 |", "current", ""),
        ("| commit | abc |\n| code | 1234 |", "stale, abc", "expected the state 'current'"),
        ("| commit | abc |\n| code | 9999 |", "current", "expected the state 'stale, abc'"),
        ("| commit | abc |\n| code | 1234, 9999 |", "current", "expected the state 'stale, abc'"),
        ("| commit | abc |\n| code | 9999 |", "stale, abd", "expected the state 'stale, abc'"),
        ("- commit: abc", "current", "expected the state 'stale, abc'"),
        ("- commit: abc", "stale, abc", ""),
    ],
)
def test_states_follow_from_the_hash_that_a_report_carries(
    report: str, state: str, expected: str, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.md").write_text(report)
    table = f"| report | state |\n|---|---|\n| [mine](mine/report.md) | {state} |\n"
    (tmp_path / "README.md").write_text(table)
    found = list(untrue_states(tmp_path, "1234"))
    assert not found if not expected else len(found) == 1 and expected in found[0]


def test_every_report_and_every_row_has_a_state(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.md").write_text("| commit | abc |\n| code | 1234 |")
    (tmp_path / "baseline.json").write_text("{}")
    (tmp_path / "README.md").write_text("| [a](baseline.json) | good |\n| [b](gone/rates.md) | no cells |\n")
    missing, odd, gone = untrue_states(tmp_path, "1234")
    assert "mine/report.md: expected the state 'current'" in missing and "got None" in missing
    assert "'good', expected one of" in odd and gone == "gone/rates.md: is not there"
