"""Reuses cells of other runs: those of the same code, and those that a change of code does not reach.

Trainings are deterministic: code that computes the same gives the same pictures, bit for bit. Where the code is
another, one cell of every row and scene is run by today's. If its last loss and its pictures are those of the other
run, the row's other cells on that scene are copied from there. They keep their times, commit and machine; `TRAINED_BY`
among their versions names the code that trained them.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from benchmarks.cell.schema import Cell, CellConfig, CellResult, result_of, write_config, write_result
from benchmarks.suites.engine import copied_folder

TRAINED_BY = "code of reused trainings"  # a version in the provenance of a reused cell


@dataclass(frozen=True, kw_only=True, slots=True)
class Pair:
    """A cell and its counterpart in another run, which differ in nothing but perhaps the code."""

    cell: Cell
    earlier: Cell
    result: CellResult  # of the other run

    @property
    def is_of_other_code(self) -> bool:
        """Whether the other run was trained by other code."""
        return self.earlier.config.code != self.cell.config.code

    @property
    def is_missing(self) -> bool:
        """Whether the cell has no result yet."""
        return result_of(self.cell) is None


def reuse(
    cells: Sequence[Cell],
    earlier: Iterable[Cell],
    run: Callable[[Sequence[Cell]], None],
    *,
    say: Callable[[str], None],
) -> None:
    """Copy what other runs have of the cells: of other code row by row, once `run` has made one and it is the same.

    A row that would have to be trained as a whole to find out is left alone.

    Raises:
        InputError: a result of either is damaged.
    """
    pairs = _pairs(cells, earlier)
    if same := [pair for pair in pairs if not pair.is_of_other_code and pair.is_missing]:
        for pair in same:
            _copy(pair)
        say(f"{_count(same)} of the same code reused")
    rows: dict[tuple[str, str], list[Pair]] = {}
    for pair in pairs:
        if pair.is_of_other_code:
            rows.setdefault((pair.cell.config.place, pair.cell.config.method), []).append(pair)
    decisive = {row: each for row, of_row in rows.items() if (each := _decisive(of_row)) is not None}
    if decisive:
        run([pair.cell for pair in decisive.values()])
    for row, pair in decisive.items():
        result = result_of(pair.cell)
        if result is None:  # interrupted
            continue
        if difference := training_difference(result, pair.result):
            say(f"{' · '.join(row)}: trained anew, {difference}")
        else:
            missing = [each for each in rows[row] if each.is_missing]
            for each in missing:
                _copy(each)
            say(f"{' · '.join(row)}: all {len(result.views)} pictures are the same, {_count(missing)} reused")


def _count(pairs: Sequence[Pair]) -> str:
    return f"{len(pairs)} cell{'' if len(pairs) == 1 else 's'}"


def _pairs(cells: Sequence[Cell], earlier: Iterable[Cell]) -> list[Pair]:
    """The cells of which another run has a result."""
    finished = {}
    for cell in earlier:
        result = result_of(cell)
        if result is not None and result.status == "done" and result.provenance is not None:
            finished[_without_code(cell.config)] = (cell, result)
    places = [(cell, _without_code(cell.config)) for cell in cells]
    return [Pair(cell=c, earlier=finished[k][0], result=finished[k][1]) for c, k in places if k in finished]


def _without_code(config: CellConfig) -> str:
    return replace(config, code="").key


def _decisive(pairs: Sequence[Pair]) -> Pair | None:
    """The pair that decides on its row: one that today's code has trained, else the first that it has to.

    None where nothing could be reused.
    """
    missing = [pair for pair in pairs if pair.is_missing]
    trained = [pair for pair in pairs if _trained_here(result_of(pair.cell))]
    return (*trained, *missing)[0] if len(trained[:1]) + len(missing) > 1 else None


def _trained_here(result: CellResult | None) -> bool:
    return result is not None and (result.provenance is None or TRAINED_BY not in result.provenance.versions)


def training_difference(one: CellResult, two: CellResult) -> str:
    """Why two trainings of one cell are not the same: how they ended, a loss, a picture; empty where they are.

    Of their logs the last lines are compared, for a training that was interrupted has more lines.
    """
    if not one.status == two.status == "done":
        return f"for it is {one.status} and was {two.status}"
    last = [[(point.loss, point.psnr) for point in result.curve[-1:]] for result in (one, two)]
    if last[0] != last[1]:
        return "for the last line of its training log differs"
    pictures = [[(v.split, v.camera, v.frame, v.prediction) for v in result.views] for result in (one, two)]
    differ = sum(a != b for a, b in zip(*pictures, strict=False)) + abs(len(one.views) - len(two.views))
    return f"for {differ} of {len(one.views)} pictures differ" if differ else ""


def _copy(pair: Pair) -> None:
    """Copy the cell of the other run as the result of this one."""
    provenance = pair.result.provenance
    assert provenance is not None, "only cells with one are paired"
    versions = provenance.versions
    if pair.is_of_other_code:
        versions = {TRAINED_BY: pair.earlier.config.code} | versions
    with copied_folder(pair.earlier.folder, pair.cell.folder) as folder:
        write_config(replace(pair.cell, folder=folder))
        write_result(
            folder, replace(pair.result, config=pair.cell.config, provenance=replace(provenance, versions=versions))
        )
