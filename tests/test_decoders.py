import torch

from ash.config import ModelConfig
from ash.decoders import Decoders, UNet


def config(**changes) -> ModelConfig:
    settings = {"texels": 16, "window": 2, "yaw_normalise": True, "width": 4, "levels": 2, "sh_degree": 1} | changes
    return ModelConfig(**settings)


def test_untrained_decoders_return_zero_so_that_training_starts_from_the_initial_gaussians():
    decoded = Decoders(config())(torch.randn(12, 16, 16), torch.zeros(3))
    assert decoded.shape == (11 + 12, 16, 16)
    assert not decoded.any()


def test_official_width_has_the_published_number_of_parameters():
    """31.05 M and 31.15 M for E_geo and E_app of the release: 18 channels in, width 64, four levels."""
    geometry = UNet(18, 11, width=64, levels=4, norm="instance")
    appearance = UNet(18, 48, width=64, levels=4, norm="instance", bottleneck_features=16)
    count = lambda net: sum(p.numel() for p in net.parameters())  # noqa: E731
    assert abs(count(geometry) - 31.05e6) < 0.02e6
    assert abs(count(appearance) - 31.15e6) < 0.12e6


def test_every_parameter_learns_once_the_heads_have_moved():
    for changes in ({}, {"shared_trunk": True}, {"half_resolution": True, "shared_trunk": True}, {"norm": "none"}):
        decoders = Decoders(config(**changes))
        for net in decoders.nets:
            torch.nn.init.normal_(net.head.weight)
        decoders(torch.randn(12, 16, 16), torch.ones(3)).square().sum().backward()
        assert all(p.grad is not None and p.grad.any() for p in decoders.parameters()), changes


def test_global_features_reach_appearance_alone():
    decoders = Decoders(config())
    for net in decoders.nets:
        torch.nn.init.normal_(net.head.weight)
    textures = torch.randn(12, 16, 16)
    here, there = decoders(textures, torch.zeros(3)), decoders(textures, torch.tensor([1.0, 0.0, 2.0]))
    assert torch.equal(here[:11], there[:11])
    assert not torch.allclose(here[11:], there[11:])
