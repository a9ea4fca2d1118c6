"""What a GPU runs, compiled once for all cells: a method gets a copy of it that it can spoil for nobody else."""

import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.cell.children import clean_environment

KERNELS = "kernels"  # In a cell's folder, while its method runs.


def runs_kernels(device: str) -> bool:
    """Whether a cell learns on one of Warp's devices; the CPU has kernels of its own."""
    return device != "cpu"


def copy_kernel_cache(device: str, place: Path) -> Path:
    """A fresh folder `KERNELS` in `place`; in it what the device runs, compiled now where it never was.

    It stays empty on the CPU, where nothing is run from it, and where the device cannot be used: the method says that.
    A process of its own compiles, so that this one takes no part of the GPU.
    """
    folder = place / KERNELS
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if runs_kernels(device):
        subprocess.run(
            [sys.executable, "-P", "-m", "ash.warp.compiling", device, str(folder)],
            env=clean_environment(),
            check=False,
        )
    return folder


def kernel_env(folder: Path) -> dict[str, str]:
    """The environment of a process whose Warp has its cache there."""
    return clean_environment() | {"WARP_CACHE_PATH": str(folder)}
