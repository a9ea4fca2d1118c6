from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import known_model, tube_model_config, tube_template
from helpers.figures import front_camera, tube_mesh, tube_motion

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
from ash.textures import FrameInputs, build_lattice


def model(**changes) -> AshPlusModel:
    torch.manual_seed(0)
    config = tube_model_config(**changes)
    lattice = build_lattice(tube_mesh(), config.texels)
    raw = blank_gaussians(config, len(lattice.texels), 0.05)
    decoders = Decoders(config, lattice) if config.motion else None
    for net in decoders.nets if decoders is not None else ():
        torch.nn.init.normal_(net.head.weight, std=0.1)
    return AshPlusModel(config, tube_template(), lattice, raw + 0.1 * torch.randn_like(raw), decoders)


def posed(**changes) -> tuple[AshPlusModel, torch.Tensor, FrameInputs]:
    """A model with what it decodes and is told of a frame."""
    ash = model(**changes)
    inputs = ash.frame_inputs(Pose(tube_motion(), 4))
    return ash, ash.decode([inputs])[0], inputs


def test_eq_5_the_offset_if_there_is_one_is_added_before_posing():
    ash, raw, inputs = posed()
    offset, *_ = split_raw(raw)
    expected = inputs.transforms.apply(inputs.canonical + 0.01 * offset)
    torch.testing.assert_close(ash.gaussians(raw, inputs).means, expected)
    ash.config = replace(ash.config, offset=False)
    torch.testing.assert_close(ash.gaussians(raw, inputs).means, inputs.transforms.apply(inputs.canonical))


def test_rotations_turn_with_the_surface_or_are_those_of_the_world():
    ash, raw, inputs = posed()
    _, _, quats, _, _ = split_raw(raw)
    canonical = unitquat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
    found = unitquat_to_rotmat(torch.nn.functional.normalize(ash.gaussians(raw, inputs).quats, dim=-1))
    torch.testing.assert_close(found, unitquat_to_rotmat(inputs.transforms.quats) @ canonical, atol=1e-5, rtol=0)
    ash.config = replace(ash.config, quat_frame="world")
    world = torch.nn.functional.normalize(ash.gaussians(raw, inputs).quats, dim=-1)
    torch.testing.assert_close(unitquat_to_rotmat(world), canonical, atol=1e-5, rtol=0)


def test_light_multiplies_the_colour_by_the_exponential_of_the_irradiance():
    ash, raw, inputs = posed(light=True)
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
