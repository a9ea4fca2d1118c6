"""LPIPS with AlexNet (Zhang et al. 2018): the user's backbone weights, the heads of the `lpips` package's files.

Neither `torchvision` nor `lpips` is imported: beside a CPU build of torch the former does not import, and so the latter
neither. Without the backbone's weights there is no LPIPS, and no stand-in under its name.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.files import InputError, open_regular

LARGEST = 1 << 30  # bytes of a file of weights
TAPS = (1, 4, 7, 9, 11)  # The layers of AlexNet whose activations are compared: after each ReLU.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)


class Lpips:
    """Distance of two images, computed on a device, or on the CPU where that is not there; small is alike."""

    def __init__(self, backbone: Path, device: str = "cpu") -> None:
        self.device = _there(device)
        self.trunk = _trunk(_load(backbone), backbone).to(self.device)
        tensors = _load(_heads_file())
        try:
            self.heads = [tensors[f"lin{i}.model.1.weight"].to(self.device) for i in range(len(TAPS))]
        except KeyError as error:
            raise InputError(f"{_heads_file()}: expected the heads of LPIPS, which has no {error}") from error

    def __call__(self, predicted: np.ndarray, truth: np.ndarray) -> float:
        """LPIPS x 1000 of uint8 images `[h, w, 3]`, whole frame."""
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
