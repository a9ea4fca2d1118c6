"""How far a pose lies from what training showed: degrees to the nearest training pose."""

from collections.abc import Sequence

import numpy as np

from ash.capture.dataset import Motion


def novelty_deg(motion: Motion, *, train: Sequence[int], test: Sequence[int]) -> list[float]:
    """Degrees from each test frame's pose to the nearest training frame's, by `pose_distances`: 0 for a pose seen."""
    known = pose_quats(motion.dofs[list(train)])
    return [float(pose_distances(pose, known).min()) for pose in pose_quats(motion.dofs[list(test)])]


def pose_distances(pose: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Degrees between one pose `[j, 4]` and others `[t, j, 4]`, by `pose_quats`: `[t]`.

    The mean over the joints of the geodesic angle between their rotations: of four times the arc sine of half the
    distance of unit quaternions, which keeps its digits where two rotations are alike.
    """
    same_side = np.where(np.einsum("tjk,jk->tj", others, pose)[..., None] < 0, -pose, pose)
    chords = np.linalg.norm(others - same_side, axis=-1)
    distances: np.ndarray = np.rad2deg(4 * np.arcsin(np.clip(chords / 2, 0, 1))).mean(axis=1)
    return distances


def pose_quats(dofs: np.ndarray) -> np.ndarray:
    """Rotations of the joints in their parents' frames, unit quaternions `[t, j, 4]` (wxyz), of poses `[t, 3 + 3 j]`.

    Of the root's the heading is removed, its turn about the vertical: neither where nor whither a person stands is
    part of the pose.
    """
    rotvecs = dofs[:, 3:].reshape(len(dofs), -1, 3)
    angle = np.linalg.norm(rotvecs, axis=-1, keepdims=True)
    quats = np.concatenate([np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * rotvecs], axis=-1)
    w, x, y, z = np.moveaxis(quats[:, 0], -1, 0)
    heading = np.where(np.hypot(w, y) < 1e-9, 0.0, np.arctan2(y, w))  # Upside down, one is as good as another.
    c, s = np.cos(heading), np.sin(heading)
    quats[:, 0] = np.stack([c * w + s * y, c * x - s * z, c * y - s * w, c * z + s * x], axis=-1)
    return quats
