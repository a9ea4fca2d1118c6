"""Cells of an earlier run stay where today's code makes the same pictures, and nowhere else."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import cells

from ash.files import InputError
from benchmarks.cell.schema import (
    Cell,
    CellResult,
    CurvePoint,
    Provenance,
    ViewScore,
    read_result,
    result_of,
    write_config,
    write_result,
)
from benchmarks.suites.reuse import TRAINED_BY, reuse

PEOPLE = 3


def cell_of(folder: Path, method: str, subject: int, code: str) -> Cell:
    config = replace(cells.config(method), subject=subject, code=code)
    return Cell(config=config, folder=folder / config.key, capture_folder=folder)


def result(cell: Cell, *, picture: str = "p", loss: float = 0.5, interrupted: bool = False) -> CellResult:
    config = cell.config
    view = ViewScore(split="novel_view", camera="cam0", frame=0, prediction=f"{picture}{config.subject}", scores={})
    provenance = Provenance(commit=f"commit of {config.code}", machine={}, versions={"torch": "2"}, wall_s=60.0)
    first = CurvePoint(seconds=0.5, loss=0.75, psnr=10.0)
    curve = (first,) * (1 + interrupted) + (CurvePoint(seconds=float(config.code), loss=loss, psnr=20.0),)
    return CellResult(config=config, status="done", views=(view,), curve=curve, provenance=provenance)


def finished(folder: Path, methods: Sequence[str], code: str = "1") -> list[Cell]:
    run = [cell_of(folder, method, subject, code) for method in methods for subject in range(PEOPLE)]
    for cell in run:
        write_config(cell)
        write_result(cell.folder, result(cell))
        (cell.folder / "model.safetensors").write_text(f"weights of {cell.config.title}")
    return run


class Trainer:
    """Trains the cells that have no result, and notes which."""

    def __init__(self, **of_method: dict[str, object]) -> None:
        self.of_method, self.trained, self.said = of_method, list[str](), list[str]()

    def run(self, run: Sequence[Cell]) -> None:
        for cell in run:
            if result_of(cell) is None:
                self.trained.append(cell.config.title)
                write_config(cell)
                write_result(cell.folder, result(cell, **self.of_method.get(cell.config.method, {})))  # type: ignore[arg-type]


def reused(run: Sequence[Cell], earlier: Sequence[Cell], trainer: Trainer) -> list[str]:
    """The titles of cells that have a result which nobody trained."""
    reuse(run, earlier, trainer.run, say=trainer.said.append)
    return [c.config.title for c in run if result_of(c) is not None and c.config.title not in trainer.trained]


def test_one_training_per_row_decides_on_the_others(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "old", ("ash", "ddc"))
    run = [cell_of(tmp_path / "new", m, subject, "2") for m in ("ash", "ddc") for subject in range(PEOPLE)]
    trainer = Trainer(ddc={"picture": "q"})
    assert reused(run, earlier, trainer) == ["loose · subject 1 · ash · seed 0", "loose · subject 2 · ash · seed 0"]
    assert trainer.trained == ["loose · ash · seed 0", "loose · ddc · seed 0"]
    assert trainer.said == [
        "loose · ash: all 1 pictures are the same, 2 cells reused",
        "loose · ddc: trained anew, for 1 of 1 pictures differ",
    ]
    copied = read_result(run[1].folder)
    assert copied is not None and copied.config == run[1].config and copied.provenance is not None
    assert copied.provenance.commit == "commit of 1" and copied.provenance.versions == {TRAINED_BY: "1", "torch": "2"}
    assert (run[1].folder / "model.safetensors").read_text() == "weights of loose · subject 1 · ash · seed 0"
    assert {path.name for path in (tmp_path / "new").iterdir()} == {c.folder.name for c in run[:4]}, "nothing half-made"


def test_an_equal_picture_of_another_training_is_no_proof(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "old", ("ash",))
    run = [cell_of(tmp_path / "new", "ash", subject, "2") for subject in range(PEOPLE)]
    trainer = Trainer(ash={"loss": 0.25})
    assert reused(run, earlier, trainer) == []
    assert trainer.said == ["loose · ash: trained anew, for the last line of its training log differs"]


def test_what_today_trained_already_decides_and_what_was_reused_does_not(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "old", ("ash",))
    run = [cell_of(tmp_path / "new", "ash", subject, "2") for subject in range(PEOPLE)]
    trainer = Trainer(ash={"picture": "q"})
    trainer.run(run[2:])
    assert reused(run, earlier, trainer) == [], "its own training is looked at, wherever it stands"
    assert trainer.trained == ["loose · subject 2 · ash · seed 0"]

    run = [cell_of(tmp_path / "newer", "ash", subject, "3") for subject in range(PEOPLE)]
    first = Trainer()
    reused(run[:2], earlier, first)
    again = Trainer(ash={"picture": "q"})
    assert first.trained == ["loose · ash · seed 0"]
    assert reused(run[1:], earlier, again) == ["loose · subject 1 · ash · seed 0"], "left as it was"
    assert again.trained == [], "a reused cell alone shows nothing"


def test_an_interrupted_training_has_more_lines_and_is_the_same(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "old", ("ash",))
    run = [cell_of(tmp_path / "new", "ash", subject, "2") for subject in range(PEOPLE)]
    assert len(reused(run, earlier, Trainer(ash={"interrupted": True}))) == PEOPLE - 1


def test_cells_of_the_same_code_are_copied_at_once(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "table", ("ash",))
    run = [cell_of(tmp_path / "new", method, subject, "1") for method in ("ash", "tava") for subject in range(PEOPLE)]
    trainer = Trainer()
    assert len(reused(run, earlier, trainer)) == PEOPLE and trainer.trained == []
    assert trainer.said == ["3 cells of the same code reused"]
    copied = read_result(run[0].folder)
    assert copied == result(earlier[0]), "nothing else trained it"
    assert reused(run, earlier, trainer) and len(trainer.said) == 1, "nothing is left to copy"


def test_other_captures_and_failures_are_not_taken(tmp_path: Path) -> None:
    earlier = finished(tmp_path / "old", ("ash",))
    write_result(earlier[1].folder, replace(result(earlier[1]), status="crashed"))
    run = [cell_of(tmp_path / "new", "ash", subject, "2") for subject in range(PEOPLE)]
    run[2] = replace(run[2], config=replace(run[2].config, capture="d" * 64))
    trainer = Trainer()
    assert reused(run, earlier, trainer) == [] and trainer.trained == [], (
        "one is left, which would be trained to decide on itself"
    )


@pytest.mark.parametrize("damage", ["", "{}"])
def test_a_damaged_earlier_result_is_an_error(tmp_path: Path, damage: str) -> None:
    earlier = finished(tmp_path / "old", ("ash",))
    (earlier[1].folder / "result.json").write_text(damage)
    run = [cell_of(tmp_path / "new", "ash", subject, "2") for subject in range(PEOPLE)]
    with pytest.raises(InputError, match=r"result\.json"):
        reuse(run, earlier, Trainer().run, say=print)
