"""Quaternions, forward kinematics and skinning: from degrees of freedom to one rigid transform per vertex (ASH Eq. 5).

Quaternions are wxyz. A rigid transform is kept as a unit quaternion and a translation; dual quaternions appear only
where they are blended (Kavan et al. 2007, "Skinning with Dual Quaternions").
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import ash.native.skinning
from ash.capture.dataset import Skeleton
from ash.rotations import RigidTransforms, quat_conjugate, quat_multiply, rotate, rotvec_to_unitquat, unitquat_to_rotmat


def forward_kinematics(skeleton: Skeleton, dofs: Float[Tensor, " d"]) -> RigidTransforms:
    """Skinning transform of every joint, rest to posed (convention: `ash.capture.dataset.Skeleton`). Rows: `[j]`."""
    heads = torch.as_tensor(skeleton.heads, dtype=dofs.dtype, device=dofs.device)
    local = rotvec_to_unitquat(dofs[3:].view(-1, 3))
    # Two 4x4 matrices per joint, relative to its parent: the product with its quaternion from the left, and its
    # rotation and translation. Products of both run down the skeleton together, one generation at a time.
    step = heads.new_zeros(len(heads), 2, 4, 4)
    step[:, 0] = _left_product(local)
    step[:, 1, :3, :3] = unitquat_to_rotmat(local)
    step[:, 1, :3, 3] = heads - heads[torch.from_numpy(np.maximum(skeleton.parents, 0))]
    step[0, 1, :3, 3] = heads[0] + dofs[:3]
    step[:, 1, 3, 3] = 1
    world = step
    for joints, parents in _generations(skeleton.parents):
        world = world.index_copy(0, joints, world[parents] @ step[joints])
    quats = world[:, 0, :, 0]
    return RigidTransforms(quats=quats, translations=world[:, 1, :3, 3] - rotate(quats, heads))


def _left_product(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4 4"]:
    """The matrix of p -> q p."""
    w, x, y, z = q.unbind(-1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _generations(parents: np.ndarray) -> list[tuple[Tensor, Tensor]]:
    """Joints that are equally far from the root, with their parents, generation by generation without the root."""
    depth = np.zeros(len(parents), dtype=np.int64)
    for joint in range(1, len(parents)):
        depth[joint] = depth[parents[joint]] + 1
    members = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    return [(torch.from_numpy(joints), torch.from_numpy(parents[joints])) for joints in members]


@dataclass(frozen=True, kw_only=True, slots=True)
class SkinWeights:
    """The `k` strongest joints of every vertex, strongest first; weights sum to 1."""

    joints: Int[Tensor, "v k"]
    weights: Float[Tensor, "v k"]


def sparse_skin_weights(dense: Float[Tensor, "v j"]) -> SkinWeights:
    """Keep, per vertex, as many joints as the busiest vertex needs; nothing is dropped."""
    influences = int((dense > 0).sum(1).max())
    weights, joints = dense.topk(influences, dim=1)
    return SkinWeights(joints=joints, weights=weights)


def dual_quaternion_skinning(joints: RigidTransforms, skin: SkinWeights) -> RigidTransforms:
    """`dual_quaternion_skinning_naive`, by a native kernel where no gradient is needed."""
    if not ash.native.skinning.can_use_native(joints.quats, joints.translations, skin.weights):
        return dual_quaternion_skinning_naive(joints, skin)
    joined = torch.cat([joints.quats, dual_parts(joints)], -1)
    quats, translations = ash.native.skinning.skin_vertices(joined, skin.joints, skin.weights)
    return RigidTransforms(quats=quats, translations=translations)


def dual_quaternion_skinning_naive(joints: RigidTransforms, skin: SkinWeights) -> RigidTransforms:
    """Blend joint transforms into one rigid transform per vertex: the definition, differentiable."""
    return blend_transforms(joints, skin.joints, skin.weights)


def blend_transforms(
    transforms: RigidTransforms, members: Int[Tensor, "n k"], weights: Float[Tensor, "n k"]
) -> RigidTransforms:
    """Blend `k` of some rigid transforms into each of `n`, as dual quaternions. Differentiable.

    Kavan et al. 2007. Every quaternion is first brought to the hemisphere of the one with the largest weight: q and -q
    are the same rotation, but their blend is not. Joints into vertices (skinning) or vertices into texels (ASH Eq. 4).
    """
    quats = transforms.quats[members]
    strongest = weights.argmax(1)[:, None, None].expand(-1, 1, 4)
    opposite = (quats * quats.gather(1, strongest)).sum(-1) < 0
    aligned = torch.where(opposite, -weights, weights)
    # A bag is a gather and a weighted sum in one: ten times as fast as the two in turn.
    both = torch.nn.functional.embedding_bag(
        members, torch.cat([transforms.quats, dual_parts(transforms)], -1), per_sample_weights=aligned, mode="sum"
    )
    both = both / both[:, :4].norm(dim=-1, keepdim=True)
    real, dual = both[:, :4], both[:, 4:]
    return RigidTransforms(quats=real, translations=2 * quat_multiply(dual, quat_conjugate(real))[..., 1:])


def dual_parts(transforms: RigidTransforms) -> Float[Tensor, "n 4"]:
    """Dual part t q / 2 of each rigid transform as a dual quaternion (q, t q / 2)."""
    return 0.5 * quat_multiply(torch.nn.functional.pad(transforms.translations, (1, 0)), transforms.quats)


def near_joints(skeleton: Skeleton) -> Bool[Tensor, "j j"]:
    """What is near each joint: itself, its parent, its children."""
    parents = torch.from_numpy(skeleton.parents)
    child = (parents >= 0).nonzero().squeeze(1)
    near = torch.eye(len(parents), dtype=torch.bool)
    near[child, parents[child]] = near[parents[child], child] = True
    return near
