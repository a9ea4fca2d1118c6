"""Reuses cells of earlier runs, trained by other code, where the change of code does not reach them.

Trainings are deterministic: code that computes the same gives the same pictures, bit for bit. Of every row and scene
one cell is run by today's code. If its training and its pictures are those of the earlier run, the row's other cells on
that scene are copied from there. They keep their times, commit and machine; `TRAINED_BY` among their versions names the
code that trained them.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.cell.schema import Cell, CellConfig, CellResult, result_of, write_config, write_result

TRAINED_BY = "code of reused trainings"  # a version in the provenance of a reused cell


@dataclass(frozen=True, kw_only=True, slots=True)
class Pair:
    """A cell and its counterpart in the earlier run, which differ in nothing but the code."""

    cell: Cell
    earlier: Cell


def reuse(
    cells: Sequence[Cell],
    earlier: Iterable[Cell],
    run: Callable[[Sequence[Cell]], None],
    *,
    say: Callable[[str], None],
) -> None:
    """Copy what earlier runs have of the cells, row by row, once `run` has made one of them and it is the same.

    A row that would have to be trained as a whole to find out is left alone.

    Raises:
        InputError: a result of either is damaged.
    """
    rows = _rows(cells, earlier)
    decisive = {row: pair for row, pairs in rows.items() if (pair := _decisive(pairs)) is not None}
    run([pair.cell for pair in decisive.values()])
    for row, pair in decisive.items():
        one, two = result_of(pair.cell), result_of(pair.earlier)
        if one is None or two is None:  # interrupted
            continue
        difference = training_difference(one, two)
        if difference:
            say(f"{' · '.join(row)}: trained anew, {difference}")
            continue
        waiting = [each for each in rows[row] if result_of(each.cell) is None]
        for each in waiting:
            _copy(each)
        count = f"{len(waiting)} cell{'' if len(waiting) == 1 else 's'}"
        say(f"{' · '.join(row)}: all {len(two.views)} pictures are the same, {count} reused")


def _rows(cells: Sequence[Cell], earlier: Iterable[Cell]) -> dict[tuple[str, str], list[Pair]]:
    """By place and method what both have of each row."""
    there = {_without_code(cell.config): cell for cell in earlier if _is_finished(cell)}
    rows: dict[tuple[str, str], list[Pair]] = {}
    for cell in cells:
        counterpart = there.get(_without_code(cell.config))
        if counterpart is not None and counterpart.config.code != cell.config.code:
            rows.setdefault((cell.config.place, cell.config.method), []).append(Pair(cell=cell, earlier=counterpart))
    return rows


def _is_finished(cell: Cell) -> bool:
    result = result_of(cell)
    return result is not None and result.status == "done" and result.provenance is not None


def _without_code(config: CellConfig) -> str:
    return replace(config, code="").key


def _decisive(pairs: Sequence[Pair]) -> Pair | None:
    """The pair that decides on its row: one that today's code has trained, else the first that it has to.

    None where nothing could be reused.
    """
    missing = [pair for pair in pairs if result_of(pair.cell) is None]
    trained = [pair for pair in pairs if _trained_here(result_of(pair.cell))]
    return (*trained, *missing)[0] if len(trained[:1]) + len(missing) > 1 else None


def _trained_here(result: CellResult | None) -> bool:
    return result is not None and (result.provenance is None or TRAINED_BY not in result.provenance.versions)


def training_difference(one: CellResult, two: CellResult) -> str:
    """Why two trainings of one cell are not the same: how they ended, a loss, a picture; empty where they are."""
    if not one.status == two.status == "done":
        return f"for it is {one.status} and was {two.status}"
    courses = [[(point.loss, point.psnr) for point in result.curve] for result in (one, two)]
    if courses[0] != courses[1]:
        index = next((i for i, (a, b) in enumerate(zip(*courses, strict=False)) if a != b), min(map(len, courses)))
        return f"for line {index + 1} of its training log differs"
    pictures = [[(v.split, v.camera, v.frame, v.prediction) for v in result.views] for result in (one, two)]
    differ = sum(a != b for a, b in zip(*pictures, strict=False)) + abs(len(one.views) - len(two.views))
    return f"for {differ} of {len(one.views)} pictures differ" if differ else ""


def _copy(pair: Pair) -> None:
    """Copy the earlier cell as the result of this one."""
    result, target = result_of(pair.earlier), pair.cell.folder
    assert result is not None and result.provenance is not None, "only finished cells are paired"
    versions = {TRAINED_BY: pair.earlier.config.code} | result.provenance.versions
    provenance = replace(result.provenance, versions=versions)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".reuse-") as made:
        whole = Path(shutil.copytree(pair.earlier.folder, Path(made) / target.name))
        write_config(replace(pair.cell, folder=whole))
        write_result(whole, replace(result, config=pair.cell.config, provenance=provenance))
        shutil.rmtree(target, ignore_errors=True)
        whole.rename(target)
