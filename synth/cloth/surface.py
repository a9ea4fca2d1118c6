"""Clothes: where the true surface lies in every frame. Skinning first, then what no skinned template knows.

Each departure has its strength in `Outfit`; at zero it is not evaluated at all: the skinned surface stays bit for bit.
"""

from dataclasses import dataclass

import numpy as np

from ash.capture.dataset import Motion
from synth.cloth.draping import fading, swing
from synth.cloth.layers import layers_of, tuck_in
from synth.person.body import CLOTHES, PARTS, Body, Surface, neighbour_mean, vertex_normals
from synth.person.mesh import open_edges
from synth.posing import dual_quaternion_skinning, skinning_transforms
from synth.scene import Outfit

FOLDING_JOINTS = (
    "spine",
    "chest",
    *(f"{n}_{s}" for n in ("upper_arm", "forearm", "thigh", "shin") for s in ("left", "right")),
)

# Radians of phase per radian of all joints together. Frames of a walk differ by half a radian and a dance from a walk
# by two: neighbours fold nearly alike, so folds can be learned from few frames, and far poses fold otherwise.
PHASE = 0.8


@dataclass(frozen=True, kw_only=True, slots=True)
class Folds:
    """Pose-dependent folds: waves near bending joints, and waves over each garment whose phase moves with the pose."""

    strength: np.ndarray  # [s] 0..1, zero on skin and at the ends of garments
    near: np.ndarray  # [s, k] closeness to each folding joint, 0..1
    along: np.ndarray  # [s, k] phase of a wave across each joint, radians
    waves: np.ndarray  # [s, m] phase of the garment's own waves, radians
    mixing: np.ndarray  # [m, 3 j] how the pose moves their phase

    @classmethod
    def of(cls, body: Body, *, seed: int) -> "Folds":
        """Lay out the folds of a body's clothes."""
        rng = np.random.default_rng(seed)
        surface, skeleton = body.surface, body.skeleton
        rest = surface.vertices
        clothed = _inside_of(surface, *CLOTHES)
        strength = neighbour_mean(clothed.astype(np.float64), surface.faces, rounds=4) ** 2 * clothed
        near, along = [], []
        for joint in FOLDING_JOINTS:
            j = skeleton.names.index(joint)
            children = np.flatnonzero(skeleton.parents == j)
            bone = skeleton.heads[children].mean(axis=0) - skeleton.heads[j]
            offset = rest - skeleton.heads[j]
            close = np.exp(-np.sum(offset**2, axis=1) / 0.11**2)
            near.append(close * np.clip(2 * body.skin_weights[:, [j, skeleton.parents[j]]].sum(axis=1), 0, 1))
            slant = rng.normal(size=3) * 0.35
            axis = bone / np.linalg.norm(bone) + slant
            along.append(2 * np.pi / rng.uniform(0.045, 0.06) * (offset @ axis) + rng.uniform(0, 2 * np.pi))
        directions = rng.normal(size=(6, 3)) * [1.0, 0.35, 1.0]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths = rng.uniform(0.07, 0.16, size=6)
        waves = rest @ (2 * np.pi * directions / lengths[:, None]).T + rng.uniform(0, 2 * np.pi, size=6)
        mixing = rng.normal(size=(6, 3 * len(skeleton.names))) * PHASE
        return cls(
            strength=strength,
            near=np.stack(near, axis=1),
            along=np.stack(along, axis=1),
            waves=waves,
            mixing=mixing,
        )

    def displacement(self, body: Body, pose: np.ndarray) -> np.ndarray:
        """How far each vertex moves along its normal, `[s]` in units of the amplitude, for rotation vectors `[j, 3]`.

        The root's rotation is left out: folds depend on the pose, not on where the person faces.
        """
        inner = pose.copy()
        inner[0] = 0
        angles = np.array([np.linalg.norm(pose[body.skeleton.names.index(joint)]) for joint in FOLDING_JOINTS])
        bent = np.clip(angles / 1.0, 0, 1.3)
        local = np.sum(self.near * bent * np.sin(self.along + 1.5 * angles), axis=1)
        own = np.sin(self.waves + self.mixing @ inner.ravel()).sum(axis=1) / np.sqrt(6)
        return self.strength * (local + 0.75 * own)


