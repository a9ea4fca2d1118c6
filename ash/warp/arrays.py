"""Between torch and Warp: tensors as arrays, launches on torch's own stream, and whether a device can be used."""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # Neither its greeting nor what it compiles is part of our output.
wp.init()


def array(tensor: Tensor, dtype: type) -> Any:
    """A contiguous tensor as a flat Warp array of `dtype`, whose components are its last axes; nothing is copied."""
    assert tensor.is_contiguous()
    return wp.from_torch(tensor.detach().reshape(-1, *getattr(dtype, "_shape_", ())), dtype=dtype, return_ctype=True)


def launch(kernel: Any, count: int, arguments: Sequence[Any], device: torch.device) -> None:
    """Run `count` threads of a kernel on the device, behind what torch has queued there; none where it is 0."""
    if count == 0:
        return
    where = wp.device_from_torch(device)
    stream = wp.stream_from_torch(device) if device.type == "cuda" else None
    wp.launch(kernel, dim=count, inputs=list(arguments), device=where, stream=stream, record_tape=False)
