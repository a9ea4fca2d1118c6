"""Presets, and the switches between them: each changes what it names and nothing else."""

from dataclasses import replace

import pytest
import torch
from helpers.captures import tube_model_config
from helpers.learning import training_views

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import AshConfig, TemplateConfig
from ash.decoders import ConvBlock, GlobalFeatures
from ash.fields import changed
from ash.files import InputError
from ash.gaussians.initialising import released_gaussians
from ash.native.library import has_tiles
from ash.presets import CHOSEN_ON, PRESETS, named, plus
from ash.rotations import rotate, unitquat_to_rotmat
from ash.textures import smooth_noise
from ash.training.batches import draw_batch
from ash.training.images import load_training_images
from ash.training.losses import view_loss


def small(config: AshConfig, **training) -> AshConfig:
    """The same choices at the size of the tests' capture."""
    shuffle = min(config.model.shuffle, 2)
    model = replace(config.model, texels=16, width=4, levels=2, window=2, shuffle=shuffle)
    settings = {"steps": 4, "warmup_steps": 2, "views_per_step": 1} | training
    template = replace(config.template, nodes=30, blocks=1, steps=2)
    return replace(config, model=model, training=replace(config.training, **settings), template=template)


def tube_avatar(capture: Capture, **model) -> AshAvatar:
    config = AshConfig(model=tube_model_config(**model), training=small(plus("ci")).training)
    return AshAvatar.from_capture(config, capture)


def test_paper_and_release_differ_in_named_switches_alone():
    assert {name for name, _ in changed(named("paper"), named("official"))} == {
        "model.sh_degree", "model.norm", "model.quat_frame", "model.global_mlp", "training.warmup",
        "training.l1_weight", "training.ssim_weight", "template.released",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["ci", "official"])  # The others are these at other sizes, on other templates.
def test_every_preset_trains(name, capture, tmp_path):
    avatar = AshAvatar.from_capture(small(named(name), fitted_steps=3), capture)
    before = {key: value.clone() for key, value in avatar.module.named_parameters() if value.requires_grad}
    avatar.fit(capture, folder=tmp_path)
    after = dict(avatar.module.named_parameters())
    assert all(torch.isfinite(value).all() for value in after.values())
    assert [key for key, value in before.items() if torch.equal(after[key], value)] == []


def test_every_preset_records_on_what_it_was_chosen():
    assert CHOSEN_ON.keys() == PRESETS.keys()


def test_unknown_presets_are_refused_with_the_known_ones_named():
    with pytest.raises(InputError, match="ci, brief, cpu, thorough, budget, paper, official"):
        named("paperr")


def test_the_releases_norm_is_instance_norm_for_a_batch_of_one_even_after_training():
    torch.manual_seed(0)
    released, instance = ConvBlock(3, 4, "batch-as-released").eval(), ConvBlock(3, 4, "instance").eval()
    instance.load_state_dict(released.state_dict())
    for scale in (0.1, 10.0):
        texture = scale * torch.randn(1, 3, 8, 8)
        torch.testing.assert_close(released(texture), instance(texture), atol=2e-6, rtol=1e-5)


def test_the_global_mlps_are_as_wide_as_stated():
    sizes = [
        [layer.out_features for layer in GlobalFeatures(kind).mlp if hasattr(layer, "out_features")]
        for kind in ("paper", "released")
    ]
    assert sizes == [[32, 32, 16], [64, 32, 16]]
    released = GlobalFeatures("released")
    seen = []
    released.mlp.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    released(torch.tensor([1.2, 0.0, -2.4]))
    assert sum(p.numel() for p in released.parameters()) == 5168  # the release's
    torch.testing.assert_close(seen[0][:3], torch.tensor([1.0, 0.0, -2.0]))


def test_the_offsets_unit_scales_the_offset_alone(capture):
    avatar = tube_avatar(capture)
    inputs = avatar.module.frame_inputs(Pose(capture.motion, 2))
    raw = avatar.module.base_texels.detach().clone()
    raw[:, :3] = torch.randn(len(raw), 3, generator=torch.Generator().manual_seed(0))
    fine = avatar.module.gaussians(raw, inputs)
    avatar.module.config = replace(avatar.module.config, offset_unit_m=0.02)
    coarse = avatar.module.gaussians(raw, inputs)
    unmoved = inputs.transforms.apply(inputs.canonical)
    torch.testing.assert_close(coarse.means - unmoved, 2 * (fine.means - unmoved), atol=1e-5, rtol=0)
    assert all(torch.equal(getattr(fine, p), getattr(coarse, p)) for p in ("quats", "scales", "opacities", "sh"))


