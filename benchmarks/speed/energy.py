"""Joules that are spent, where the machine tells: RAPL's counters of the processors, or NVML's of an NVIDIA GPU.

Both count what the whole part used, work of others and idling included, and tell of nothing else in the machine. RAPL's
counters (Linux, `powercap`) are root's alone on most machines.
"""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from ash.devices import CPU

POWERCAP = Path("/sys/class/powercap")
NVML = "libnvidia-ml.so.1"  # NVIDIA's driver brings it.


@runtime_checkable
class EnergyMeter(Protocol):
    """Something that counts joules."""

    def joules(self) -> float:
        """Spent since the meter was made."""
        ...


@dataclass(kw_only=True)
class Counter:
    """A file of microjoules that starts again from 0 at `range_uj`."""

    path: Path
    range_uj: int
    spent_uj: int = 0
    last_uj: int = field(init=False)

    def __post_init__(self) -> None:
        """Begin to count."""
        self.last_uj = int(self.path.read_text())

    def read(self) -> int:
        """Microjoules since the counter was made; it must be read before it has gone round twice."""
        now = int(self.path.read_text())
        self.spent_uj += (now - self.last_uj) % self.range_uj
        self.last_uj = now
        return self.spent_uj


@dataclass(frozen=True, kw_only=True)
class ProcessorMeter:
    """All packages of the machine."""

    counters: Sequence[Counter]

    def joules(self) -> float:
        """Spent since the meter was made."""
        return sum(counter.read() for counter in self.counters) * 1e-6


@dataclass(frozen=True, kw_only=True)
class GpuMeter:
    """One GPU, by NVML."""

    library: Any  # NVML, with the functions of C
    handle: ctypes.c_void_p
    start_mj: int

    def joules(self) -> float:
        """Spent since the meter was made."""
        return (_millijoules(self.library, self.handle) - self.start_mj) * 1e-3


def energy_meter(device: torch.device, powercap: Path = POWERCAP) -> EnergyMeter | None:
    """The meter of a device; None where it tells nobody, or not us."""
    return _processor_meter(powercap) if device == CPU else _gpu_meter(device)


def _processor_meter(powercap: Path) -> ProcessorMeter | None:
    try:
        counters = [
            Counter(path=zone / "energy_uj", range_uj=int((zone / "max_energy_range_uj").read_text()))
            for zone in sorted(powercap.glob("intel-rapl:*"))
            if zone.name.count(":") == 1  # A part of a package is in the package's count.
        ]
    except OSError:
        return None
    return ProcessorMeter(counters=counters) if counters else None


def _gpu_meter(device: torch.device) -> GpuMeter | None:
    try:
        library = ctypes.CDLL(NVML)
    except OSError:
        return None
    return nvml_meter(library, f"GPU-{torch.cuda.get_device_properties(device).uuid}")


def nvml_meter(library: Any, uuid: str) -> GpuMeter | None:
    """The meter of the GPU of a UUID; None where NVML does not know it, or it counts nothing (before Volta)."""
    handle = ctypes.c_void_p()
    try:
        _done(library.nvmlInit_v2())
        _done(library.nvmlDeviceGetHandleByUUID(uuid.encode(), ctypes.byref(handle)))
        return GpuMeter(library=library, handle=handle, start_mj=_millijoules(library, handle))
    except OSError:
        return None


def _millijoules(library: Any, handle: ctypes.c_void_p) -> int:
    """What the GPU has spent since its driver was loaded."""
    found = ctypes.c_ulonglong()
    _done(library.nvmlDeviceGetTotalEnergyConsumption(handle, ctypes.byref(found)))
    return found.value


def _done(code: int) -> None:
    if code:
        raise OSError(f"NVML returned error {code}")
