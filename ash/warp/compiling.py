"""All kernels compiled ahead, for a process that does not see Warp's cache.

`python -m ash.warp.compiling DEVICE FOLDER` does it.
"""

import shutil
import sys
from pathlib import Path

import torch
import warp as wp

from ash.files import file_lock
from ash.warp import blending, projecting, projecting_back, rasterizing
from ash.warp.arrays import BLOCK, runs_on

MODULES = (blending, projecting, projecting_back, rasterizing)


def copy_compiled(device: torch.device, target: Path) -> None:
    """Put the kernels for a device into an empty folder, which `WARP_CACHE_PATH` can name in another process.

    What Warp's own cache lacks is compiled into it first; of several processes one compiles, and the others wait.
    """
    cache, where = Path(str(wp.config.kernel_cache_dir)), wp.device_from_torch(device)
    with file_lock(cache / "ash_bench"):
        for module in MODULES:
            wp.load_module(module, device=where, block_dim=BLOCK)
    for module in MODULES:
        name = wp.get_module(module.__name__).get_module_identifier(block_dim=1 if where.is_cpu else BLOCK)
        shutil.copytree(cache / name, target / wp.config.version / name)


def main(argv: list[str]) -> int:
    """Copy the compiled kernels; 2 where Warp has no such device."""
    device = torch.device(argv[0])
    if device.type == "cuda":  # Warp wants a number.
        device = torch.device("cuda", device.index or 0)
    if device.type != "cpu" and not runs_on(device):
        print(f"device {device}: no kernels are compiled, Warp {wp.config.version} cannot use it", file=sys.stderr)
        return 2
    copy_compiled(device, Path(argv[1]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