def test_the_weights_of_the_loss_weigh_its_two_parts(capture):
    training = small(plus("ci")).training
    batch = draw_batch(load_training_images(capture), training, 0, 0)
    drawn = batch.targets + 0.1 * torch.randn(batch.targets.shape, generator=torch.Generator().manual_seed(0))

    def loss(l1: float, ssim: float) -> float:
        return float(view_loss([drawn], [batch], replace(training, l1_weight=l1, ssim_weight=ssim)))

    for name, weights in {"paper": (0.1, 0.9), "official": (0.9, 0.1)}.items():
        preset = named(name).training
        assert (preset.l1_weight, preset.ssim_weight) == weights
        assert loss(*weights) == pytest.approx(weights[0] * loss(1.0, 0.0) + weights[1] * loss(0.0, 1.0), rel=1e-4)
    assert loss(1.0, 0.0) == pytest.approx(float((drawn - batch.targets).abs().mean()), rel=1e-4)


@pytest.mark.parametrize("quat_frame", ["world", "canonical"])
def test_the_releases_warm_up_aims_at_round_gaussians_turned_to_the_normal(capture, quat_frame):
    model = replace(small(named("official")).model, quat_frame=quat_frame)
    avatar = AshAvatar.from_capture(replace(small(named("official")), model=model, template=TemplateConfig()), capture)
    inputs = avatar.module.frame_inputs(Pose(capture.motion, 3))
    target = released_gaussians(model, avatar.analytic, inputs)
    axis = unitquat_to_rotmat(target[:, 6:10])[:, :, 0]
    if quat_frame == "canonical":
        axis = rotate(inputs.transforms.quats, axis)
    torch.testing.assert_close(axis, inputs.normals, atol=1e-4, rtol=0)
    points = inputs.transforms.apply(inputs.canonical)
    nearest = torch.cdist(points, points).sort(1).values[:, 1:4].square().mean(1).sqrt()
    torch.testing.assert_close(target[:, 3].exp(), nearest, atol=1e-5, rtol=1e-3)
    assert torch.equal(target[:, 3], target[:, 5])
    torch.testing.assert_close(target[:, 10].sigmoid(), torch.full_like(target[:, 10], 0.1))
    assert not target[:, :3].any()


@pytest.mark.skipif(not has_tiles(), reason="on a CPU without tiles (AMX) decoders learn in float32")
def test_bfloat16_is_a_matter_of_the_decoders_alone(capture):
    config = small(plus("ci"))
    avatar = AshAvatar.from_capture(replace(config, model=replace(config.model, width=16)), capture)
    for net in avatar.module.decoders.nets:
        torch.nn.init.normal_(net.head.weight, std=0.1)
    inputs = avatar._inputs_of(1)
    exact = avatar._decode([inputs])[0].detach()
    avatar.config = replace(avatar.config, training=replace(avatar.config.training, precision="bfloat16"))
    rough = avatar._decode([inputs])[0].detach()
    assert rough.dtype == torch.float32
    residual = float((exact - avatar.module.base_texels.detach()).abs().max())
    assert 0 < float((rough - exact).abs().max()) < 0.05 * residual


def test_noise_in_the_textures_is_for_learning_alone_and_another_one_in_every_step(capture):
    noisy = AshAvatar.from_capture(small(plus("ci"), texture_noise=0.5), capture)
    plain = AshAvatar.from_capture(small(plus("ci")), capture)
    seen = []
    for avatar in (noisy, plain):
        torch.nn.init.normal_(avatar.module.decoders.nets[0].head.weight, std=0.1, generator=torch.manual_seed(1))
        camera = [capture.cameras["cam1"]]
        draw = [training_views(avatar, 0, camera, torch.zeros(3), step).detach() for step in (2, 2, 3, 1)]
        with torch.no_grad():
            draw.append(training_views(avatar, 0, camera, torch.zeros(3), 2))
        seen.append(draw)
    (first, again, later, warm_up, still), (clean, _, _, clean_warm_up, _) = seen
    assert torch.equal(first, again) and not torch.equal(first, later)
    assert not torch.equal(first, clean)
    assert torch.equal(still, clean) and torch.equal(warm_up, clean_warm_up)


def test_noise_is_smooth_standard_and_a_function_of_its_seed():
    noise = smooth_noise(torch.Size((6, 32, 32)), (0, 3, 1))
    assert torch.equal(noise, smooth_noise(torch.Size((6, 32, 32)), (0, 3, 1)))
    assert not torch.equal(noise, smooth_noise(torch.Size((6, 32, 32)), (0, 3, 2)))
    corners = torch.stack([smooth_noise(torch.Size((6, 32, 32)), (s, 3, 1))[:, 0, 0] for s in range(200)])
    assert abs(corners.std() - 1) < 0.1 and abs(corners.mean()) < 0.1
    assert noise.diff(dim=2).abs().max() < 0.5


@pytest.mark.parametrize("model", [{"standardise": False}, {"motion": False}])
def test_noise_without_standardised_textures_is_refused(model):
    base = plus("ci")
    with pytest.raises(InputError, match="texture_noise"):
        replace(base, model=replace(base.model, **model), training=replace(base.training, texture_noise=0.5))
