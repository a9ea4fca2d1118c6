"""What is hashed together lives together: a change in any file of a deciding folder changes the hash."""

import shutil
from pathlib import Path

import pytest

import ash.files
import baselines.ddc
import benchmarks.cell.registry
from ash.files import hash_sources, source_files
from synth.source_hash import MAKERS, NOT_HASHED

DECIDE_A_CELL = (
    Path(ash.files.__file__).parent,
    Path(baselines.ddc.__file__).parent,
    Path(benchmarks.cell.registry.__file__).parent,
)


@pytest.mark.parametrize(("roots", "without"), [(DECIDE_A_CELL, ()), (MAKERS, NOT_HASHED)], ids=["cell", "capture"])
def test_a_change_in_any_deciding_file_changes_the_hash(
    roots: tuple[Path, ...], without: tuple[Path, ...], tmp_path: Path
) -> None:
    checkout = roots[0].parent
    for path in source_files(*roots, without=without):
        (tmp_path / path.relative_to(checkout)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, tmp_path / path.relative_to(checkout))
    copies = [tmp_path / root.relative_to(checkout) for root in roots]
    seen = {hash_sources(*copies)}
    assert seen == {hash_sources(*roots, without=without)}
    files = source_files(*copies)
    assert len(files) > 20
    for path in files:
        path.write_bytes(path.read_bytes() + b"\n")
        seen.add(hash_sources(*copies))
    assert len(seen) == len(files) + 1


def test_a_file_that_moves_changes_the_hash(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "a.py").write_text("x = 1\n")
    before = hash_sources(tmp_path / "package")
    (tmp_path / "package" / "a.py").rename(tmp_path / "package" / "b.py")
    assert hash_sources(tmp_path / "package") != before


def test_excluded_folders_and_other_files_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "package" / "export").mkdir(parents=True)
    (tmp_path / "package" / "a.py").write_text("x = 1\n")
    before = hash_sources(tmp_path / "package", without=(tmp_path / "package" / "export",))
    (tmp_path / "package" / "export" / "b.py").write_text("y = 2\n")
    (tmp_path / "package" / "notes.md").write_text("y = 2\n")
    assert hash_sources(tmp_path / "package", without=(tmp_path / "package" / "export",)) == before
