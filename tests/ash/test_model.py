from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import known_model, tube_model_config
from helpers.figures import front_camera, tube_mesh, tube_motion, tube_skeleton

from ash.capture.dataset import Pose
from ash.config import AshConfig, ModelConfig, TrainingConfig
from ash.decoders import Decoders
from ash.files import InputError
from ash.gaussians.gaussians import split_raw
from ash.gaussians.initialising import blank_gaussians, texel_pitch
from ash.harmonics import SH_C0, sh_basis
from ash.plus import AshPlusModel
from ash.protocol import StageClock
from ash.rotations import rotate, unitquat_to_rotmat
from ash.template.template import RestDeformation, Template
from ash.textures import build_lattice


def model(**changes) -> AshPlusModel:
    torch.manual_seed(0)
    config = tube_model_config(**changes)
    template = Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()))
    lattice = build_lattice(tube_mesh(), config.texels)
    raw = blank_gaussians(config, len(lattice.texels), 0.05)
    decoders = Decoders(config, lattice) if config.motion else None
    for net in decoders.nets if decoders is not None else ():
        torch.nn.init.normal_(net.head.weight, std=0.1)
    return AshPlusModel(config, template, lattice, raw + 0.1 * torch.randn_like(raw), decoders)


def test_eq_5_the_offset_is_added_before_posing():
    ash = model()
    inputs = ash.frame_inputs(Pose(tube_motion(), 4))
    raw = ash.decode([inputs])[0]
    offset, *_ = split_raw(raw)
    expected = inputs.transforms.apply(inputs.canonical + 0.01 * offset)
    torch.testing.assert_close(ash.gaussians(raw, inputs).means, expected)


def test_each_switch_changes_what_it_names_and_nothing_else():
    full = model(sh_degree=1, light=True)
    full.light.data.normal_(std=0.3)
    inputs = full.frame_inputs(Pose(tube_motion(), 4))
    raw = full.decode([inputs])[0]
    reference = full.gaussians(raw, inputs)
    changed_by = {"offset": ({"offset": False}, {"means"}), "quat_frame": ({"quat_frame": "world"}, {"quats", "sh"})}
    for name, (change, expected) in changed_by.items():
        full.config = replace(full.config, **change)
        posed = full.gaussians(raw, inputs)
        parts = ("means", "quats", "scales", "opacities", "sh")
        differing = {part for part in parts if not torch.equal(getattr(posed, part), getattr(reference, part))}
        assert differing == expected, name
        full.config = replace(full.config, offset=True, quat_frame="canonical")
    full.light.data.zero_()
    dark = full.gaussians(raw, inputs)
    assert not torch.allclose(dark.sh, reference.sh)
    assert torch.equal(dark.means, reference.means)


def test_rotations_turn_with_the_surface():
    ash = model()
    inputs = ash.frame_inputs(Pose(tube_motion(), 4))
    raw = ash.decode([inputs])[0]
    _, _, quats, _, _ = split_raw(raw)
    canonical = unitquat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
    posed = unitquat_to_rotmat(torch.nn.functional.normalize(ash.gaussians(raw, inputs).quats, dim=-1))
    turned = unitquat_to_rotmat(inputs.transforms.quats) @ canonical
    torch.testing.assert_close(posed, turned, atol=1e-5, rtol=0)


def test_light_multiplies_the_colour_by_the_exponential_of_the_irradiance():
    ash = model(light=True)
    inputs = ash.frame_inputs(Pose(tube_motion(), 4))
    raw = ash.decode([inputs])[0]
    plain = 0.5 + SH_C0 * ash.gaussians(raw, inputs).sh[:, 0]
    ash.light.data.normal_(std=0.5)
    lit = 0.5 + SH_C0 * ash.gaussians(raw, inputs).sh[:, 0]
    torch.testing.assert_close(lit, plain * (sh_basis(inputs.normals, 2) @ ash.light).exp(), atol=1e-5, rtol=1e-5)


def test_turning_and_moving_person_and_camera_together_changes_no_pixel():
    """Everything but the light is relative to the body: with yaw-normalised textures ASH is equivariant."""
    ash, motion, camera = model(sh_degree=2, global_features=False), tube_motion(), front_camera()
    motion.dofs[:, 3:6] *= [0, 1, 0]
    yaw, shift = 0.8, np.array([1.0, 0.2, -0.4])
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    moved = replace(motion, dofs=motion.dofs.copy())
    moved.dofs[:, :3] = motion.dofs[:, :3] @ turn.T + shift
    moved.dofs[:, 4] += yaw
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ turn.T
    viewmat[:3, 3] = camera.viewmat[:3, 3] - viewmat[:3, :3] @ shift
    with torch.no_grad():
        before = ash(Pose(motion, 4), camera).rgb
        after = ash(Pose(moved, 4), replace(camera, viewmat=viewmat)).rgb
    assert before.max() > 0.2
    torch.testing.assert_close(after, before, atol=2e-3, rtol=0)


def test_stages_are_timed():
    clock = StageClock()
    with torch.no_grad():
        known_model()(Pose(tube_motion(), 3), front_camera(), clock)
    assert set(clock.ms) == {"stg1", "stg2", "stg3", "stg4"}


def test_texel_pitch_is_the_spacing_of_texels_on_the_surface():
    """The tube's atlas is 0.9 wide and high: texels are 0.2 pi / 14.4 m apart around and 1 / 14.4 m along."""
    lattice = build_lattice(tube_mesh(), 16)
    pitch = texel_pitch(lattice, torch.from_numpy(tube_mesh().vertices).float())
    expected = np.sqrt(0.2 * np.pi / 14.4 * 1 / 14.4)
    assert float(pitch.mean()) == pytest.approx(expected, rel=0.15)


def test_rotated_normals_reach_the_inputs():
    ash = model()
    inputs = ash.frame_inputs(Pose(tube_motion(), 0))
    at_rest = ash.lattice.interpolate(torch.from_numpy(tube_mesh().vertices * [1, 0, 1] / 0.1).float())
    below = inputs.canonical[:, 1] < 0.3
    expected = rotate(inputs.transforms.quats[below], torch.nn.functional.normalize(at_rest[below], dim=-1))
    assert ((expected * inputs.normals[below]).sum(1) > 0.98).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"texels": 50}, "multiple of shuffle 1 times 2"),
        ({"norm": "batch"}, "norm: expected one of none, batch-as-released, instance"),
        ({"sh_degree": 4}, "sh_degree: expected 0 to 3"),
        ({"motion": False, "base": False}, "motion=False needs base=True"),
    ],
)
def test_configurations_that_cannot_be_built_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        ModelConfig(**({"texels": 64, "window": 3, "yaw_normalise": True} | changes))


def test_a_warm_up_that_the_model_cannot_take_is_refused():
    training = TrainingConfig(
        steps=10, views_per_step=1, warmup="static", warmup_steps=2, l1_weight=0.1, ssim_weight=0.9, learning_rate=1e-4
    )
    with pytest.raises(InputError, match="needs base=True"):
        AshConfig(model=ModelConfig(texels=64, window=3, yaw_normalise=False), training=training)
