from dataclasses import replace

import torch
from figures import tube_mesh

from ash.config import ModelConfig
from ash.decoders import Decoders, UNet
from ash.skinning import RigidTransforms
from ash.textures import Conditions, build_lattice


def config(**changes) -> ModelConfig:
    settings = {"texels": 16, "window": 2, "yaw_normalise": True, "width": 4, "levels": 2, "sh_degree": 1} | changes
    return ModelConfig(**settings)


LATTICE = build_lattice(tube_mesh(), 16)


def conditions(textures: torch.Tensor) -> Conditions:
    nothing = torch.zeros(0, 3)
    return Conditions(
        textures=textures,
        motion=torch.zeros(2, 9),
        root_translation=torch.zeros(3),
        canonical=nothing,
        normals=nothing,
        transforms=RigidTransforms(quats=torch.zeros(0, 4), translations=nothing),
    )


def test_untrained_decoders_return_zero_so_that_training_starts_from_the_initial_gaussians():
    decoded = Decoders(config(), LATTICE)(conditions(torch.randn(12, 16, 16)))
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
        decoders(conditions(textures)).square().sum().backward()
        assert all(p.grad is not None and p.grad.any() for p in decoders.parameters()), changes


def test_global_features_reach_appearance_alone():
    decoders = Decoders(config(), LATTICE)
    for net in decoders.nets:
        torch.nn.init.normal_(net.head.weight)
    here = conditions(torch.randn(12, 16, 16))
    there = replace(here, root_translation=torch.tensor([1.0, 0.0, 2.0]))
    assert torch.equal(decoders(here)[:, :11], decoders(there)[:, :11])
    assert not torch.allclose(decoders(here)[:, 11:], decoders(there)[:, 11:])


def test_shuffled_decoding_puts_every_value_on_its_own_texel():
    """A texture decoded at half resolution holds the four texels of each pixel, row by row."""
    decoders = Decoders(config(shuffle=2, shared_trunk=True, global_features=False), LATTICE)
    outputs = decoders.outputs[0]
    row, column = LATTICE.texels // 16, LATTICE.texels % 16
    coordinates = torch.stack([row, column], 1).float()
    decoded = torch.zeros(1, 4 * outputs, 8, 8)
    for sub in range(4):
        y, x = torch.meshgrid(2 * torch.arange(8) + sub // 2, 2 * torch.arange(8) + sub % 2, indexing="ij")
        decoded[0, sub * outputs], decoded[0, sub * outputs + 1] = y, x
    assert torch.equal(decoders._texels_of(decoded, outputs)[:, :2], coordinates)


def test_features_reach_the_head_at_the_size_of_the_input():
    """Decoders whose features have died away learn nothing but constants."""
    torch.manual_seed(0)
    for norm in ("none", "instance"):
        net = UNet(12, 5, width=8, levels=3, norm=norm)
        seen = []
        net.head.register_forward_pre_hook(lambda _, inputs, seen=seen: seen.append(inputs[0]))
        net(torch.randn(1, 12, 32, 32))
        assert 0.2 < float(seen[0].detach().std()) < 5, norm
        assert float(seen[0].detach().std(dim=(2, 3)).mean()) > 0.1, norm
