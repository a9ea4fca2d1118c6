import torch
from helpers.captures import tube_model_config
from helpers.figures import tube_mesh, tube_motion, tube_skeleton

from ash.blendshapes import LocalBlendshapes
from ash.capture.dataset import Pose, Skeleton
from ash.rotations import RigidTransforms
from ash.template.motion import normalised_motion
from ash.template.skinning import near_joints
from ash.template.template import RestDeformation, Template
from ash.textures import Conditions, build_lattice

LATTICE = build_lattice(tube_mesh(), 16)


def head(**changes) -> LocalBlendshapes:
    torch.manual_seed(0)
    template = Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()))
    return LocalBlendshapes(tube_model_config(head="blendshapes", rank=2, **changes), LATTICE, template)


def conditions(motion: torch.Tensor) -> Conditions:
    nothing = torch.zeros(0, 3)
    return Conditions(
        trust=1.0,
        textures=torch.zeros(0, 1, 1),
        motion=motion,
        root_translation=torch.zeros(3),
        canonical=nothing,
        normals=nothing,
        transforms=RigidTransforms(quats=torch.zeros(0, 4), translations=nothing),
    )


def window(frame: int, seed: int = 0) -> torch.Tensor:
    return normalised_motion(Pose(tube_motion(seed=seed), frame), window=2)


def test_untrained_blendshapes_return_zero_and_then_learn_everything():
    decoder = head()
    decoder.observe([window(frame) for frame in range(6)])
    assert not decoder(conditions(window(4))).any()
    torch.nn.init.normal_(decoder.shapes)
    decoder(conditions(window(4))).square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in decoder.parameters())


def test_a_region_follows_its_neighbours_and_no_one_else():
    chain = Skeleton(names=tuple("abcd"), parents=torch.tensor([-1, 0, 1, 1]).numpy(), heads=torch.zeros(4, 3).numpy())
    expected = [[1, 1, 0, 0], [1, 1, 1, 1], [0, 1, 1, 0], [0, 1, 0, 1]]
    assert near_joints(chain).int().tolist() == expected
    decoder = head()
    torch.nn.init.normal_(decoder.shapes)
    decoder.near = torch.eye(2, dtype=torch.bool)
    moved = window(4).clone()
    moved[:, 6:9] += 0.5  # the angles of joint 1, which moves the upper half alone
    changed = (decoder(conditions(moved)) - decoder(conditions(window(4)))).abs().amax(1)
    share = LATTICE.interpolate(torch.from_numpy(tube_mesh().skin_weights).float())[:, 1]
    assert not changed[share == 0].any()
    assert (changed[share > 0] > 0).all()


def test_motion_is_seen_in_units_of_the_training_motion():
    decoder = head()
    frames = [window(frame) for frame in range(6)]
    decoder.observe(frames)
    seen = torch.stack([(decoder._angles(motion) - decoder.mean) / decoder.spread for motion in frames])
    moving = decoder.spread > 0.02
    torch.testing.assert_close(seen.mean(0), torch.zeros_like(decoder.mean), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.std(0, correction=0)[moving], torch.ones(int(moving.sum())), atol=1e-3, rtol=0)
    restored = head()
    restored.load_state_dict(decoder.state_dict())
    torch.nn.init.normal_(restored.shapes)
    decoder.load_state_dict(restored.state_dict())
    assert torch.equal(restored(conditions(frames[2])), decoder(conditions(frames[2])))


def test_correctives_stay_bounded_outside_the_training_motion():
    decoder = head()
    torch.nn.init.ones_(decoder.shapes)
    wild = conditions(100 * window(4))
    assert float(decoder(wild).detach().abs().max()) <= 2 + 1e-5
