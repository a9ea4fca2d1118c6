"""The flag `--device`: what is refused, what `auto` takes, and that the device is part of a cell's identity."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.commands import refused

import ash.devices
from ash.devices import obstacle
from ash.files import InputError
from benchmarks.cell.cells import CellConfig
from benchmarks.cell.process import _on_the_processor
from benchmarks.provenance import gpu_name
from benchmarks.suites.files import find_suite
from benchmarks.verbs import doctor
from benchmarks.verbs.devices import chosen_device, on_device

without_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")


@without_cuda
@pytest.mark.parametrize("verb", [("run", "ci"), ("train", "ash", "a-folder")])
def test_a_gpu_that_is_not_there_is_one_line_and_exit_code_2(verb: tuple[str, ...], capsys) -> None:
    assert refused(capsys, *verb, "--device", "cuda").endswith(f"device cuda: {obstacle()}")
    assert "expected cpu, cuda or cuda:N, got 'gpu'" in refused(capsys, *verb, "--device", "gpu")


def test_auto_takes_cuda_where_it_works_and_says_why_where_not(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(ash.devices, "obstacle", lambda name="cuda": "")
    assert chosen_device("auto") == "cuda" and capsys.readouterr().err == ""
    monkeypatch.setattr(ash.devices, "obstacle", lambda name="cuda": "it is asleep")
    assert chosen_device("auto") == "cpu" and capsys.readouterr().err == "device: cpu, because it is asleep\n"
    with pytest.raises(InputError, match=re.escape("device cuda:1: it is asleep")):
        chosen_device("cuda:1")


def test_rows_that_have_a_device_are_moved_and_others_stay() -> None:
    suite = find_suite("table")
    moved = on_device(suite, "cuda:1")
    devices = {row.name: dict(row.changes).get("device") for row in moved.methods}
    assert devices["ash"] == devices["ddc"] == devices["mlp"] == devices["oracle_texture"] == "cuda:1"
    assert devices["nearest"] is None
    assert [row.name for row in moved.methods] == [row.name for row in suite.methods]
    assert on_device(suite, "cpu") is suite
    there, here = ({cell.method: cell.changes for cell in each.cells} for each in (moved, suite))
    assert there["ash"] != here["ash"] and there["nearest"] == here["nearest"]


def test_doctor_says_what_the_gpu_can_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor.provenance, "gpu_name", lambda: "a GPU")
    monkeypatch.setattr(ash.devices, "obstacle", lambda name="cuda": "torch is built without CUDA")
    finding = doctor._gpu()
    assert finding.found == "a GPU, but torch is built without CUDA" and "processor" in finding.consequence
    monkeypatch.setattr(ash.devices, "obstacle", lambda name="cuda": "")
    assert "not measured: no GPU was at hand" in doctor._gpu().consequence
    monkeypatch.setattr(doctor.provenance, "gpu_name", gpu_name)
    if gpu_name() is None:
        assert doctor._gpu().found == "none"


def test_an_avatar_is_looked_at_without_a_gpu() -> None:
    config = CellConfig(
        scene="still",
        size="ci",
        capture_seed=0,
        capture="0" * 64,
        method="ash",
        preset="ci",
        seed=0,
        code="0",
        changes={"device": "cuda", "model.texels": 128},
    )
    here = _on_the_processor(config)
    assert here.changes == {"model.texels": 128}
    assert here.key != config.key == replace(config).key
