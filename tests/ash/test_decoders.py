from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from helpers.figures import tube_mesh
from helpers.numerics import relative_error
from helpers.unets import network_and_inputs, value_and_gradients

from ash.config import ModelConfig
from ash.decoders import Decoders, TexelRows, UNet
from ash.native.unet import _UNet
from ash.rotations import RigidTransforms
from ash.textures import FrameInputs, build_lattice


def config(**changes) -> ModelConfig:
    settings = {"texels": 16, "window": 2, "yaw_normalise": True, "width": 4, "levels": 2, "sh_degree": 1} | changes
    return ModelConfig(**settings)


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


def test_every_parameter_learns_once_the_heads_have_moved():
    for changes in ({}, {"shared_trunk": True}, {"shuffle": 2, "shared_trunk": True}, {"norm": "none"}):
        decoders = Decoders(config(**changes), LATTICE)
        for net in decoders.nets:
            torch.nn.init.normal_(net.head.weight)
        side = 16 // changes.get("shuffle", 1)
        textures = torch.randn(12, side, side)
        decoders([frame_inputs(textures)]).square().sum().backward()
        assert all(p.grad is not None and p.grad.any() for p in decoders.parameters()), changes


def test_global_features_reach_appearance_alone():
    decoders = Decoders(config(), LATTICE)
    for net in decoders.nets:
        torch.nn.init.normal_(net.head.weight)
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


def test_features_reach_the_head_at_the_size_of_the_input():
    """Decoders whose features have died away learn nothing but constants."""
    torch.manual_seed(0)
    for norm in ("none", "instance"):
        net = UNet(12, 5, width=8, levels=3, norm=norm)
        seen = []
        net.head.register_forward_pre_hook(lambda _, inputs, seen=seen: seen.append(inputs[0]))
        net.forward_naive(torch.randn(1, 12, 32, 32))
        assert 0.2 < float(seen[0].detach().std()) < 5, norm
        assert float(seen[0].detach().std(dim=(2, 3)).mean()) > 0.1, norm


SHAPES = {  # inputs, outputs, width, levels, height, width of the texture, features
    "as trained": (18, 56, 16, 3, 64, 64, 16),
    "narrow": (6, 24, 8, 3, 16, 32, 0),
    "of no round number": (5, 3, 5, 1, 6, 10, 2),
    "one pixel at the bottom": (3, 17, 4, 2, 4, 4, 3),
}


def compare_with_the_definition(shape: tuple[int, ...], *, channels_last: bool) -> None:
    net, texture, features = network_and_inputs(shape)
    exact = deepcopy(net).double()
    truth = value_and_gradients(
        exact, texture.double(), None if features is None else features.double(), exact.forward_naive
    )
    if channels_last:
        net = net.to(memory_format=torch.channels_last)
        texture = texture.contiguous(memory_format=torch.channels_last)
    assert net._can_use_native(texture)
    found = value_and_gradients(net, texture, features, net)
    assert len(found) == len(truth)
    assert max(relative_error(a, b) for a, b in zip(found, truth, strict=True)) < 1e-5


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


@pytest.mark.parametrize("shared_trunk", [True, False])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])  # by native kernels, and as a batch of the definition
def test_frames_decoded_together_are_those_decoded_alone(shared_trunk, kind):
    decoders = Decoders(config(shared_trunk=shared_trunk, shuffle=2), LATTICE)
    for net in decoders.nets:
        torch.nn.init.normal_(net.head.weight, generator=torch.manual_seed(1))
    decoders = decoders.to(kind)
    numbers = torch.Generator().manual_seed(2)
    frames = [
        replace(
            frame_inputs(torch.randn(12, 8, 8, generator=numbers).to(kind)),
            root_translation=torch.randn(3, generator=numbers).to(kind),
        )
        for _ in range(3)
    ]
    together = decoders(frames)
    alone = torch.cat([decoders([frame]) for frame in frames])
    assert decoders.nets[0]._can_use_native(frames[0].textures[None]) == (kind == torch.float32)
    assert not torch.allclose(alone[0], alone[1])
    weights = torch.randn(alone.shape, generator=numbers).to(kind)
    found, expected = (
        torch.autograd.grad((raw * weights).sum(), list(decoders.parameters())) for raw in (together, alone)
    )
    for a, b in zip((together, *found), (alone, *expected), strict=True):
        assert relative_error(a, b) < (1e-5 if kind == torch.float32 else 1e-12)


def test_a_halved_gradient_of_one_layer_is_noticed(monkeypatch):
    honest = _UNet.backward

    def halved(ctx, grad):
        grads = list(honest(ctx, grad))
        grads[10] *= 0.5
        return tuple(grads)

    monkeypatch.setattr(_UNet, "backward", staticmethod(halved))
    with pytest.raises(AssertionError):
        compare_with_the_definition(SHAPES["narrow"], channels_last=True)


def test_threads_and_earlier_calls_change_no_bit_of_the_native_network():
    net, texture, features = network_and_inputs(SHAPES["as trained"])
    other = network_and_inputs(SHAPES["narrow"])
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(value_and_gradients(net, texture, features, net))
            value_and_gradients(*other, other[0])
            value_and_gradients(net, 5 * texture, features, net)
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
    assert not UNet(6, 4, width=64, levels=3, norm="none")._can_use_native(texture)
    with torch.autocast("cpu", torch.bfloat16):
        assert not net._can_use_native(texture)
