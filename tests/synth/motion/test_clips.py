import numpy as np
import pytest

from synth.motion.clips import make_motion
from synth.motion.generators import GENERATORS
from synth.motion.plans import FootStep, feet_tracks, solve, standing
from synth.person.mannequin import heads, mannequin
from synth.posing import bone_frames, linear_blend_skinning, skinning_transforms
from synth.scene import Clip
from synth.skeleton import make_skeleton

SKELETON = make_skeleton(heads())


def test_standing_still_keeps_the_feet_where_they_rest():
    plan = standing(np.arange(4) / 12)
    plan.stance = ((0.105, 0.10, 0.0), (-0.105, 0.10, 0.0))
    frames = bone_frames(SKELETON, solve(SKELETON, plan))
    for side in ("left", "right"):
        for joint in ("foot", "toe"):
            j = SKELETON.names.index(f"{joint}_{side}")
            np.testing.assert_allclose(frames[:, j, :3, 3], np.tile(SKELETON.heads[j], (4, 1)), atol=2e-3)


@pytest.mark.parametrize("name", sorted(GENERATORS))
@pytest.mark.parametrize("seed", [0, 1])
def test_feet_stand_where_planned_and_bones_keep_their_length(name: str, seed: int):
    """Inverse kinematics reaches the planned ball of each foot exactly, in every generator."""
    plan = GENERATORS[name](np.arange(24) / 12, np.random.default_rng(seed))
    frames = bone_frames(SKELETON, solve(SKELETON, plan))[:, :, :3, 3]
    balls, _, _ = feet_tracks(plan)
    for k, side in enumerate(("left", "right")):
        toe = SKELETON.names.index(f"toe_{side}")
        wanted = balls[:, k] + [0, SKELETON.heads[toe][1], 0]
        np.testing.assert_allclose(frames[:, toe], wanted, atol=1e-3)
    lengths = np.linalg.norm(frames[:, 1:] - frames[:, SKELETON.parents[1:]], axis=-1)
    rest = np.linalg.norm(SKELETON.heads[1:] - SKELETON.heads[SKELETON.parents[1:]], axis=-1)
    np.testing.assert_allclose(lengths, np.tile(rest, (24, 1)), atol=1e-12)


@pytest.mark.parametrize("name", sorted(GENERATORS))
def test_motions_are_smooth_and_stay_on_a_small_floor(name: str):
    motion = make_motion(SKELETON, (Clip(generator=name, frames=48),), fps=30.0, seed=5)
    assert np.abs(motion.dofs[:, [0, 2]]).max() < 0.6
    change = np.abs(np.diff(motion.dofs[:, 3:], axis=0)).max()
    assert change < 0.55, f"a joint turns by {change:.2f} rad between frames"
    assert np.isfinite(motion.dofs).all()


def test_knees_bend_forward_and_elbows_too():
    motion = make_motion(SKELETON, (Clip(generator="squat", frames=9),), fps=12.0, seed=0)
    frames = bone_frames(SKELETON, motion.dofs)[4]
    where = {name: frames[j, :3, 3] for j, name in enumerate(SKELETON.names)}
    forward = frames[0, :3, :3] @ [0, 0, 1] * [1, 0, 1]
    for side in ("left", "right"):
        assert (where[f"shin_{side}"] - (where[f"thigh_{side}"] + where[f"foot_{side}"]) / 2) @ forward > 0.1
        assert (where[f"hand_{side}"] - where[f"upper_arm_{side}"]) @ forward > 0.2


def test_motion_follows_its_seed_and_each_clip_its_own_stream():
    walk, reach = Clip(generator="walk", frames=5), Clip(generator="reach", frames=4)
    both = make_motion(SKELETON, (walk, reach), fps=12.0, seed=1)
    np.testing.assert_array_equal(both.dofs, make_motion(SKELETON, (walk, reach), fps=12.0, seed=1).dofs)
    np.testing.assert_array_equal(both.dofs[:5], make_motion(SKELETON, (walk,), fps=12.0, seed=1).dofs)
    assert np.abs(both.dofs - make_motion(SKELETON, (walk, reach), fps=12.0, seed=2).dofs).max() > 0.01
    np.testing.assert_array_equal(both.sequence, [0] * 5 + [1] * 4)


def test_a_step_moves_the_foot_and_lifts_it_on_the_way():
    plan = standing(np.linspace(0, 1, 11))
    plan.stance = ((0.1, 0.0, 0.0), (-0.1, 0.0, 0.0))
    plan.steps[0].append(FootStep(start=0.2, end=0.8, position=(0.1, 0.4), yaw=0.5))
    ball, yaw, _ = feet_tracks(plan)
    np.testing.assert_allclose(ball[[0, -1], 0], [[0.1, 0, 0], [0.1, 0, 0.4]], atol=1e-12)
    np.testing.assert_allclose(yaw[[0, -1], 0], [0, 0.5], atol=1e-12)
    assert ball[5, 0, 1] > 0.05
    np.testing.assert_array_equal(ball[:, 1], np.tile([-0.1, 0, 0], (11, 1)))


def test_the_mannequin_stays_above_the_floor():
    body = mannequin(skirt=True)
    clips = tuple(Clip(generator=name, frames=12) for name in ("walk", "dance"))
    motion = make_motion(body.skeleton, clips, fps=12.0, seed=0)
    for transforms in skinning_transforms(body.skeleton, motion.dofs):
        posed = linear_blend_skinning(body.surface.vertices, body.skin_weights, transforms)
        assert -0.02 < posed[:, 1].min() < 0.03
