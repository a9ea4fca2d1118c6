from dataclasses import fields, replace

import pytest
import torch
from helpers.figures import front_camera, tube_motion
from helpers.learning import tiny_mesh

from ash.capture.dataset import Capture, Pose
from ash.config import TemplateConfig
from ash.fields import apply_overrides
from ash.files import InputError
from ash.mesh.drawing import SUPERSAMPLING, sample_texture
from ash.presets import named
from baselines.ddc import DdcAvatar, DdcModel, ddc_config


def model_of(capture: Capture) -> DdcModel:
    return DdcAvatar.from_capture(tiny_mesh(steps=4, warmup_steps=2), capture).module


def test_samples_hit_texture_pixels_where_the_atlas_says():
    texture = torch.arange(12.0).reshape(1, 3, 4)  # Three rows, the first on top.
    centres = torch.tensor([[0.125, 1 - 1 / 6], [0.875, 1 - 1 / 6], [0.375, 1 / 6]])
    torch.testing.assert_close(sample_texture(texture, centres)[:, 0], torch.tensor([0.0, 3.0, 9.0]))
    between = torch.tensor([[0.25, 1 - 1 / 6]])
    torch.testing.assert_close(sample_texture(texture, between), torch.tensor([[0.5]]))


def test_a_constant_texture_draws_a_flat_silhouette_over_the_background(capture):
    model = model_of(capture)
    posed = model.template.pose(Pose(tube_motion(), 0))
    colour, background = torch.tensor([0.2, 0.5, 0.8]), torch.tensor([1.0, 0.0, 0.0])
    texture = colour[:, None, None].expand(3, 32, 32)
    with torch.no_grad():
        image = model.rasterize(texture, posed, model.see(posed, [front_camera()]), background)[0]
    coverage = image[..., 3:]
    torch.testing.assert_close(image[..., :3], colour * coverage + background * (1 - coverage), atol=1e-6, rtol=0)
    steps = coverage * SUPERSAMPLING**2
    assert torch.equal(steps, steps.round())
    assert ((coverage > 0) & (coverage < 1)).any()


def test_gradients_reach_exactly_the_texture_pixels_that_are_seen(capture):
    model = model_of(capture)
    posed = model.template.pose(Pose(tube_motion(), 0))
    texture = torch.full((3, 32, 32), 0.5, requires_grad=True)
    model.rasterize(texture, posed, model.see(posed, [front_camera()]), torch.zeros(3))[..., 1].sum().backward()
    assert texture.grad is not None
    assert not texture.grad[[0, 2]].any()
    lit = texture.grad[1] != 0
    assert 0.3 < lit.float().mean() < 0.7  # The camera sees one half of the tube's unrolled surface.


def test_the_network_is_sized_as_the_presets_decoders_and_fills_its_texture():
    preset = named("cpu")
    config = ddc_config(preset, seed=0, template=TemplateConfig())
    assert all(getattr(config.model, field.name) == getattr(preset.model, field.name) for field in fields(config.model))
    assert config.texture == 4 * preset.model.texels == config.shuffle * config.model.decoded_texels
    with pytest.raises(InputError, match="texture: expected a multiple of 128, got 500"):
        replace(config, texture=500)
    with pytest.raises(InputError, match=r"unknown key 'width', did you mean model\.width"):
        apply_overrides(config, {"width": 8}, of="ddc")
    with pytest.raises(InputError, match=r"unknown key 'model\.sh_degree'"):  # A mesh has none.
        apply_overrides(config, {"model.sh_degree": 1}, of="ddc")
