"""Torch and Warp: tensors as arrays, launches on torch's own stream, and whether a device can be used."""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # Neither its greeting nor what it compiles is part of our output.
wp.init()


BLOCK = 256  # Threads that work together: those of a tile.


def array(tensor: Tensor, dtype: type) -> Any:
    """A contiguous tensor as a flat Warp array of `dtype`, whose components are its last axes.

    Nothing is copied, and the array does not keep the tensor: its caller does.
    """
    assert tensor.is_contiguous()
    return wp.from_torch(tensor.detach().reshape(-1, *getattr(dtype, "_shape_", ())), dtype=dtype, return_ctype=True)


def launch(kernel: Any, count: int, arguments: Sequence[Any], device: torch.device) -> None:
    """Run `count` threads of a kernel on the device, behind what torch has queued there; none where it is 0.

    On the processor Warp makes every thread a block of its own.
    """
    if count == 0:
        return
    where = wp.device_from_torch(device)
    stream = wp.stream_from_torch(device) if device.type == "cuda" else None
    wp.launch(
        kernel, dim=count, inputs=list(arguments), device=where, stream=stream, block_dim=BLOCK, record_tape=False
    )


def runs_on(device: torch.device) -> bool:
    """Whether Warp has the device too."""
    try:
        return bool(wp.device_from_torch(device).is_cuda)
    except (RuntimeError, ValueError, IndexError):
        return False
