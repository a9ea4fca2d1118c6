"""What is compiled ahead is all that there is: a process that finds the copy compiles nothing."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import warp as wp

import ash.warp
from ash.warp.compiling import MODULES, copy_compiled, main

TESTS = Path(__file__).parents[2]
LEARNS = """
import torch
from helpers.numerics import random_scene, splat_warp, values_and_gradients
values_and_gradients(splat_warp, random_scene(cameras=2), torch.float32)
"""


def test_a_splatter_that_finds_the_copy_compiles_nothing(tmp_path: Path) -> None:
    copy_compiled(torch.device("cpu"), tmp_path)
    before = _files(tmp_path)
    env = os.environ | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": str(TESTS)}
    subprocess.run([sys.executable, "-c", LEARNS], env=env, check=True)
    assert _files(tmp_path) == before


def test_no_kernel_is_left_out() -> None:
    holding = {path.stem for path in Path(ash.warp.__path__[0]).glob("*.py") if "\n@wp.kernel" in path.read_text()}
    assert {module.__name__ for module in MODULES} == {f"ash.warp.{name}" for name in holding}


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_the_kernels_compile_for_a_gpu(module: ModuleType, tmp_path: Path) -> None:
    """NVRTC comes with Warp and needs neither a driver nor a GPU; PTX for 7.5 runs on every later one."""
    (made,) = wp.compile_aot_module(module, arch=75, use_ptx=True, module_dir=tmp_path)
    assert ".target sm_75" in made.read_text()


def test_the_command_fills_a_folder(tmp_path: Path) -> None:
    assert main(["cpu", str(tmp_path)]) == 0
    assert len(list(tmp_path.glob("*/wp_ash.warp.*"))) == len(MODULES)


def _files(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
