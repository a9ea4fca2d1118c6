"""Finds and loads the shared library of native kernels; ctypes releases the GIL during every call."""

import ctypes
import os
import sys
import sysconfig
from collections.abc import Iterator
from ctypes import POINTER, c_char_p, c_double, c_float, c_int, c_int64, c_void_p
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from ash.files import InputError

ABI_VERSION = 8  # of ash/native/dispatch.cpp
LIBRARY_NAME = "libash_native" + (".dylib" if sys.platform == "darwin" else ".so")

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h; the latter takes 32 MiB at most

_P = c_void_p  # the address of a tensor's numbers
_GAUSSIANS = [_P] * 7 + [c_int64] + [c_int] * 5 + [c_float] * 2 + [c_int]
_SHADE = [_P, c_int, c_int, _P, _P, _P, c_int64, _P, _P, _P, _P]
_SIGNATURES: dict[str, tuple[type | None, list[type]]] = {
    "ash_abi_version": (c_int, []),
    "ash_use_team": (None, [_P]),
    "ash_has_tiles": (c_int, []),
    "ash_instruction_set": (c_char_p, []),
    "ash_use_instruction_set": (c_int, [c_char_p]),
    "ash_fma_peak": (c_double, [c_int]),
    "ash_project": (c_int64, [*_GAUSSIANS, _P, _P, _P]),
    "ash_project_backward": (c_int, [*_GAUSSIANS, *[_P] * 9]),
    "ash_blend": (_P, [_P, _P, _P, c_int64, c_int, c_int, c_int, POINTER(c_float), c_int, _P, _P, _P]),
    "ash_blend_backward": (c_int, [_P, _P, _P, _P, _P, _P, _P, c_int, _P, _P]),
    "ash_release": (None, [_P]),
    "ash_stage_seconds": (None, [POINTER(c_double)]),
    "ash_l1_ssim": (c_int, [_P] * 3 + [c_int] * 4 + [c_float] * 2 + [c_int, _P, POINTER(c_double)]),
    "ash_adam": (c_int, [c_int, *[POINTER(_P)] * 5, POINTER(c_int64), *[c_double] * 4, c_int]),
    "ash_shade": (None, [*_SHADE, c_int, _P]),
    "ash_shade_backward": (None, [*_SHADE, _P, _P, POINTER(c_double), _P]),
    "ash_resolve": (None, [_P, _P, c_int64, c_int, c_int, c_int, _P, _P]),
    "ash_resolve_backward": (None, [_P, _P, c_int64, c_int, c_int, _P]),
    "ash_corner_weights": (None, [*[_P] * 4, c_int64, c_int, _P]),
    "ash_corner_weights_backward": (None, [*[_P] * 4, c_int64, c_int, c_int64, _P, _P]),
    "ash_shuffle": (None, [_P, _P, *[c_int] * 5, _P]),
    "ash_unet": (_P, [POINTER(c_int), _P, POINTER(c_int64), _P, POINTER(_P), _P, _P, c_int, c_int, _P]),
    "ash_unet_backward": (c_int, [_P, _P, POINTER(_P), POINTER(_P), _P, _P, c_int, _P, c_int]),
    "ash_unet_release": (None, [_P]),
    "ash_skin_vertices": (None, [_P, _P, _P, c_int64, c_int, c_int, _P, _P]),
    "ash_vertex_normals": (None, [_P, _P, c_int64, c_int64, _P]),
    "ash_place_texels": (None, [_P, _P, _P, c_int64, c_int, *[_P] * 4]),
    "ash_pose": (None, [*[_P] * 6, c_int64, c_int, c_float, c_int, c_int, *[_P] * 5]),
    "ash_pose_backward": (c_int, [*[_P] * 4, c_int64, c_int, c_float, c_int, c_int, *[_P] * 6, POINTER(c_double)]),
    "ash_turn_sh": (None, [*[_P] * 4, c_int64, c_int, c_int, c_int, _P]),
    "ash_rasterize": (c_int, [_P, _P, c_int64, c_int, c_int, c_double, c_int, _P, _P, _P]),
}


