"""Convolutions in bfloat16 on the processor's tiles: the network whose 3x3 convolutions see rounded factors."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from helpers.numerics import relative_error
from helpers.unets import network_and_inputs, value_and_gradients
from torch import Tensor, nn
from torch.autograd import Function

import ash.native.library
from ash.avatar import AshAvatar
from ash.decoders import ConvBlock, UNet, decoding_precision
from ash.native.library import has_tiles
from ash.presets import plus
from baselines.ddc import DdcAvatar, ddc_config

needs_tiles = pytest.mark.skipif(not has_tiles(), reason="this machine has no tiles (AMX)")
CPU = torch.device("cpu")

# No deeper: where a sum in float32 is rounded otherwise than in float64, the difference grows from layer to layer.
SHAPES = {  # inputs, outputs, width, levels, height, width of the texture, features
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


def in_tiles(net: UNet, texture: Tensor, features: Tensor | None) -> list[Tensor]:
    with torch.autocast("cpu", torch.bfloat16):
        assert net._can_use_native(texture)
        return value_and_gradients(net, texture, features, net)


@needs_tiles
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("channels_last", [True, False])
def test_convolutions_on_tiles_are_those_of_rounded_factors(shape, channels_last):
    net, texture, features = network_and_inputs(shape)
    exact = definition_of(net)
    doubles = texture.double(), None if features is None else features.double()
    truth = value_and_gradients(exact, *doubles, exact.forward_naive)
    if channels_last:
        net, texture = (x.to(memory_format=torch.channels_last) for x in (net, texture))
    found = in_tiles(net, texture, features)
    assert len(found) == len(truth)
    errors = [relative_error(a, b) for a, b in zip(found, truth, strict=True)]
    assert max(errors) < 1e-3
    plain = value_and_gradients(net, texture, features, net)
    assert relative_error(plain[1], truth[1]) > 10 * max(errors)  # Without rounding it is another network.


@needs_tiles
def test_threads_and_earlier_calls_change_no_bit_of_what_tiles_make():
    net, texture, features = network_and_inputs(SHAPES["as wide as trained"])
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(in_tiles(net, texture, features))
            value_and_gradients(net, 5 * texture, features, net)
            in_tiles(net, 5 * texture, features)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for result in results[1:] for a, b in zip(result, results[0], strict=True))


def test_where_there_are_no_tiles_decoders_learn_in_float32(monkeypatch):
    net, texture, _ = network_and_inputs(SHAPES["as wide as trained"])
    monkeypatch.setattr(ash.native.library, "has_tiles", lambda: False)
    assert decoding_precision("bfloat16", CPU, 16) == "float32"
    with torch.autocast("cpu", torch.bfloat16):
        assert not net._can_use_native(texture)
    monkeypatch.setattr(ash.native.library, "has_tiles", lambda: True)
    assert decoding_precision("bfloat16", CPU, 16) == "bfloat16"
    assert decoding_precision("float32", CPU, 16) == "float32"
    assert decoding_precision("bfloat16", CPU, 24) == "float32"
    assert decoding_precision("bfloat16", torch.device("cuda"), 24) == "bfloat16"


@pytest.mark.parametrize("method", ["ash", "ddc"])
def test_training_in_bfloat16_says_in_which_precision_it_was(method, capture, tmp_path):
    config = plus("ci")
    model = replace(config.model, texels=16, width=16, levels=2, window=2)
    training = replace(config.training, steps=6, warmup_steps=2, views_per_step=1, precision="bfloat16")
    config = replace(config, model=model, training=training)
    weights = []
    for number in range(2):
        made = ddc_config(config, seed=0, template=config.template) if method == "ddc" else config
        avatar = (DdcAvatar if method == "ddc" else AshAvatar).from_capture(made, capture)
        avatar.fit(capture, folder=tmp_path / str(number))
        assert avatar.outcome().precision == ("bfloat16" if has_tiles() else "float32")
        weights.append(torch.cat([p.detach().flatten() for p in avatar.module.parameters()]))
    assert torch.isfinite(weights[0]).all() and torch.equal(*weights)
