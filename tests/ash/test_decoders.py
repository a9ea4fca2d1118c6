"""Decoders, and their native kernels against the definition: in float32, and in bfloat16 on the processor's tiles."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from helpers.captures import tiny_plus
from helpers.figures import tube_mesh
from helpers.learning import tiny_mesh
from helpers.numerics import relative_error
from torch import Tensor, nn
from torch.autograd import Function

import ash.native.library
from ash.avatar import AshAvatar
from ash.config import ModelConfig
from ash.decoders import ConvBlock, Decoders, TexelRows, UNet, decoding_precision
from ash.native.library import has_tiles
from ash.rotations import RigidTransforms
from ash.textures import FrameInputs, build_lattice
from baselines.ddc import DdcAvatar


def config(**changes) -> ModelConfig:
    settings = {"texels": 16, "window": 2, "yaw_normalise": True, "width": 4, "levels": 2, "sh_degree": 1} | changes
    return ModelConfig(**settings)


needs_tiles = pytest.mark.skipif(not has_tiles(), reason="this machine has no tiles (AMX)")
LATTICE = build_lattice(tube_mesh(), 16)


def frame_inputs(textures: torch.Tensor) -> FrameInputs:
    nothing = torch.zeros(0, 3)
    return FrameInputs(
        textures=textures,
        motion=torch.zeros(2, 9),
        root_translation=torch.zeros(3),
        canonical=nothing,
        normals=nothing,
        transforms=RigidTransforms(quats=torch.zeros(0, 4), translations=nothing),
    )


def talking(**changes) -> Decoders:
    """Decoders whose heads say something."""
    decoders = Decoders(config(**changes), LATTICE)
    for net in decoders.nets:
        nn.init.normal_(net.head.weight, generator=torch.manual_seed(1))
    return decoders


def test_untrained_decoders_return_zero_so_that_training_starts_from_the_initial_gaussians():
    (decoded,) = Decoders(config(), LATTICE)([frame_inputs(torch.randn(12, 16, 16))])
    assert decoded.shape == (len(LATTICE.texels), 11 + 12)
    assert not decoded.any()


def test_official_width_has_the_published_number_of_parameters():
    """31.05 M and 31.15 M for E_geo and E_app of the release: 18 channels in, width 64, four levels."""
    geometry = UNet(18, 11, width=64, levels=4, norm="instance")
    appearance = UNet(18, 48, width=64, levels=4, norm="instance", bottleneck_features=16)
    count = lambda net: sum(p.numel() for p in net.parameters())  # noqa: E731
    assert abs(count(geometry) - 31.05e6) < 0.02e6
    assert abs(count(appearance) - 31.15e6) < 0.12e6


@pytest.mark.parametrize(
    "changes", [{}, {"shared_trunk": True}, {"shuffle": 2, "shared_trunk": True}, {"norm": "none"}]
)
def test_every_parameter_learns_once_the_heads_have_moved(changes):
    decoders, side = talking(**changes), 16 // changes.get("shuffle", 1)
    decoders([frame_inputs(torch.randn(12, side, side))]).square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in decoders.parameters())


def test_global_features_reach_appearance_alone():
    decoders = talking()
    here = frame_inputs(torch.randn(12, 16, 16))
    there = replace(here, root_translation=torch.tensor([1.0, 0.0, 2.0]))
    assert torch.equal(decoders([here])[..., :11], decoders([there])[..., :11])
    assert not torch.allclose(decoders([here])[..., 11:], decoders([there])[..., 11:])


def test_shuffled_decoding_puts_every_value_on_its_own_texel():
    """A texture decoded at half resolution holds the four texels of each pixel, row by row."""
    rows = TexelRows(LATTICE, 2)
    row, column = LATTICE.texels // 16, LATTICE.texels % 16
    decoded = torch.zeros(1, 4 * 2, 8, 8)  # of every texel its coordinates
    for sub in range(4):
        y, x = torch.meshgrid(2 * torch.arange(8) + sub // 2, 2 * torch.arange(8) + sub % 2, indexing="ij")
        decoded[0, 2 * sub], decoded[0, 2 * sub + 1] = y, x
    table = decoded.permute(0, 2, 3, 1).reshape(-1, 2)
    assert torch.equal(table[rows.rows], torch.stack([row, column], 1).float())


@pytest.mark.parametrize("norm", ["none", "instance"])
def test_features_reach_the_head_at_the_size_of_the_input(norm):
    """Decoders whose features have died away learn nothing but constants."""
    torch.manual_seed(0)
    net, seen = UNet(12, 5, width=8, levels=3, norm=norm), []
    net.head.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].detach()))
    net.forward_naive(torch.randn(1, 12, 32, 32))
    assert 0.2 < float(seen[0].std()) < 5 and float(seen[0].std(dim=(2, 3)).mean()) > 0.1


# --- the native kernels -----------------------------------------------------------------------------------------------

SHAPES = {  # inputs, outputs, width, levels, height, width of the texture, features
    "as trained": (18, 56, 16, 3, 64, 64, 16),
    "narrow": (6, 24, 8, 3, 16, 32, 0),
    "in Winograd's tiles above, without below": (6, 3, 16, 2, 8, 24, 0),
    "of no round number": (5, 3, 5, 1, 6, 10, 2),
    "one pixel at the bottom": (3, 17, 4, 2, 4, 4, 3),
}


def network_and_inputs(shape: tuple[int, ...]) -> tuple[UNet, Tensor, Tensor | None]:
    """A network whose head and biases say something, a texture, and features where it takes some."""
    inputs, outputs, width, levels, rows, columns, features = shape
    torch.manual_seed(0)
    net = UNet(inputs, outputs, width=width, levels=levels, norm="none", bottleneck_features=features)
    for parameter in (net.head.weight, *(p for p in net.parameters() if p.dim() == 1)):
        torch.nn.init.normal_(parameter)
    return net, torch.randn(1, inputs, rows, columns), torch.randn(features) if features else None


def value_and_gradients(
    net: UNet, texture: Tensor, features: Tensor | None, call: Callable[..., Tensor]
) -> list[Tensor]:
    """Of a random linear function of what `call` makes of the inputs."""
    leaves = list(net.parameters())
    if features is not None:
        features = features.clone().requires_grad_()
        leaves.append(features)
    value = call(texture, features)
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(1)).to(value)
    return [value.detach(), *torch.autograd.grad((value * weights).sum(), leaves)]


def in_tiles(net: UNet, texture: Tensor, features: Tensor | None, call: Callable[..., Tensor]) -> list[Tensor]:
    with torch.autocast("cpu", torch.bfloat16):
        assert net._can_use_native(texture)
        return value_and_gradients(net, texture, features, call)


def compare_with_the_definition(shape: tuple[int, ...], *, channels_last: bool) -> None:
    net, texture, features = network_and_inputs(shape)
    exact = deepcopy(net).double()
    doubles = texture.double(), None if features is None else features.double()
    truth = value_and_gradients(exact, *doubles, exact.forward_naive)
    if channels_last:
        net, texture = (x.to(memory_format=torch.channels_last) for x in (net, texture))
    assert net._can_use_native(texture)
    found = value_and_gradients(net, texture, features, net)
    assert max(relative_error(a, b) for a, b in zip(found, truth, strict=True)) < 2e-5  # Winograd's sums: 1e-5


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("channels_last", [True, False])
def test_the_native_network_is_its_definition(shape, channels_last, instructions):
    compare_with_the_definition(shape, channels_last=channels_last)


@pytest.mark.parametrize("shuffle", [1, 2, 4])
def test_texels_picked_by_the_native_network_are_those_of_the_definition(shuffle, instructions):
    side = 16 // shuffle
    net, texture, features = network_and_inputs((6, 7 * shuffle**2, 5, 2, side, side, 3))
    exact, rows = deepcopy(net).double(), TexelRows(LATTICE, shuffle)
    truth = value_and_gradients(exact, texture.double(), features.double(), lambda t, f: exact.picked(t, f, rows))
    found = value_and_gradients(net, texture, features, lambda t, f: net.picked(t, f, rows))
    assert net._can_use_native(texture) and not exact._can_use_native(texture.double())
    assert found[0].shape == (1, len(LATTICE.texels), 7)
    assert max(relative_error(a, b) for a, b in zip(found, truth, strict=True)) < 1e-5


@pytest.mark.parametrize("on_tiles", [False, pytest.param(True, marks=needs_tiles)])
def test_threads_and_earlier_calls_change_no_bit_of_the_native_network(on_tiles):
    net, texture, features = network_and_inputs(SHAPES["as trained"])
    other = network_and_inputs(SHAPES["narrow"])
    decode = in_tiles if on_tiles else value_and_gradients
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(decode(net, texture, features, net))
            value_and_gradients(*other, other[0])
            decode(net, 5 * texture, features, net)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for result in results[1:] for a, b in zip(result, results[0], strict=True))


def test_two_networks_of_one_shape_keep_their_own_activations():
    net, texture, features = network_and_inputs(SHAPES["narrow"])
    first, second = net(texture, features), net(2 * texture, features)
    alone = torch.autograd.grad(net(texture, features).sum(), net.first[0].weight)[0]
    second.sum().backward()
    net.zero_grad()
    first.sum().backward()
    assert torch.equal(net.first[0].weight.grad, alone)


def test_what_the_kernels_do_not_know_goes_the_way_of_the_definition():
    net, texture, _ = network_and_inputs(SHAPES["narrow"])
    assert net._can_use_native(texture)
    assert not net._can_use_native(texture.double())
    assert not net._can_use_native(texture.clone().requires_grad_())
    assert not UNet(6, 4, width=8, levels=3, norm="instance")._can_use_native(texture)
    assert not UNet(6, 4, width=256, levels=3, norm="none")._can_use_native(texture)
    with torch.autocast("cpu", torch.bfloat16):
        assert not net._can_use_native(texture)


# --- convolutions in bfloat16 on tiles: the network whose 3x3 convolutions see rounded factors ------------------------

# No deeper: where a sum in float32 is rounded otherwise than in float64, the difference grows from layer to layer.
TILED = {  # inputs, outputs, width, levels, height, width of the texture, features
    "as wide as trained": (18, 56, 16, 1, 32, 64, 16),
    "wide and flat": (5, 17, 48, 1, 6, 10, 2),
    "one pixel at the bottom": (6, 24, 16, 2, 4, 4, 0),
}


def rounded(tensor: Tensor) -> Tensor:
    return tensor.to(torch.bfloat16).to(tensor)


class _RoundedConvolution(Function):
    """The definition: every factor of a product is rounded, forward and backward; sums are not."""

    @staticmethod
    def forward(ctx, x, weight):
        x, weight = rounded(x), rounded(weight)
        ctx.save_for_backward(x, weight)
        return nn.functional.conv2d(x, weight, padding=1)

    @staticmethod
    def backward(ctx, grad):
        x, weight = ctx.saved_tensors
        of_weight = nn.grad.conv2d_weight(x, weight.shape, rounded(grad), padding=1)
        return nn.functional.conv_transpose2d(rounded(grad), weight, padding=1), of_weight


class Rounded(nn.Module):
    def __init__(self, exact: nn.Conv2d) -> None:
        super().__init__()
        self.exact = exact

    def forward(self, x: Tensor) -> Tensor:
        return _RoundedConvolution.apply(x, self.exact.weight) + self.exact.bias[:, None, None]


def definition_of(net: UNet) -> UNet:
    exact = deepcopy(net).double()
    for block in [module for module in exact.modules() if isinstance(module, ConvBlock)]:
        for index, layer in enumerate(block):
            if isinstance(layer, nn.Conv2d):
                block[index] = Rounded(layer)
    return exact


@needs_tiles
@pytest.mark.parametrize("shape", TILED.values(), ids=TILED)
@pytest.mark.parametrize("channels_last", [True, False])
def test_convolutions_on_tiles_are_those_of_rounded_factors(shape, channels_last):
    net, texture, features = network_and_inputs(shape)
    exact = definition_of(net)
    doubles = texture.double(), None if features is None else features.double()
    truth = value_and_gradients(exact, *doubles, exact.forward_naive)
    if channels_last:
        net, texture = (x.to(memory_format=torch.channels_last) for x in (net, texture))
    found = in_tiles(net, texture, features, net)
    errors = [relative_error(a, b) for a, b in zip(found, truth, strict=True)]
    assert max(errors) < 1e-3
    plain = value_and_gradients(net, texture, features, net)
    assert relative_error(plain[1], truth[1]) > 10 * max(errors)  # Without rounding it is another network.


def test_where_there_are_no_tiles_decoders_learn_in_float32(monkeypatch):
    net, texture, _ = network_and_inputs(TILED["as wide as trained"])
    monkeypatch.setattr(ash.native.library, "has_tiles", lambda: False)
    assert decoding_precision("bfloat16", torch.device("cpu"), 16) == "float32"
    with torch.autocast("cpu", torch.bfloat16):
        assert not net._can_use_native(texture)
    monkeypatch.setattr(ash.native.library, "has_tiles", lambda: True)
    assert decoding_precision("bfloat16", torch.device("cpu"), 16) == "bfloat16"
    assert decoding_precision("float32", torch.device("cpu"), 16) == "float32"
    assert decoding_precision("bfloat16", torch.device("cpu"), 24) == "float32"
    assert decoding_precision("bfloat16", torch.device("cuda"), 24) == "bfloat16"


@pytest.mark.parametrize("method", ["ash", "ddc"])
def test_training_in_bfloat16_says_in_which_precision_it_was(method, capture, tmp_path):
    tiny = tiny_mesh if method == "ddc" else tiny_plus
    config = tiny({"model.width": 16, "training.precision": "bfloat16"}, steps=6, warmup_steps=2)
    weights = []
    for number in range(2):
        avatar = (DdcAvatar if method == "ddc" else AshAvatar).from_capture(config, capture)
        avatar.fit(capture, folder=tmp_path / str(number))
        assert avatar.outcome().precision == ("bfloat16" if has_tiles() else "float32")
        weights.append(torch.cat([p.detach().flatten() for p in avatar.module.parameters()]))
    assert torch.isfinite(weights[0]).all() and torch.equal(*weights)
