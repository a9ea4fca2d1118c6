"""Frames under a fake CUDA device: tensors say that they are on CUDA and hold nothing, and mixing devices raises.

Beside `test_devices.py`, where whole steps run on `meta`: here what asks `is_cuda` takes the way that a GPU takes.
What needs numbers is replaced, as there.
"""

from typing import Any

import pytest
import torch
from helpers.captures import write_tube_capture
from helpers.devices import tiny, without_numbers
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

import ash.avatar
import ash.model
import baselines.ddc
from ash import harmonics
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.devices import CPU, moved
from ash.gaussians import splatting
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted
from ash.native.splatting import Viewport
from ash.presets import PRESETS, named
from ash.protocol import StageClock
from baselines.ddc import ddc

CUDA = torch.device("cuda", 0)


class _FakeCuda(TorchFunctionMode):
    """Does what a build of torch without CUDA refuses even where nothing is computed: `to`, indexing and the like."""

    def __torch_function__(self, function: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        options = options or {}
        if function is Tensor.to and CUDA in (*arguments[1:], *options.values()):
            return _empty_like(arguments[0])
        try:
            return function(*arguments, **options)
        except RuntimeError as error:
            if "not linked with support for cuda" not in str(error):
                raise
        given = (arguments, options)
        devices = {each.device for each in tree_leaves(given) if isinstance(each, Tensor)}
        assert devices == {CUDA}, f"{function}: expected all on {CUDA}, got {devices}"
        shadows, named_shadows = tree_map(lambda each: _empty_like(each, "meta"), given)
        return tree_map(_empty_like, function(*shadows, **named_shadows))


def _empty_like(value: Any, device: torch.device | str = CUDA) -> Any:
    """A tensor of the same shape there; what is no tensor stays as it is."""
    if not isinstance(value, Tensor):
        return value
    if value.layout != torch.strided:  # Whoever multiplies by it is replaced.
        return torch.empty(value.shape, dtype=value.dtype, device=device)
    return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=device)


def _replace_parameters(module: nn.Module, fn: Any, recurse: bool = True) -> nn.Module:
    """`nn.Module._apply`, by new parameters: fake tensors cannot take the place of real ones."""
    for child in module.children():
        child._apply(fn)
    for name, parameter in module._parameters.items():
        if parameter is not None:
            module._parameters[name] = nn.Parameter(fn(parameter.detach()), parameter.requires_grad)
    for name, buffer in module._buffers.items():
        if buffer is not None:
            module._buffers[name] = fn(buffer)
    return module


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube"))


@pytest.fixture
def fake_cuda(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Both modes, for a `with`, and the Gaussians that reach the splatter of CUDA."""
    splatted: list[Gaussians] = []

    def splat_by_warp(gaussians: Gaussians, viewmats: Tensor, Ks: Tensor, view: Viewport, background: Any) -> Splatted:
        splatted.append(gaussians)
        image = gaussians.means.new_zeros(len(viewmats), view.height, view.width)
        centres = gaussians.means[None, :, :2]
        return Splatted(rgb=image[..., None].expand(-1, -1, -1, 3), alpha=image, depth=image, means2d=centres)

    for degree in range(4):
        harmonics._sampling(degree)  # Kept for the process, so made of numbers before anything is fake.
    without_numbers(monkeypatch)
    for module in (ash.avatar, baselines.ddc):  # Made on the CPU, then moved.
        monkeypatch.setattr(module, "device_named", lambda name: CPU)
    monkeypatch.setattr(ash.model, "splat", splatting.splat)
    monkeypatch.setattr(splatting, "check_cameras", lambda *_, **__: None)
    monkeypatch.setattr(splatting, "splat_by_warp", splat_by_warp)
    monkeypatch.setattr(nn.Module, "_apply", _replace_parameters)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    return FakeTensorMode(allow_non_fake_inputs=True), _FakeCuda(), splatted


def on_cuda(avatar: Any) -> Any:
    """The avatar's model, moved as a device moves it."""
    avatar.module.to(CUDA)
    avatar.device, avatar.template = CUDA, avatar.module.template
    return avatar.module


@pytest.mark.parametrize("preset", PRESETS)
def test_a_frame_of_ash_stays_on_cuda_and_goes_to_its_splatter(preset: str, tube: Capture, fake_cuda: Any) -> None:
    avatar = AshAvatar(tiny(named(preset)), tube)
    mode, to_cuda, splatted = fake_cuda
    with mode, to_cuda, torch.no_grad():
        drawn = on_cuda(avatar)(Pose(tube.motion, 3), tube.cameras["cam0"])
    assert drawn.rgb.device == CUDA and drawn.rgb.shape == (1, 48, 48, 3)
    assert len(splatted) == (1 if avatar.module.fallback_texels is None else 2), (
        "a static avatar has its share of the picture"
    )
    for gaussians in splatted:
        assert {tensor.device for tensor in (gaussians.means, gaussians.quats, gaussians.sh)} == {CUDA}
        assert len(gaussians.means) == len(avatar.lattice.texels)


@pytest.mark.parametrize("changes", [{}, {"refine": "motion"}], ids=["ddc", "moving"])
def test_a_frame_of_the_mesh_stays_on_cuda(changes: dict[str, str], tube: Capture, fake_cuda: Any) -> None:
    recipe = ddc.with_overrides(changes)
    avatar = recipe.build(tiny(recipe.config("ci")), tube)
    mode, to_cuda, _ = fake_cuda
    with mode, to_cuda, torch.no_grad():
        model = on_cuda(avatar)
        posed, texture = avatar.dress(Pose(tube.motion, 3), StageClock())
        drawn = model.draw(texture, posed, model.see(posed, [tube.cameras["cam0"]]), texture.new_zeros(3))
    assert drawn.device == texture.device == posed.vertices.device == CUDA
    assert drawn.shape == (1, 48, 48, 4)


def test_what_stays_behind_raises(tube: Capture, fake_cuda: Any) -> None:
    avatar = AshAvatar(tiny(named("ci")), tube)
    mode, to_cuda, _ = fake_cuda
    behind = avatar.lattice
    with mode, to_cuda, torch.no_grad():
        model = on_cuda(avatar)
        assert moved(behind, CUDA).corners.device == CUDA
        model.lattice = behind
        with pytest.raises(Exception, match=r"cuda:0.*cpu|cpu.*cuda:0"):
            model(Pose(tube.motion, 3), tube.cameras["cam0"])