def _inside_of(surface: Surface, *garments: str) -> np.ndarray:
    """The vertices of garments that lie neither at a hem nor on anything else, `[s]` bool."""
    others = surface.vertices_of(*(part for part in PARTS if part not in garments))
    chosen = surface.vertices_of(*garments) & ~others
    chosen[open_edges(surface.faces)] = False
    return chosen


def true_surface(body: Body, motion: Motion, outfit: Outfit, *, seed: int) -> np.ndarray:
    """Posed vertices of the rendered surface, `[t, s, 3]` metres, every frame of every sequence."""
    transforms = skinning_transforms(body.skeleton, motion.dofs)
    rest, weights = body.surface.vertices, body.skin_weights
    posed = np.stack([dual_quaternion_skinning(rest, weights, frame) for frame in transforms])
    if outfit.swing > 0 and outfit.skirt:
        posed = swing(body, motion, posed, outfit.swing)
    if outfit.slack_mm > 0:
        posed = posed + outfit.slack_mm / 1000 * np.stack([_sag(body, vertices) for vertices in posed])
    if outfit.folds_mm > 0:
        folds = Folds.of(body, seed=seed)
        folds.strength[body.surface.vertices_of("skirt")] *= 1 - fading(outfit.swing)  # Simulated cloth has its own.
        for t, dofs in enumerate(motion.dofs):
            height = outfit.folds_mm / 1000 * folds.displacement(body, dofs[3:].reshape(-1, 3))
            posed[t] += height[:, None] * vertex_normals(posed[t], body.surface.faces)
    if outfit.folds_mm > 0 or outfit.slack_mm > 0 or (outfit.skirt and outfit.swing > 0):
        layers = layers_of(body)
        posed = np.stack([tuck_in(layers, vertices) for vertices in posed])
    return posed


def _sag(body: Body, posed: np.ndarray) -> np.ndarray:
    """Loose cloth hangs away from the body where it faces the floor, and rests on it elsewhere: `[s, 3]`, 0..1."""
    surface = body.surface
    clothed = _inside_of(surface, "shirt", "trousers")
    loose = neighbour_mean(clothed, surface.faces, rounds=6) ** 2
    normals = neighbour_mean(vertex_normals(posed, surface.faces), surface.faces, rounds=6)
    below = np.clip(0.25 - normals[:, 1], 0, 1)
    hang = np.array([0, -1.0, 0]) + 0.6 * normals
    return (loose * below * clothed)[:, None] * hang


def scan_error(body: Body, outfit: Outfit, *, seed: int) -> np.ndarray | None:
    """Smooth error of the template's rest shape on clothes, `[v, 3]` metres with the stated rms, or None for none."""
    if outfit.scan_mm == 0:
        return None
    rng = np.random.default_rng(seed)
    rest = body.surface.vertices
    directions = rng.normal(size=(8, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phases = rest @ (2 * np.pi * directions / rng.uniform(0.15, 0.4, size=(8, 1))).T + rng.uniform(0, 2 * np.pi, size=8)
    height = np.sin(phases).sum(axis=1) * body.surface.vertices_of(*CLOTHES)
    height = neighbour_mean(height, body.surface.faces, rounds=3)
    template_height = height[body.template_to_surface]
    worn = body.surface.vertices_of(*CLOTHES)[body.template_to_surface]
    scale = outfit.scan_mm / 1000 / np.sqrt(np.mean(template_height[worn] ** 2))
    return scale * template_height[:, None] * vertex_normals(rest, body.surface.faces)[body.template_to_surface]
