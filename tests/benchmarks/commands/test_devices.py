"""The flag `--device`: what is refused, what `auto` takes, and that the device is part of a cell's identity."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import fakes
from helpers.cells import cell, config, people
from helpers.commands import refused, refused_last

import ash.devices
from ash.devices import cuda_error
from ash.files import InputError
from benchmarks import cli
from benchmarks.analysis.pareto import candidates
from benchmarks.analysis.results import RunTables, alike
from benchmarks.cell.run import placed_on
from benchmarks.cell.schema import CellConfig, Snapshot, Summary, read_cell, read_result, write_config, write_result
from benchmarks.commands import doctor
from benchmarks.commands.devices import chosen_device, on_device
from benchmarks.play.avatars import open_avatars
from benchmarks.provenance import gpu_name
from benchmarks.report.figures import speed_figure
from benchmarks.report.sections import training_cost
from benchmarks.report.sentences import doubts, facts
from benchmarks.suites.files import find_suite

without_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")


@without_cuda
@pytest.mark.parametrize(
    "command",
    [("run", "ci"), ("train", "ash", "a-folder"), ("eval", "a-run"), ("play", "a-run"), ("speed", "kernels")],
    ids=lambda command: command[0],
)
def test_a_gpu_that_is_not_there_is_one_line_and_exit_code_2(command: tuple[str, ...], capsys) -> None:
    assert refused(capsys, *command, "--device", "cuda").endswith(f"device cuda: {cuda_error()}")
    assert "expected cpu, cuda or cuda:N, got 'gpu'" in refused(capsys, *command, "--device", "gpu")


def test_auto_takes_cuda_where_it_works_and_says_why_where_not(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(ash.devices, "cuda_error", lambda name="cuda": "")
    assert chosen_device("auto") == "cuda" and capsys.readouterr().err == ""
    monkeypatch.setattr(ash.devices, "cuda_error", lambda name="cuda": "it is asleep")
    assert chosen_device("auto") == "cpu" and capsys.readouterr().err == "device: cpu, because it is asleep\n"
    with pytest.raises(InputError, match=re.escape("device cuda:1: it is asleep")):
        chosen_device("cuda:1")


def test_rows_that_have_a_device_are_moved_and_others_stay() -> None:
    suite = find_suite("table")
    moved = on_device(suite, "cuda:1")
    devices = {row.name: dict(row.changes).get("device") for row in moved.methods}
    assert devices["ash"] == devices["ddc"] == devices["smpl"] == devices["oracle_texture"] == "cuda:1"
    assert devices["nearest"] is None
    assert [row.name for row in moved.methods] == [row.name for row in suite.methods]
    assert on_device(suite, "cpu") is suite
    there, here = ({cell.method: cell.changes for cell in each.cells} for each in (moved, suite))
    assert there["ash"] != here["ash"] and there["nearest"] == here["nearest"]


def test_doctor_says_why_a_gpu_cannot_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    if gpu_name() is None:
        assert doctor._gpu().value == "none"
    monkeypatch.setattr(doctor.provenance, "gpu_name", lambda: "a GPU")
    monkeypatch.setattr(ash.devices, "cuda_error", lambda name="cuda": "torch is built without CUDA")
    finding = doctor._gpu()
    assert finding.value == "a GPU, but torch is built without CUDA" and "processor" in finding.consequence


def learned_on_cuda(method: str) -> CellConfig:
    return replace(config(method), changes={"device": "cuda", "model.texels": 128})


def test_an_avatar_is_looked_at_without_a_gpu() -> None:
    there = learned_on_cuda("ash")
    here = placed_on(there, "cpu")
    assert here.changes == {"model.texels": 128} and (there.device, here.device) == ("cuda", "cpu")
    assert here.key != there.key == placed_on(there, "cuda").key
    assert placed_on(here, "cuda:1").changes == {"device": "cuda:1", "model.texels": 128}


def test_what_has_no_device_or_is_not_ours_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.use(tmp_path / "plugins", monkeypatch)
    for method in ("nearest", "fake_good"):
        there = learned_on_cuda(method)
        assert placed_on(there, "cpu") is there


@without_cuda
def test_a_cell_that_learned_on_a_gpu_is_scored_here_where_the_cpu_is_named(
    tube_cells: dict[str, Path], tmp_path: Path, capsys
) -> None:
    learned = read_cell(tube_cells["ash"])
    there = replace(learned.config, changes=learned.config.changes | {"device": "cuda"})
    folder = Path(shutil.copytree(learned.folder, tmp_path / there.key))
    result = read_result(folder)
    write_config(replace(learned, config=there, folder=folder))
    write_result(folder, replace(result, config=there, drawn_on="cuda"))
    assert f"device cuda: {cuda_error()}" in refused_last(capsys, "eval", str(folder))
    assert read_result(folder).drawn_on == "cuda"
    assert cli.main(["eval", str(folder), "--device", "cpu"]) == cli.DONE
    again = read_result(folder)
    assert (again.drawn_on, again.config.device, result.drawn_on) == ("cpu", "cuda", "cpu")
    assert [view.prediction for view in again.views] == [view.prediction for view in result.views]


@without_cuda
def test_every_avatar_that_is_played_goes_to_the_device(tube_run: Path) -> None:
    with open_avatars(tube_run, device="cuda") as avatars:
        assert len(avatars.titles) == 2
        for title in avatars.titles:
            with pytest.raises(InputError, match=r"^device cuda: "):
                avatars[title]


def test_a_report_says_which_milliseconds_are_those_of_a_gpu() -> None:
    results = [replace(cell(method, 30.0), drawn_on=device) for method, device in (("ash", "cuda"), ("ddc", "cpu"))]
    assert doubts(results) == ("ASH: drawn on cuda, so that milliseconds are not those of one core.",)


def test_times_of_a_gpu_are_not_called_those_of_one_core_and_do_not_compete_with_them() -> None:
    results = people({"ash": (25.0, 27.0), "ddc": (24.0, 26.0), "ash_plus": (23.0, 25.0)})
    trained = Summary(split="speed", region="", metric="train_s", value=90.0)
    early = {
        m: Snapshot(seconds=30, split="novel_view", psnr=level)
        for m, level in (("ash_plus", 20.0), ("ddc", 21.0), ("ash", 22.0))
    }
    results = [
        replace(result, summary=(*result.summary, trained), snapshots=(early[result.config.method],))
        for result in results
    ]
    on_gpu = {"changes": {"device": "cuda"}}
    mixed = [
        replace(each, config=replace(each.config, **on_gpu), drawn_on="cuda") if each.config.method == "ash" else each
        for each in results
    ]
    tables = RunTables(mixed)
    lines = dict(facts(tables, "loose"))
    assert lines["Time"] == (
        "A training took 90 s on cuda, 90 s on one core."
        " A frame takes ASH 12 ms on cuda; DDC 12 ms, ASH+ 12 ms on one core."
    )
    assert [each.name for each in candidates(tables, "loose", "novel_view")] == ["ddc", "ash_plus"]
    assert alike(("ash", "ddc", "ash_plus"), tables.trained_on) == ("ddc", "ash_plus")
    assert alike(("ash",), tables.trained_on) == ("ash",)
    (section,) = training_cost(tables)
    leads = section.blocks[1].items
    assert leads and all("DDC is ahead of ASH+" in lead for lead in leads)
    figure = speed_figure(tables, "loose")
    assert figure is not None
    assert all("ASH: timed on cuda, not shown" in json.dumps(panel.to_dict()) for panel in figure.panels)
    alone = speed_figure(RunTables([each for each in mixed if each.drawn_on == "cuda"]), "loose")
    assert alone is not None and "ms per frame, cuda" in json.dumps(alone.panels[0].to_dict())
