"""Posing in closed form: rotations, forward kinematics and skinning. NumPy float64; shares no code with `ash`."""

import numpy as np

from ash.capture.dataset import Skeleton


def rotvec_to_rotmat(rotvecs: np.ndarray) -> np.ndarray:
    """Rodrigues' formula: rotation vectors `[..., 3]` (radians) to rotation matrices `[..., 3, 3]`."""
    angle = np.linalg.norm(rotvecs, axis=-1)[..., None, None]
    safe = np.where(angle < 1e-12, 1.0, angle)
    x, y, z = np.moveaxis(np.asarray(rotvecs, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3) / safe
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def rotmat_to_unitquat(rotations: np.ndarray) -> np.ndarray:
    """Rotation matrices `[..., 3, 3]` to unit quaternions `[..., 4]` (wxyz, w >= 0).

    The quaternion is the row of largest diagonal in 4 q q^T, which never divides by a small number.
    """
    r = rotations
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    outer = np.empty((*r.shape[:-2], 4, 4))  # 4 q q^T
    outer[..., 0, 0] = 1 + trace
    for i in range(3):
        outer[..., i + 1, i + 1] = 1 + 2 * r[..., i, i] - trace
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = r[..., k, j] - r[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = r[..., k, j] + r[..., j, k]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    quats = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    return np.where(quats[..., :1] < 0, -quats, quats)


def rotmat_to_rotvec(rotations: np.ndarray) -> np.ndarray:
    """Rotation matrices `[..., 3, 3]` to rotation vectors `[..., 3]` of angle at most pi."""
    quats = rotmat_to_unitquat(rotations)
    sine = np.linalg.norm(quats[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quats[..., :1])
    return np.where(sine < 1e-12, 2.0, angle / np.where(sine < 1e-12, 1.0, sine)) * quats[..., 1:]


def rotation_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The smallest rotation `[..., 3, 3]` that turns direction `start` `[..., 3]` into `end` (not opposite)."""
    a = start / np.linalg.norm(start, axis=-1, keepdims=True)
    b = end / np.linalg.norm(end, axis=-1, keepdims=True)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(a * b, axis=-1, keepdims=True))
    return rotvec_to_rotmat(axis / np.where(sine < 1e-12, 1.0, sine) * angle)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation `[3, 3]` that is nearest to a matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    rotation: np.ndarray = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation


def bone_frames(skeleton: Skeleton, dofs: np.ndarray) -> np.ndarray:
    """Forward kinematics: degrees of freedom `[t, 3 + 3 j]` to world frames G `[t, j, 4, 4]` (see `Skeleton`)."""
    count = len(skeleton.names)
    rotations = rotvec_to_rotmat(dofs[:, 3:].reshape(len(dofs), count, 3))
    frames = np.zeros((len(dofs), count, 4, 4))
    for j, parent in enumerate(skeleton.parents):
        local = np.zeros((len(dofs), 4, 4))
        local[:, :3, :3] = rotations[:, j]
        local[:, :3, 3] = skeleton.heads[j] - (skeleton.heads[parent] if parent >= 0 else -dofs[:, :3])
        local[:, 3, 3] = 1
        frames[:, j] = frames[:, parent] @ local if parent >= 0 else local
    return frames


def skinning_transforms(skeleton: Skeleton, dofs: np.ndarray) -> np.ndarray:
    """Transforms from rest to posed, G_j T(-head_j), `[t, j, 4, 4]`."""
    transforms = bone_frames(skeleton, dofs).copy()
    offset = np.einsum("tjab,jb->tja", transforms[..., :3, :3], skeleton.heads)
    transforms[..., :3, 3] -= offset
    return transforms


def _quat_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w1, x1, y1, z1 = np.moveaxis(a, -1, 0)
    w2, x2, y2, z2 = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def blended_dual_quaternions(weights: np.ndarray, transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit dual quaternions (real and dual part, each `[v, 4]` wxyz) blended per vertex from `[j, 4, 4]` transforms.

    Signs are aligned with that of each vertex' heaviest joint; the norm of the real part divides both.
    """
    real = rotmat_to_unitquat(transforms[:, :3, :3])
    translation = np.concatenate([np.zeros((len(real), 1)), transforms[:, :3, 3]], axis=1)
    dual = 0.5 * _quat_product(translation, real)
    heaviest = np.argmax(weights, axis=1)
    signed = np.where(real @ real.T < 0, -1.0, 1.0)[heaviest] * weights
    blended_real, blended_dual = signed @ real, signed @ dual
    norm = np.linalg.norm(blended_real, axis=1, keepdims=True)
    return blended_real / norm, blended_dual / norm


def dual_quaternion_skinning(vertices: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Skin rest vertices `[v, 3]` with weights `[v, j]` and one frame's transforms `[j, 4, 4]` to posed `[v, 3]`."""
    real, dual = blended_dual_quaternions(weights, transforms)
    w, axis = real[:, :1], real[:, 1:]
    rotated = vertices + 2 * np.cross(axis, np.cross(axis, vertices) + w * vertices)
    shift = 2 * (w * dual[:, 1:] - dual[:, :1] * axis + np.cross(axis, dual[:, 1:]))
    return rotated + shift


def linear_blend_skinning(vertices: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Skin rest vertices `[v, 3]` with the weighted mean of one frame's transforms `[j, 4, 4]`."""
    blended = np.einsum("vj,jab->vab", weights, transforms)
    return np.einsum("vab,vb->va", blended[:, :3, :3], vertices) + blended[:, :3, 3]
