import numpy as np
import pytest
import torch
from helpers.figures import tube_mesh, tube_skeleton
from scipy.spatial.transform import Rotation

from ash.rotations import (
    RigidTransforms,
    quat_conjugate,
    quat_multiply,
    root_yaw,
    rotate,
    rotmat_to_unitquat,
    rotvec_to_unitquat,
    unitquat_to_rotmat,
    unitquat_to_rotvec,
)
from ash.template.skinning import (
    dual_quaternion_skinning,
    dual_quaternion_skinning_naive,
    forward_kinematics,
    sparse_skin_weights,
)


def random_quats(count: int, seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=rng, dtype=torch.float64), dim=-1)


def as_scipy(quats: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]])


def test_quaternion_product_is_composition_of_rotations():
    p, q = random_quats(50, 1), random_quats(50, 2)
    expected = (as_scipy(p) * as_scipy(q)).as_matrix()
    np.testing.assert_allclose(unitquat_to_rotmat(quat_multiply(p, q)).numpy(), expected, atol=1e-14)


def test_rotating_a_vector_agrees_with_scipy():
    q, v = random_quats(50), torch.randn(50, 3, dtype=torch.float64)
    np.testing.assert_allclose(rotate(q, v).numpy(), as_scipy(q).apply(v.numpy()), atol=1e-14)
    torch.testing.assert_close(rotate(quat_conjugate(q), rotate(q, v)), v)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-3, 1.0, np.pi])
def test_rotation_vectors_agree_with_scipy_at_every_size(scale):
    r = scale * torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1)
    expected = Rotation.from_rotvec(r.numpy()).as_matrix()
    np.testing.assert_allclose(unitquat_to_rotmat(rotvec_to_unitquat(r)).numpy(), expected, atol=1e-12)
    torch.testing.assert_close(unitquat_to_rotvec(-rotvec_to_unitquat(r)).abs(), r.abs(), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.7])
def test_rotation_vectors_have_the_right_gradient(scale):
    r = (scale * torch.randn(4, 3, dtype=torch.float64)).requires_grad_()
    torch.autograd.gradcheck(rotvec_to_unitquat, r)


def test_matrix_to_quaternion_inverts_also_at_half_turns():
    axes = torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=-1)
    q = torch.cat([random_quats(40), rotvec_to_unitquat(np.pi * axes), rotvec_to_unitquat(0 * axes)])
    m = unitquat_to_rotmat(q)
    torch.testing.assert_close(unitquat_to_rotmat(rotmat_to_unitquat(m)), m, atol=1e-7, rtol=0)


def matrices_of(skeleton, dofs):
    """The convention of `ash.capture.dataset.Skeleton`, in 4x4 matrices."""
    transforms = []
    for joint, parent in enumerate(skeleton.parents):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(dofs[3 + 3 * joint : 6 + 3 * joint]).as_matrix()
        local[:3, 3] = skeleton.heads[joint] + (dofs[:3] if parent < 0 else -skeleton.heads[parent])
        transforms.append(local if parent < 0 else transforms[parent] @ local)
    unrest = [np.block([[np.eye(3), -head[:, None]], [np.zeros((1, 3)), 1]]) for head in skeleton.heads]
    return [t @ u for t, u in zip(transforms, unrest, strict=True)]


def test_forward_kinematics_is_the_product_of_matrices():
    skeleton, dofs = tube_skeleton(), np.random.default_rng(0).standard_normal(9)
    joints = forward_kinematics(skeleton, torch.from_numpy(dofs))
    points = torch.randn(2, 3, dtype=torch.float64)
    for joint, matrix in enumerate(matrices_of(skeleton, dofs)):
        expected = matrix[:3, :3] @ points[joint].numpy() + matrix[:3, 3]
        np.testing.assert_allclose(joints.apply(points)[joint].numpy(), expected, atol=1e-12)
    torch.testing.assert_close(joints.apply_inverse(joints.apply(points)), points)


def test_skinning_of_a_rigid_motion_is_that_motion():
    mesh = tube_mesh()
    skin = sparse_skin_weights(torch.from_numpy(mesh.skin_weights))
    q, t = random_quats(1), torch.randn(1, 3, dtype=torch.float64)
    signs = torch.tensor([[1.0], [-1.0]], dtype=torch.float64)  # The same rotation, from both hemispheres.
    joints = RigidTransforms(quats=signs * q, translations=t.expand(2, 3))
    points = torch.from_numpy(mesh.vertices)
    expected = rotate(q.expand(len(points), 4), points) + t
    torch.testing.assert_close(dual_quaternion_skinning(joints, skin).apply(points), expected)


def test_dual_quaternions_keep_volume_where_linear_blending_would_lose_it():
    """Half-way between 0 and 180 degrees about the tube's axis, the blend turns by 90 degrees at the same radius."""
    skeleton = tube_skeleton()
    dofs = torch.zeros(9, dtype=torch.float64)
    dofs[7] = np.pi * 0.999
    joints = forward_kinematics(skeleton, dofs)
    skin = sparse_skin_weights(torch.tensor([[0.5, 0.5]], dtype=torch.float64))
    point = torch.tensor([[0.1, 0.5, 0.0]], dtype=torch.float64)
    turned = dual_quaternion_skinning(joints, skin).apply(point)
    assert torch.linalg.norm(turned[0, [0, 2]]) == pytest.approx(0.1, abs=1e-9)
    assert turned[0, 2] == pytest.approx(-0.1, abs=1e-3)


def test_unblended_vertices_follow_their_joint_exactly():
    mesh, skeleton = tube_mesh(), tube_skeleton()
    dofs = torch.from_numpy(np.random.default_rng(3).standard_normal(9))
    joints = forward_kinematics(skeleton, dofs)
    skin = sparse_skin_weights(torch.from_numpy(mesh.skin_weights))
    posed = dual_quaternion_skinning(joints, skin).apply(torch.from_numpy(mesh.vertices))
    for joint in (0, 1):
        alone = mesh.skin_weights[:, joint] == 1
        points = torch.from_numpy(mesh.vertices[alone])
        expected = rotate(joints.quats[joint].expand(len(points), 4), points) + joints.translations[joint]
        torch.testing.assert_close(posed[torch.from_numpy(alone)], expected)


@pytest.mark.parametrize("yaw", [-2.5, 0.0, 1.0])
def test_root_yaw_is_the_heading(yaw):
    dofs = torch.zeros(9, dtype=torch.float64)
    dofs[4] = yaw
    assert float(root_yaw(dofs)) == pytest.approx(yaw)


def test_the_native_kernel_skins_as_defined():
    rng = torch.Generator().manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(9, 4, generator=rng), dim=1)
    joints = RigidTransforms(quats=quats, translations=torch.randn(9, 3, generator=rng))
    dense = torch.rand(3000, 9, generator=rng) * (torch.rand(3000, 9, generator=rng) < 0.4)
    dense[:, 0] += 0.1
    skin = sparse_skin_weights(dense / dense.sum(1, keepdim=True))
    native, defined = dual_quaternion_skinning(joints, skin), dual_quaternion_skinning_naive(joints, skin)
    # Blends of random rotations may nearly cancel: there, rounding is all that is left.
    points = torch.randn(3000, 3, generator=rng)
    error = (native.apply(points) - defined.apply(points)).norm(dim=1)
    assert error.median() < 1e-6 and (error < 1e-4).float().mean() > 0.999
    leaf = quats.clone().requires_grad_()
    skinned = dual_quaternion_skinning(RigidTransforms(quats=leaf, translations=joints.translations), skin)
    skinned.translations.sum().backward()
    assert leaf.grad.any()
