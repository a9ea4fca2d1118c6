"""Which cell's process sees which GPU: shown with cells that print it, and without a GPU."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.cells import config
from helpers.running import fake_cell, run

import ash.devices
import benchmarks.commands.runs
from benchmarks import cli
from benchmarks.cell.schema import Cell, read_result
from benchmarks.suites import gpus
from benchmarks.suites.gpus import VISIBLE, lent_gpu, visible_gpus
from benchmarks.suites.runs import RunOptions


def seen_by(cell: Cell) -> str:
    """What the method in the cell's process printed."""
    assert read_result(cell.folder).status == "done"
    lines = (cell.folder / "output.log").read_text().splitlines()
    return next(line.removeprefix("sees ") for line in lines if line.startswith("sees "))


@pytest.mark.usefixtures("installed_fakes")
def test_cells_side_by_side_see_a_gpu_each(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VISIBLE, "3,5")
    devices = ("cuda", "cuda", "cuda:1")
    cells = [
        fake_cell("placed", capture, tmp_path, seed=seed, changes=(("device", device),))
        for seed, device in enumerate(devices)
    ]
    run(cells, gpus=("3", "5"))
    first, second, named = map(seen_by, cells)
    assert {first, second} == {"3", "5"}
    assert named == "3,5", "who names a GPU sees what the user lets it see"


def test_the_least_busy_gpu_is_lent_and_given_back() -> None:
    on_cuda = replace(config(), changes={"device": "cuda"})
    with lent_gpu(("a", "b"), on_cuda) as first, lent_gpu(("a", "b"), on_cuda) as second:
        assert (first, second) == ({VISIBLE: "a"}, {VISIBLE: "b"})
        with lent_gpu(("a", "b"), on_cuda) as third:
            assert third == {VISIBLE: "a"}, "three cells on two GPUs: one has two"
    with pytest.raises(RuntimeError), lent_gpu(("a", "b"), on_cuda):
        raise RuntimeError
    with lent_gpu(("a", "b"), on_cuda) as again:
        assert again == {VISIBLE: "a"}
    assert not any(gpus._lent.values())
    with lent_gpu((), on_cuda) as none, lent_gpu(("a",), config()) as processor:
        assert none == processor == {}


@pytest.mark.parametrize(
    ("listed", "count", "expected"),
    [
        (None, 3, ("0", "1", "2")),
        ("2, 0", 2, ("2", "0")),
        ("GPU-12ab,GPU-34cd", 2, ("GPU-12ab", "GPU-34cd")),
        ("1,-1,2", 1, ("1",)),  # CUDA stops at the first that is none.
        ("", 0, ()),
    ],
)
def test_a_users_own_list_is_kept(
    listed: str | None, count: int, expected: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.delenv(VISIBLE, raising=False) if listed is None else monkeypatch.setenv(VISIBLE, listed)
    assert visible_gpus() == expected


@pytest.mark.parametrize(
    ("flags", "cells", "lent"),
    [
        (("--device", "cuda"), 3, ("0", "1", "2")),
        (("--device", "auto"), 3, ("0", "1", "2")),
        (("--device", "cuda", "--workers", "6"), 6, ("0", "1", "2")),
        (("--device", "cuda:1"), 1, None),
        ((), 5, ()),
        (("--device", "cuda", "--executor", "dask://host:1"), 5, ()),
    ],
    ids=["cuda", "auto", "workers", "named", "cpu", "dask"],
)
def test_a_run_takes_as_many_cells_side_by_side_as_there_are_gpus(
    flags: tuple[str, ...], cells: int, lent: tuple[str, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[RunOptions] = []
    monkeypatch.delenv(VISIBLE, raising=False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(
        ash.devices, "cuda_error", lambda name="cuda": "it is elsewhere" if "dask" in str(flags) else ""
    )
    monkeypatch.setattr("benchmarks.provenance.cores", lambda: 5)
    monkeypatch.setattr(benchmarks.commands.runs, "run_and_report", lambda suite, options: taken.append(options) or 0)
    assert cli.main(["run", "ci", *flags]) == cli.DONE
    (options,) = taken
    assert options.side_by_side == cells
    assert lent is None or options.gpus == lent
    assert options.workers == (6 if "6" in flags else 5), "captures are rendered by the processor"
