"""Clothes: where the true surface lies in every frame. Skinning first, then what no skinned template knows.

Each departure has its strength in `Outfit`; at zero it is not evaluated at all: the skinned surface stays bit for bit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from ash.dataset import Motion
from synth.body import CLOTHES, Body, neighbour_mean, vertex_normals
from synth.posing import bone_frames, dual_quaternion_skinning, rotvec_to_rotmat, skinning_transforms
from synth.scene import Outfit

FOLDING_JOINTS = (
    "spine",
    "chest",
    *(f"{n}_{s}" for n in ("upper_arm", "forearm", "thigh", "shin") for s in ("left", "right")),
)
GRAVITY = 9.81
SWAY, TWIST = 0.18, 0.3  # most that air and cloth let a skirt swing (of its length) and lag (radians)


@dataclass(frozen=True, kw_only=True, slots=True)
class Folds:
    """Pose-dependent folds: waves near bending joints, and waves over each garment whose phase follows the pose."""

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
        clothed = surface.vertices_of(*CLOTHES) & ~surface.vertices_of("skin", "hair", "eyes", "shoes")
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
        mixing = rng.normal(size=(6, 3 * len(skeleton.names))) * 1.3
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


def true_surface(body: Body, motion: Motion, outfit: Outfit, *, seed: int) -> np.ndarray:
    """Posed vertices of the rendered surface, `[t, s, 3]` metres, every frame of every sequence."""
    transforms = skinning_transforms(body.skeleton, motion.dofs)
    rest, weights = body.surface.vertices, body.skin_weights
    posed = np.stack([dual_quaternion_skinning(rest, weights, frame) for frame in transforms])
    if outfit.swing > 0 and outfit.skirt:
        posed = _with_swing(body, motion, posed, outfit.swing)
    if outfit.slack_mm > 0:
        posed = posed + outfit.slack_mm / 1000 * np.stack([_sag(body, vertices) for vertices in posed])
    if outfit.folds_mm > 0:
        folds = Folds.of(body, seed=seed)
        for t, dofs in enumerate(motion.dofs):
            height = outfit.folds_mm / 1000 * folds.displacement(body, dofs[3:].reshape(-1, 3))
            posed[t] += height[:, None] * vertex_normals(posed[t], body.surface.faces)
    if outfit.skirt and outfit.swing > 0:
        legs = body.surface.vertices_of("trousers")
        cloth = body.surface.vertices_of("skirt")
        sleeves = leg_profiles(body)
        for frames, vertices in zip(bone_frames(body.skeleton, motion.dofs), posed, strict=True):
            clear_legs(body, sleeves, frames, vertices, cloth=cloth)
            push_out(vertices, body.surface.faces, cloth=cloth, inner=legs)
    return posed


def _sag(body: Body, posed: np.ndarray) -> np.ndarray:
    """Loose cloth hangs away from the body where it faces the floor, and rests on it elsewhere: `[s, 3]`, 0..1."""
    surface = body.surface
    clothed = surface.vertices_of("shirt", "trousers")
    loose = neighbour_mean(clothed & ~surface.vertices_of("skin", "shoes", "hair"), surface.faces, rounds=6) ** 2
    normals = neighbour_mean(vertex_normals(posed, surface.faces), surface.faces, rounds=6)
    below = np.clip(0.25 - normals[:, 1], 0, 1)
    hang = np.array([0, -1.0, 0]) + 0.6 * normals
    return (loose * below * clothed)[:, None] * hang


def _with_swing(body: Body, motion: Motion, posed: np.ndarray, strength: float) -> np.ndarray:
    """The skirt hangs from the waist as a damped pendulum that lags behind the hips, and lies on thighs that rise."""
    cloth = body.surface.vertices_of("skirt")
    rest = body.surface.vertices[cloth]
    pelvis = body.skeleton.heads[0]
    top, bottom = rest[:, 1].max(), rest[:, 1].min()
    depth = ((top - rest[:, 1]) / (top - bottom))[:, None]
    frames = bone_frames(body.skeleton, motion.dofs)
    yaw = np.unwrap(np.arctan2(frames[:, 0, 0, 2], frames[:, 0, 2, 2]))
    result = posed.copy()
    for index in np.unique(motion.sequence):
        chosen = np.flatnonzero(motion.sequence == index)
        sway, twist, spin = pendulum(frames[chosen, 0, :3, 3], yaw[chosen], fps=motion.fps, length=top - bottom)
        for k, t in enumerate(chosen):
            upright = rotvec_to_rotmat(np.array([0, yaw[t], 0]))
            stiff = (rest - pelvis) @ frames[t, 0, :3, :3].T
            lifted = _over_thighs(body, frames[t], upright, rest) - pelvis
            turned = rotvec_to_rotmat(np.concatenate([0 * depth, twist[k] * depth, 0 * depth], axis=1))
            hanging = np.einsum("vab,vb->va", turned, lifted @ upright.T)
            flare = 1 + 0.05 * np.minimum(spin[k] ** 2 / 10, 3.0) * depth
            hanging = hanging * np.concatenate([flare, 1 + 0 * flare, flare], axis=1)
            stay = np.clip(1 - 3 * depth, 0, 1)  # Only the waistband is stiff.
            swung = frames[t, 0, :3, 3] + stay * stiff + (1 - stay) * hanging + (top - bottom) * depth**1.5 * sway[k]
            result[t, cloth] += strength * (swung - posed[t, cloth])
    return result


def _over_thighs(body: Body, frames: np.ndarray, upright: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The skirt's rest points `[v, 3]`, its front raised with thighs that swing forward, its back with the others."""
    names, heads = body.skeleton.names, body.skeleton.heads
    pitch, roll, hips = [], [], []
    for side in ("left", "right"):
        hip, knee = names.index(f"thigh_{side}"), names.index(f"shin_{side}")
        thigh = (frames[knee, :3, 3] - frames[hip, :3, 3]) @ upright
        straight = heads[knee] - heads[hip]
        pitch.append(np.arctan2(thigh[2], -thigh[1]) - np.arctan2(straight[2], -straight[1]))
        roll.append(np.arctan2(thigh[0], -thigh[1]) - np.arctan2(straight[0], -straight[1]))
        hips.append(heads[hip])
    left = 0.5 + 0.5 * np.tanh(rest[:, 0] / 0.06)
    hip = np.mean(hips, axis=0) * [0, 1, 1]
    front = 0.5 + 0.5 * np.tanh((rest[:, 2] - hip[2]) / 0.05)
    forward = left * max(pitch[0], 0) + (1 - left) * max(pitch[1], 0)
    back = left * min(pitch[0], 0) + (1 - left) * min(pitch[1], 0)
    below = np.clip((hip[1] + 0.06 - rest[:, 1]) / 0.12, 0, 1)
    angle = below * (front * forward + (1 - front) * back)
    sideways = 0.8 * below * np.clip(left * roll[0] + (1 - left) * roll[1], -0.5, 0.5)
    turned = rotvec_to_rotmat(np.stack([-angle, np.zeros_like(angle), sideways], axis=1))
    return hip + np.einsum("vab,vb->va", turned, rest - hip)


