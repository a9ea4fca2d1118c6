"""Rotations and rigid transforms: quaternions (wxyz), rotation vectors, matrices."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class RigidTransforms:
    """x -> R(quats) x + translations, one transform per row."""

    quats: Float[Tensor, "*n 4"]  # wxyz, unit
    translations: Float[Tensor, "*n 3"]  # metres

    def apply(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform one point per row."""
        return rotate(self.quats, points) + self.translations

    def apply_inverse(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Undo `apply`."""
        return rotate(quat_conjugate(self.quats), points - self.translations)


def quat_multiply(p: Float[Tensor, "*n 4"], q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Hamilton product: rotates by q first, then by p."""
    pw, px, py, pz = p.unbind(-1)
    qw, qx, qy, qz = q.unbind(-1)
    return torch.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        dim=-1,
    )


def quat_conjugate(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Inverse of a unit quaternion."""
    return q * q.new_tensor([1.0, -1.0, -1.0, -1.0])


def rotate(q: Float[Tensor, "*n 4"], v: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Rotate one vector per row by a unit quaternion."""
    w, u = q[..., :1], q[..., 1:]
    t = 2 * torch.linalg.cross(u, v)
    return v + w * t + torch.linalg.cross(u, t)


def rotvec_to_unitquat(r: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 4"]:
    """Rotation vector (radians) to unit quaternion; smooth through zero rotation, gradient included."""
    squared = (r * r).sum(-1, keepdim=True)
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    half_sinc = torch.where(small, 0.5 - squared / 48, torch.sin(angle / 2) / angle)
    cosine = torch.where(small, 1 - squared / 8, torch.cos(angle / 2))
    return torch.cat([cosine, r * half_sinc], dim=-1)


def unitquat_to_rotvec(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3"]:
    """Unit quaternion to the rotation vector (radians) of at most half a turn."""
    q = torch.where(q[..., :1] < 0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, q[..., :1])
    return q[..., 1:] * torch.where(sine < 1e-9, torch.full_like(sine, 2.0), angle / sine.clamp(min=1e-9))


def unitquat_to_rotmat(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Unit quaternion to rotation matrix."""
    w, x, y, z = q.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def rotmat_to_unitquat(m: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 4"]:
    """Rotation matrix to unit quaternion with w >= 0.

    Reference: Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", 2000, in the form that
    picks the largest of the four squared components, so that no division is by a small number.
    """
    d = torch.diagonal(m, dim1=-2, dim2=-1)
    trace = d.sum(-1)
    squares = torch.cat([trace[..., None], 2 * d - trace[..., None]], -1)  # 4 w^2 - 1, 4 x^2 - 1, ...
    off = lambda i, j, sign: m[..., i, j] + sign * m[..., j, i]  # noqa: E731
    w = torch.stack([1 + squares[..., 0], off(2, 1, -1), off(0, 2, -1), off(1, 0, -1)], -1)
    x = torch.stack([off(2, 1, -1), 1 + squares[..., 1], off(0, 1, 1), off(0, 2, 1)], -1)
    y = torch.stack([off(0, 2, -1), off(0, 1, 1), 1 + squares[..., 2], off(1, 2, 1)], -1)
    z = torch.stack([off(1, 0, -1), off(0, 2, 1), off(1, 2, 1), 1 + squares[..., 3]], -1)
    candidates = torch.stack([w, x, y, z], -2)
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(q[..., :1] < 0, -q, q)


def root_yaw(dofs: Float[Tensor, " d"]) -> Float[Tensor, ""]:
    """Heading of the root about the vertical (y) axis, radians: where its forward axis (+z) points in the floor
    plane."""
    forward = rotate(rotvec_to_unitquat(dofs[3:6]), dofs.new_tensor([0.0, 0.0, 1.0]))
    return torch.atan2(forward[0], forward[2])