def _candidates() -> Iterator[Path]:
    """Where the library may be: named by the user, beside this file, installed (also when editable), built by hand."""
    named = os.environ.get("ASH_NATIVE_LIBRARY")
    if named:
        yield Path(named)
        return
    here = Path(__file__).resolve().parent
    yield here / LIBRARY_NAME
    for folder in (sysconfig.get_path("platlib"), sysconfig.get_path("purelib"), *sys.path):
        yield Path(folder) / "ash" / "native" / LIBRARY_NAME
    yield here.parents[1] / "build" / "native" / LIBRARY_NAME


@cache
def load() -> ctypes.CDLL:
    """The library, loaded once.

    Raises:
        RuntimeError: it is not there, or was built from other sources; says how to build it.
    """
    path = next((path for path in _candidates() if path.is_file()), None)
    if path is None:
        raise RuntimeError(
            f"{LIBRARY_NAME} not found: install the package (pip install .) or see ash/native/CMakeLists.txt"
        )
    library = ctypes.CDLL(str(path))
    library.ash_abi_version.restype = c_int
    if library.ash_abi_version() != ABI_VERSION:
        raise RuntimeError(
            f"{path} is version {library.ash_abi_version()}, expected {ABI_VERSION}: install the package again"
        )
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    library.ash_use_team(_parallel_of_torch())
    return library


def _parallel_of_torch() -> int | None:
    """The address of `GOMP_parallel` in the OpenMP runtime that torch has loaded; None where it uses another kind."""
    try:
        # A symbol is looked up in a library and in all that it depends on, under whatever name torch ships it.
        parallel = ctypes.CDLL(torch._C.__file__).GOMP_parallel
    except (OSError, AttributeError):
        return None
    return ctypes.cast(parallel, c_void_p).value


def use_team(*, of_torch: bool) -> None:
    """Whether calls on several threads use those of torch, as they do by default, or start their own."""
    load().ash_use_team(_parallel_of_torch() if of_torch else None)


def keep_freed_memory() -> bool:
    """Let the C library reuse freed memory for the next allocation; False: it is not glibc, and nothing changes.

    By default large arrays are returned to the system, and each new one costs page faults: 2,000 in a step of the mesh,
    a sixth of its time.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, 1 << 25) and mallopt(_M_TRIM_THRESHOLD, (1 << 31) - 1))


def address(tensor: Tensor | None) -> int | None:
    """The address of a contiguous CPU tensor's numbers; None stays None."""
    if tensor is None:
        return None
    assert tensor.is_contiguous() and tensor.device.type == "cpu"
    return tensor.data_ptr()


def check_memory(status: int) -> None:
    """Raise a MemoryError if a native function reports that memory is short."""
    if status:
        raise MemoryError("the native kernels could not allocate their working memory")


def instruction_set() -> str:
    """The instruction set in use: avx512, avx2 or plain."""
    return load().ash_instruction_set().decode()


def has_tiles() -> bool:
    """Whether this machine convolves in bfloat16 (AMX): much faster than in float32."""
    return bool(load().ash_has_tiles())


def use_instruction_set(name: str) -> bool:
    """Use avx512, avx2 or plain from now on; False, and no change, if this machine cannot."""
    return load().ash_use_instruction_set(name.encode()) == 0


STAGES = ("project", "list", "blend", "blend_backward", "gather", "project_backward")


def stage_ms() -> dict[str, float]:
    """Milliseconds that each stage of the last splat and its backward pass took."""
    seconds = (c_double * len(STAGES))()
    load().ash_stage_seconds(seconds)
    return {stage: 1e3 * second for stage, second in zip(STAGES, seconds, strict=True)}


def fma_peak(threads: int) -> float:
    """Floating point operations per second of fused multiply-adds alone, measured now on `threads` threads."""
    return load().ash_fma_peak(threads)


def float32_on_cpu(name: str, tensor: Tensor) -> Tensor:
    """The tensor, contiguous, or a ValueError that names it unless it is float32 on the CPU."""
    if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
        raise InputError(f"{name}: expected float32 on the CPU, got {tensor.dtype} on {tensor.device}")
    return tensor.contiguous()
