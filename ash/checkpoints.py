"""Checkpoints of modules: safetensors, never pickle."""

from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from ash.files import InputError

OLD_NAMES = {  # in checkpoints of version 0.2
    "base": "base_texels",
    "texture": "base_texture",
}


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file, or an InputError that names it."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, safetensors.SafetensorError) as error:
        raise InputError(f"{path}: expected a safetensors checkpoint ({error})") from error


def contiguous_state(module: torch.nn.Module) -> dict[str, Tensor]:
    """A module's state as safetensors takes it."""
    return {name: tensor.contiguous() for name, tensor in module.state_dict().items()}


def load_module(module: torch.nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load parameters and check that they fit and are finite."""
    if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"{path}: holds NaN or infinity")
    names = module.state_dict().keys()  # Of other modules, an old name may be the name in use.
    tensors = {name if name in names else OLD_NAMES.get(name, name): tensor for name, tensor in tensors.items()}
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path}: was written by another configuration ({error})") from error
