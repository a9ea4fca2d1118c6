from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Motion
from ash.capture.novelty import novelty_deg, pose_distances, pose_quats

JOINTS = 7


@pytest.fixture
def motion() -> Motion:
    rng = np.random.default_rng(0)
    dofs = rng.uniform(-0.9, 0.9, (6, 3 + 3 * JOINTS))
    return Motion(dofs=dofs, sequence=np.zeros(6, dtype=np.int64), fps=12.0)


def moved(motion: Motion, frame: int, joint: int, rotvec: np.ndarray) -> Motion:
    dofs = motion.dofs.copy()
    dofs[frame, 3 + 3 * joint : 6 + 3 * joint] = rotvec
    return replace(motion, dofs=dofs)


def test_a_pose_of_training_is_no_news(motion):
    assert novelty_deg(motion, train=(0, 1, 2), test=(0, 2)) == [0.0, 0.0]
    assert min(novelty_deg(motion, train=(0, 1, 2), test=(3, 4, 5))) > 10


@pytest.mark.parametrize("angle", [1e-7, 0.3, 2.5, np.pi])
def test_one_turned_joint_counts_as_its_share_of_all(motion, angle):
    axis = np.array([0.6, 0.0, 0.8])
    still = replace(motion, dofs=motion.dofs[[0, 0]], sequence=motion.sequence[:2])
    turned = moved(moved(still, 0, 4, 0.2 * axis), 1, 4, (0.2 + angle) * axis)
    np.testing.assert_allclose(novelty_deg(turned, train=(0,), test=(1,)), [np.rad2deg(angle) / JOINTS], rtol=1e-6)


def test_neither_place_nor_heading_is_pose_but_leaning_is(motion):
    dofs = motion.dofs.copy()
    dofs[1:3] = dofs[0]
    dofs[1, :3] += 1.0
    turned = Rotation.from_rotvec([0, 1.4, 0]) * Rotation.from_rotvec(dofs[0, 3:6])  # of the world, after its own
    dofs[1, 3:6] = turned.as_rotvec()
    same = replace(motion, dofs=dofs)
    np.testing.assert_allclose(novelty_deg(same, train=(0,), test=(1,)), [0.0], atol=1e-6)
    upright, leaning = np.zeros((1, 3 + 3 * JOINTS)), np.zeros((1, 3 + 3 * JOINTS))
    leaning[0, 3] = 0.5
    distance = pose_distances(pose_quats(leaning)[0], pose_quats(upright))
    np.testing.assert_allclose(distance, [np.rad2deg(0.5) / JOINTS], rtol=1e-9)


def test_the_nearest_training_pose_counts(motion):
    known = pose_quats(motion.dofs[:3])
    each = [pose_distances(pose, known).min() for pose in pose_quats(motion.dofs[3:])]
    np.testing.assert_allclose(novelty_deg(motion, train=(0, 1, 2), test=(3, 4, 5)), each)
    more = novelty_deg(motion, train=(0, 1, 2, 4), test=(3, 4, 5))
    assert more[1] == 0 and all(now <= before for now, before in zip(more, each, strict=True))
