import numpy as np
import pytest

from ash.capture.dataset import Skeleton
from synth.posing import (
    bone_frames,
    dual_quaternion_skinning,
    linear_blend_skinning,
    rotation_between,
    rotmat_to_rotvec,
    rotmat_to_unitquat,
    rotvec_to_rotmat,
    skinning_transforms,
)

ELBOW = Skeleton(names=("shoulder", "elbow"), parents=np.array([-1, 0]), heads=np.array([[0, 1.0, 0], [0.5, 1.0, 0]]))


def test_rotations_survive_the_round_trip():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for angle in (0.0, 1e-9, 1e-4, 1.0, 3.0, np.pi - 1e-6):
        rotvecs = angle * directions
        rotations = rotvec_to_rotmat(rotvecs)
        np.testing.assert_allclose(
            rotations @ np.swapaxes(rotations, 1, 2), np.broadcast_to(np.eye(3), (200, 3, 3)), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)
        np.testing.assert_allclose(rotmat_to_rotvec(rotations), rotvecs, atol=2e-8)
    quarter = rotvec_to_rotmat(np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotmat_to_unitquat(quarter), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_rotation_between_directions():
    np.testing.assert_allclose(
        rotation_between(np.array([1.0, 0, 0]), np.array([0, 2.0, 0])) @ [3, 0, 0], [0, 3, 0], atol=1e-12
    )
    np.testing.assert_array_equal(rotation_between(np.array([0, 1.0, 0]), np.array([0, 1.0, 0])), np.eye(3))


def test_forward_kinematics_of_an_elbow():
    """Shoulder turned by 90 degrees about z, elbow by 90 degrees about its own y, root moved: written down by hand."""
    dofs = np.array([[[0, 0, 0, 0, 0, 0, 0, 0, 0], [1, 2, 3, 0, 0, np.pi / 2, 0, np.pi / 2, 0]]], dtype=np.float64)[0]
    frames = bone_frames(ELBOW, dofs)
    np.testing.assert_allclose(frames[0, :, :3, 3], ELBOW.heads, atol=1e-15)
    np.testing.assert_allclose(frames[1, 0, :3, 3], [1, 3, 3], atol=1e-15)
    np.testing.assert_allclose(frames[1, 1, :3, 3], [1, 3.5, 3], atol=1e-15)
    hand = np.array(
        [[0.9, 1.0, 0]]
    )  # 0.4 m beyond the elbow along x, which the elbow turns to -z, the shoulder leaves there
    posed = linear_blend_skinning(hand, np.array([[0.0, 1.0]]), skinning_transforms(ELBOW, dofs)[1])
    np.testing.assert_allclose(posed, [[1, 3.5, 2.6]], atol=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_dual_quaternions_blend_a_hinge_in_closed_form(weight: float):
    """Two joints at one place, one turned about z: the blend turns by the angle of the blended quaternion."""
    joints = Skeleton(names=("a", "b"), parents=np.array([-1, 0]), heads=np.zeros((2, 3)))
    angle = 1.2
    dofs = np.zeros((1, 9))
    dofs[0, 8] = angle
    point = np.array([[1.0, 0.5, 0.2]])
    posed = dual_quaternion_skinning(point, np.array([[1 - weight, weight]]), skinning_transforms(joints, dofs)[0])
    blended = 2 * np.arctan2(weight * np.sin(angle / 2), 1 - weight + weight * np.cos(angle / 2))
    np.testing.assert_allclose(posed[0], rotvec_to_rotmat(np.array([0, 0, blended])) @ point[0], atol=1e-14)


def test_one_joint_per_vertex_makes_both_skinnings_rigid():
    rng = np.random.default_rng(2)
    vertices, owner = rng.normal(size=(60, 3)), rng.integers(2, size=60)
    transforms = skinning_transforms(ELBOW, rng.normal(size=(1, 9)) * 1.5)[0]
    rigid = np.einsum("vab,vb->va", transforms[owner, :3, :3], vertices) + transforms[owner, :3, 3]
    weights = np.eye(2)[owner]
    np.testing.assert_allclose(dual_quaternion_skinning(vertices, weights, transforms), rigid, atol=1e-12)
    np.testing.assert_allclose(linear_blend_skinning(vertices, weights, transforms), rigid, atol=1e-12)


def test_sign_of_a_quaternion_does_not_matter():
    """Nearly half a turn on either side of pi: blending must take the short way round."""
    joints = Skeleton(names=("a", "b"), parents=np.array([-1, 0]), heads=np.zeros((2, 3)))
    dofs = np.zeros((1, 9))
    dofs[0, 5], dofs[0, 8] = np.pi - 0.1, 0.2  # a at just under, b at just over half a turn
    point = np.array([[1.0, 0, 0]])
    posed = dual_quaternion_skinning(point, np.array([[0.5, 0.5]]), skinning_transforms(joints, dofs)[0])
    np.testing.assert_allclose(posed, [[-1, 0, 0]], atol=1e-12)
