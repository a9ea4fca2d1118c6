"""Devices: by name, whether they can be used, and moving values to them.

Tensors carry their device, and a function with a fast version dispatches on it. What is learned starts on the CPU, so
that a start is the same for every device, and is then moved as a whole.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from ash.config import check_device
from ash.files import InputError

CPU = torch.device("cpu")
Moved = TypeVar("Moved")


def cuda_error(name: str = "cuda") -> str:
    """Why nothing can run on a CUDA device here, in one line; empty where it can."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no GPU that it can use"
    index, count = torch.device(name).index or 0, torch.cuda.device_count()
    if index >= count:
        return f"there are {count} GPUs, from cuda:0 to cuda:{count - 1}"
    import warp as wp  # It takes a second.

    from ash.warp import arrays

    return "" if arrays.runs_on(torch.device("cuda", index)) else f"Warp {wp.__version__} cannot use the GPU"


def device_named(name: str) -> torch.device:
    """The device of a configuration.

    Raises:
        InputError: no such device is there, or it cannot be used; says why.
    """
    check_device(name)
    if name != "cpu" and (why := cuda_error(name)):
        raise InputError(f"device {name}: {why}")
    return torch.device(name)


def describe_gpu(name: str = "cuda") -> str:
    """Memory, compute capability and bfloat16 of a CUDA device."""
    gpu = torch.cuda.get_device_properties(torch.device(name))
    half = "with" if torch.cuda.is_bf16_supported() else "without"
    return f"{gpu.total_memory / 2**30:.0f} GB, compute capability {gpu.major}.{gpu.minor}, {half} bfloat16"


def finish(device: torch.device) -> None:
    """Wait for what was queued on a GPU, so that a clock that is read next includes it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def moved(value: Moved, device: torch.device) -> Moved:
    """The value with its tensors on a device: a tensor, whatever has `to`, or a dataclass, list or tuple of such."""
    result: Any = value
    if isinstance(value, type) or result is None:
        return value
    if hasattr(value, "to"):
        result = result.to(device)
    elif is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        there = {name: moved(part, device) for name, part in parts.items()}
        if any(there[name] is not part for name, part in parts.items()):
            result = replace(result, **there)
    elif isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        result = type(value)(moved(part, device) for part in value)
    return result  # type: ignore[no-any-return]


class MovingModule(nn.Module):
    """A module whose plain attributes move with it."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "MovingModule":
        super()._apply(fn, recurse)
        device = fn(torch.empty(0, device=CPU)).device
        for name, value in list(vars(self).items()):
            if not name.startswith("_") and name != "training":
                setattr(self, name, moved(value, device))
        return self
