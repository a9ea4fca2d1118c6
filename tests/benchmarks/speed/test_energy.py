"""Joules: what RAPL's and NVML's counters say, on files and a library of our own, and where it goes."""

import math
from pathlib import Path

import pytest
import torch
from helpers.captures import write_tube_capture

from ash.files import read_json
from ash.presets import named
from benchmarks.speed import energy, frames
from benchmarks.speed.frames import TimedAvatar

CPU = torch.device("cpu")


def write_zone(folder: Path, energy_uj: int, range_uj: int = 1_000_000_000) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "energy_uj").write_text(f"{energy_uj}\n")
    (folder / "max_energy_range_uj").write_text(f"{range_uj}\n")


def test_the_packages_of_a_machine_are_added_up_and_their_parts_are_not(tmp_path):
    write_zone(tmp_path / "intel-rapl:0", 5_000_000)
    write_zone(tmp_path / "intel-rapl:1", 7_000_000)
    write_zone(tmp_path / "intel-rapl:0:0", 1_000_000)
    meter = energy.energy_meter(CPU, tmp_path)
    assert meter is not None and meter.joules() == 0
    write_zone(tmp_path / "intel-rapl:0", 6_500_000)
    write_zone(tmp_path / "intel-rapl:1", 7_250_000)
    write_zone(tmp_path / "intel-rapl:0:0", 2_000_000)
    assert meter.joules() == pytest.approx(1.75)
    assert meter.joules() == pytest.approx(1.75)


def test_a_counter_that_starts_again_goes_on(tmp_path):
    write_zone(tmp_path / "intel-rapl:0", 999_999_000)
    meter = energy.energy_meter(CPU, tmp_path)
    assert meter is not None
    for value, joules in ((500, 0.0015), (999_999_500, 1000.0005), (1000, 1000.002)):
        write_zone(tmp_path / "intel-rapl:0", value)
        assert meter.joules() == pytest.approx(joules, abs=1e-9)


def test_a_machine_that_tells_nobody_has_no_meter(tmp_path, monkeypatch):
    assert energy.energy_meter(CPU, tmp_path / "absent") is None
    write_zone(tmp_path / "intel-rapl:0", 1)

    def refuse(path: Path, *args: object) -> str:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "read_text", refuse)
    assert energy.energy_meter(CPU, tmp_path) is None, "root's alone, on most machines"


class Nvml:
    """NVML with one GPU, by the C functions that are used of it."""

    def __init__(self, *, counts: bool = True) -> None:
        self.millijoules, self.code = 5_000, 0 if counts else 3

    def nvmlInit_v2(self) -> int:
        return 0

    def nvmlDeviceGetHandleByUUID(self, uuid: bytes, handle: object) -> int:
        return 0 if uuid == b"GPU-1" else 6

    def nvmlDeviceGetTotalEnergyConsumption(self, handle: object, found: object) -> int:
        found._obj.value = self.millijoules  # type: ignore[attr-defined]  # what `ctypes.byref` points to
        return self.code


def test_a_gpu_counts_millijoules_from_when_its_meter_was_made():
    library = Nvml()
    meter = energy.nvml_meter(library, "GPU-1")
    assert meter is not None and meter.joules() == 0
    library.millijoules += 2_500
    assert meter.joules() == pytest.approx(2.5)


def test_a_gpu_that_nvml_does_not_know_or_that_does_not_count_has_no_meter():
    assert energy.nvml_meter(Nvml(), "GPU-2") is None
    assert energy.nvml_meter(Nvml(counts=False), "GPU-1") is None


class Steady:
    """A meter that has counted two joules more whenever it is asked."""

    def __init__(self) -> None:
        self.spent = 0.0

    def joules(self) -> float:
        self.spent += 2.0
        return self.spent


@pytest.mark.parametrize("meter", [Steady(), None])
def test_frames_have_joules_where_there_is_a_meter_and_null_elsewhere(meter, tmp_path, monkeypatch, capsys):
    capture = write_tube_capture(tmp_path / "capture")
    monkeypatch.setattr(frames, "energy_meter", lambda device: meter)
    subject = TimedAvatar(name="ci", config=named("ci"), width=48, height=48)
    results = frames.speed_frame(capture, timed=(subject,), rounds=2, threads=(1,))
    frames.print_table(results, tmp_path / "rows.json", CPU)
    rows = read_json(tmp_path / "rows.json")["rows"]
    joules = {(row["what"], row["candidate"]): row["joules"] for row in rows}
    assert joules.pop(("frame", "ci")) == (2.0 if meter else None)
    assert set(joules.values()) == {None}, "stages are too short for the counters, and the definitions are drawn once"
    assert math.isfinite(rows[0]["min_ms"])
    line = next(line for line in capsys.readouterr().out.splitlines() if " ci " in line and line.startswith("frame"))
    assert line.endswith("2.000" if meter else "n/a")