def pendulum(
    positions: np.ndarray, yaw: np.ndarray, *, fps: float, length: float, damping: float = 0.25, substeps: int = 16
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sway `[t, 3]` (hem's shift over length), twist `[t]` (radians the hem lags) and spin `[t]` (rad/s) of a skirt.

    A damped pendulum driven by the acceleration of the pelvis `[t, 3]` and of its yaw `[t]`. Before the first frame the
    pelvis moved on uniformly, so the skirt starts without an inherited swing.
    """
    times = np.arange(len(positions)) / fps
    path, turn = CubicSpline(times, positions), CubicSpline(times, yaw)
    stiffness = GRAVITY / (0.7 * length)
    friction = 2 * damping * np.sqrt(stiffness)
    step = 1 / (fps * substeps)
    state = np.zeros((2, 3))  # sway x, z and twist; their velocities
    states = [state[0].copy()]
    for frame in range(len(positions) - 1):
        for k in range(substeps):
            time = times[frame] + k * step
            acceleration = path(time, 2)
            drive = np.array([acceleration[0] / length, acceleration[2] / length, turn(time, 2)])
            state[1] += step * (-stiffness * state[0] - friction * state[1] - drive)
            state[0] += step * state[1]
        states.append(state[0].copy())
    swung = np.array(states)
    sway = np.stack(
        [SWAY * np.tanh(swung[:, 0] / SWAY), np.zeros(len(swung)), SWAY * np.tanh(swung[:, 1] / SWAY)], axis=1
    )
    return sway, TWIST * np.tanh(swung[:, 2] / TWIST), turn(times, 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class LegProfile:
    """How thick the clothed leg is along one bone."""

    start: int  # joints at the bone's ends
    end: int
    radii: np.ndarray  # [bins] metres, from start to end


def leg_profiles(body: Body, bins: int = 8) -> list[LegProfile]:
    """Measure thighs and shins at rest."""
    names, heads = body.skeleton.names, body.skeleton.heads
    profiles = []
    for side in ("left", "right"):
        for first, last in (("thigh", "shin"), ("shin", "foot")):
            start, end = names.index(f"{first}_{side}"), names.index(f"{last}_{side}")
            own = (body.skin_weights[:, start] > 0.5) & ~body.surface.vertices_of("skirt")
            along, radius, _ = _cylindrical(body.surface.vertices[own], heads[start], heads[end])
            place = np.clip((along * bins).astype(int), 0, bins - 1)
            radii = np.array([np.quantile(radius[place == k], 0.6) if (place == k).any() else 0 for k in range(bins)])
            profiles.append(LegProfile(start=start, end=end, radii=radii))
    return profiles


def _cylindrical(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position along a bone (0..1 between its ends), distance from its axis, and the unit axis."""
    bone = end - start
    axis = bone / np.linalg.norm(bone)
    offset = points - start
    along = offset @ axis / np.linalg.norm(bone)
    radius = np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1)
    return along, radius, axis


def clear_legs(
    body: Body,
    profiles: list[LegProfile],
    frames: np.ndarray,
    vertices: np.ndarray,
    *,
    cloth: np.ndarray,
    margin: float = 0.01,
) -> None:
    """Move cloth that has legs inside or outside of it outwards, in place, along its own normals until it clears them.

    Going outwards along the cloth's normal, and not to the nearest side of the leg, keeps cloth on its side of the leg
    however far the leg has moved.
    """
    faces = body.surface.faces[cloth[body.surface.faces].all(axis=1)]
    rest = body.surface.vertices
    outward = neighbour_mean(vertex_normals(vertices, faces), faces, rounds=8)
    outward[cloth] /= np.maximum(np.linalg.norm(outward[cloth], axis=1, keepdims=True), 1e-9)
    # A side of the skirt answers for the leg of its own side; in the middle for both.
    shift = np.zeros(len(vertices))
    for profile in profiles:
        start, end = frames[profile.start, :3, 3], frames[profile.end, :3, 3]
        points, normals = vertices[cloth], outward[cloth]
        along, _, axis = _cylindrical(points, start, end)
        bins = (np.arange(len(profile.radii)) + 0.5) / len(profile.radii)
        limit = np.interp(along, bins, profile.radii) + margin
        offset = points - start
        flat = offset - (offset @ axis)[:, None] * axis
        turned = normals - (normals @ axis)[:, None] * axis
        a, b = np.sum(turned**2, axis=1), np.sum(turned * flat, axis=1)
        c = np.sum(flat**2, axis=1) - limit**2
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        leave = np.where((b**2 > a * c) & (a > 0.04), (-b + root) / np.maximum(a, 0.04), 0)
        beside = rest[cloth][:, 0] * np.sign(body.skeleton.heads[profile.start][0]) > -0.04
        within = (along > -0.05) & (along < 1.0) & beside
        shift[cloth] = np.maximum(shift[cloth], np.where(within, np.clip(leave, 0, 0.25), 0))
    for _ in range(3):
        shift = np.maximum(shift, neighbour_mean(shift, faces, rounds=4))
    vertices += shift[:, None] * outward


def push_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    cloth: np.ndarray,
    inner: np.ndarray,
    margin: float = 0.008,
    rounds: int = 3,
) -> None:
    """Move cloth vertices out of the posed body, in place, until they lie `margin` metres outside.

    Each round measures against the nearest body vertices' tangent planes, spreads half of the correction to neighbours
    (so that cloth drapes instead of denting) and ends with the exact correction.
    """
    normals = vertex_normals(vertices, faces)[inner]
    tree = cKDTree(vertices[inner])
    points = vertices[inner]
    inside_faces = faces[cloth[faces].all(axis=1)]
    for turn in range(rounds):
        distance, nearest = tree.query(vertices[cloth], k=4)
        offset = vertices[cloth][:, None] - points[nearest]
        signed = np.einsum("vka,vka->vk", offset, normals[nearest])
        weight = 1 / np.maximum(distance, 1e-4) ** 2
        weight /= weight.sum(axis=1, keepdims=True)
        height = np.sum(weight * signed, axis=1)
        away = np.einsum("vk,vka->va", weight, normals[nearest])
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        near = distance[:, 0] < 0.12
        push = np.where(near, np.maximum(margin - height, 0), 0)[:, None] * away
        move = np.zeros_like(vertices)
        move[cloth] = push
        if turn < rounds - 1:
            spread = neighbour_mean(move, inside_faces, rounds=3)
            move[cloth] = np.where(np.linalg.norm(push, axis=1, keepdims=True) > 0, push, spread[cloth])
        vertices += move


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
    kept = height[body.kept]
    worn = body.surface.vertices_of(*CLOTHES)[body.kept]
    scale = outfit.scan_mm / 1000 / np.sqrt(np.mean(kept[worn] ** 2))
    return scale * kept[:, None] * vertex_normals(rest, body.surface.faces)[body.kept]
