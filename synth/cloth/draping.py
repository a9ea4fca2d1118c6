"""Loose cloth over a moving body: the skirt of every frame, simulated once per sequence from its start.

The simulation runs on the cage, the coarse vertices of the skirt (`Body.cage`); the finer ones follow it. The body
moves smoothly between frames: its degrees of freedom are splined, and it is posed several times per frame.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from ash.capture.dataset import Motion
from synth.cloth.layers import beneath
from synth.cloth.xpbd import Contacts, Sheet, State, crowd, edges_of, limit_stretch, make_sheet, step
from synth.motion.plans import smooth
from synth.person.body import Body, neighbour_mean, vertex_normals
from synth.posing import dual_quaternion_skinning, skinning_transforms

WARM_UP = 0.8  # seconds in which the body gets from its rest pose into the first frame, moving on as it then does
POSES = 0.021  # seconds between poses of the body; cloth looks for what it touches once in each
STEPS = 12  # of the simulation from pose to pose
MARGIN = 0.010  # metres between cage and body: room for folds of both, and for the finer mesh
FLESH = 0.02  # metres that the body yields where a skirt is tight, at its waistband; less and less below
TIGHT = 0.2  # metres below the waistband to where it yields
NEAR = 0.1  # metres from which on a piece of the body can be touched before the next pose
PUSH = 6.0  # metres per second at which the solid can push cloth out of itself
FRICTION = 0.3
APART = 0.7  # of the cage's median edge, that its layers keep from each other
STRETCH = 1.03  # most of the cage's edges, over their rest length, in a frame
DRAG = 1.2  # 1/s, of still air
PULL = 450.0  # 1/s^2, of the guides at strength 1/2
WAISTBAND = 0.1  # of the cage's height, that moves with the hips


@dataclass(frozen=True, kw_only=True, slots=True)
class Solid:
    """A part of the body that cloth touches."""

    vertices: np.ndarray  # [b] of the body's surface
    faces: np.ndarray  # [g, 3] into `vertices`
    room: np.ndarray  # [k] metres that each cage vertex keeps from it; less than none where flesh yields
    side: float  # 1: the cloth lies around it; -1: it lies beside the cloth


@dataclass(frozen=True, kw_only=True, slots=True)
class Fitting:
    """What of a body takes part in the simulation of its skirt; everything is posed by skinning."""

    body: Body
    sheet: Sheet
    solids: tuple[Solid, ...]  # arms, then legs and hips: where both press, these win
    spread: csr_array  # [s', k] from the cage to every vertex of the skirt
    cloth: np.ndarray  # [s'] the skirt's surface vertices

    @classmethod
    def of(cls, body: Body) -> "Fitting":
        """Measure the skirt and find the parts of the body that it can touch."""
        surface = body.surface
        rest = surface.vertices[body.cage]
        height = rest[:, 1]
        pinned = height > height.max() - WAISTBAND * np.ptp(height)
        sheet = make_sheet(rest, body.cage_faces, pinned=pinned)
        legs, faces = _part(body, beneath(body))
        gap = cKDTree(surface.vertices[legs]).query(rest)[0]
        room = np.minimum(MARGIN, 0.8 * gap) - FLESH * np.maximum(1 - sheet.reach / TIGHT, 0)
        below = [j for j, name in enumerate(body.skeleton.names) if "hand" in name or "forearm" in name]
        arms, arm_faces = _part(body, body.skin_weights[:, below].sum(axis=1) > 0.5)
        cloth = np.flatnonzero(surface.vertices_of("skirt"))
        return cls(
            body=body,
            sheet=sheet,
            solids=(
                Solid(vertices=arms, faces=arm_faces, room=np.full(len(rest), MARGIN), side=-1.0),
                Solid(vertices=legs, faces=faces, room=room, side=1.0),
            ),
            spread=_spread(body, cloth),
            cloth=cloth,
        )

    def pose(self, dofs: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """For one frame `[3 + 3 j]`: the skinned cage `[k, 3]`, the solids `[b, 3]` and their smoothed normals."""
        transforms = skinning_transforms(self.body.skeleton, dofs[None])[0]
        moved = np.concatenate([self.body.cage, *(solid.vertices for solid in self.solids)])
        posed = dual_quaternion_skinning(self.body.surface.vertices[moved], self.body.skin_weights[moved], transforms)
        ends = np.cumsum([len(self.body.cage), *(len(solid.vertices) for solid in self.solids)])
        cage, *points = np.split(posed, ends[:-1])
        return cage, points, [_normals(place, solid.faces) for place, solid in zip(points, self.solids, strict=True)]


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normals = neighbour_mean(vertex_normals(vertices, faces), faces, rounds=2)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _part(body: Body, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The template's vertices on the chosen part of the surface `[s]` bool, with their faces. Skin under cloth is one.

    The template is fine enough for cloth to lie on, and a quarter of the surface's cost.
    """
    whole = chosen[body.template_to_surface][body.template_faces].all(axis=1)
    used, faces = np.unique(body.template_faces[whole], return_inverse=True)
    return body.template_to_surface[used], faces.reshape(-1, 3)


def _spread(body: Body, cloth: np.ndarray) -> csr_array:
    """A cage vertex is itself; any other lies in the middle of the cage vertices that it shares an edge with."""
    number = np.full(len(body.surface.vertices), -1)
    number[body.cage] = np.arange(len(body.cage))
    row = np.full(len(body.surface.vertices), -1)
    row[cloth] = np.arange(len(cloth))
    corners = body.surface.faces
    one, other = corners[:, [0, 1, 1, 2, 2, 0]].ravel(), corners[:, [1, 0, 2, 1, 0, 2]].ravel()
    finer = (row[one] >= 0) & (number[one] < 0) & (number[other] >= 0)
    pairs = np.unique(np.stack([row[one[finer]], number[other[finer]]], axis=1), axis=0)
    pairs = np.concatenate([np.stack([row[body.cage], np.arange(len(body.cage))], axis=1), pairs])
    share = 1 / np.bincount(pairs[:, 0], minlength=len(cloth))
    return csr_array(coo_array((share[pairs[:, 0]], (pairs[:, 0], pairs[:, 1])), shape=(len(cloth), len(body.cage))))


def swing(body: Body, motion: Motion, posed: np.ndarray, strength: float) -> np.ndarray:
    """Move the skirt of the skinned surface `[t, s, 3]` to where its cloth is, for a strength in 0..1.

    At strength 1 the cloth hangs from its waistband alone. Below, springs draw every vertex to its skinned place with
    the angular frequency squared PULL (1 - strength) / strength, and carry the share 1 - strength of its weight;
    below 0.05 the result also fades into the skinned skirt, so that zero strength is reached without a jump.
    """
    fitting = Fitting.of(body)
    result, fade = posed.copy(), fading(strength)
    for index in np.unique(motion.sequence):
        chosen = np.flatnonzero(motion.sequence == index)
        cages = simulate(fitting, motion.dofs[chosen], fps=motion.fps, strength=strength)
        for t, cage in zip(chosen, cages, strict=True):
            result[t, fitting.cloth] += fade * (fitting.spread @ cage - posed[t, fitting.cloth])
    return result


def fading(strength: float) -> float:
    """The share of the simulation in the result, 0..1."""
    return min(strength / 0.05, 1.0)


def simulate(fitting: Fitting, dofs: np.ndarray, *, fps: float, strength: float) -> np.ndarray:
    """The cage `[t, k, 3]` of every frame of one sequence `[t, 3 + 3 j]`, from a warm-up of its own."""
    poses = max(1, round(1 / (fps * POSES)))
    count = round(WARM_UP * fps) * poses
    times = np.arange(-count, (len(dofs) - 1) * poses + 1) / (fps * poses)
    path = _path(dofs, fps, times)
    seconds = 1 / (fps * poses * STEPS)
    cage, solids, normals = fitting.pose(path[0])
    state = State(place=cage.copy(), velocity=(fitting.pose(path[1])[0] - cage) * fps * poses)
    pull = PULL * (1 - strength) / strength
    sides = np.diff(fitting.sheet.rest[edges_of(fitting.sheet.faces)], axis=1)
    least = APART * float(np.median(np.linalg.norm(sides, axis=-1)))
    result = []
    for k in range(len(path)):
        if k >= count and (k - count) % poses == 0:
            limit_stretch(fitting.sheet, state.place, most=STRETCH, rounds=120)
            result.append(state.place.copy())
        if k == len(path) - 1:
            break
        cage_next, solids_next, normals_next = fitting.pose(path[k + 1])
        outward = _normals(state.place, fitting.sheet.faces)
        crowded = crowd(fitting.sheet, state.place, least=least, soon=least)
        touches = []
        for solid, a, b, n, m in zip(fitting.solids, solids, solids_next, normals, normals_next, strict=True):
            near, margin = _touched(solid, state.place, outward, a, n)
            touches.append(Touch(start=a[near], end=b[near], turn=(n[near], m[near]), margin=margin))
        for i in range(1, STEPS + 1):
            share = i / STEPS
            guide = (1 - share) * cage + share * cage_next
            contacts = tuple(touch.at(share, seconds) for touch in touches)
            step(
                fitting.sheet, state, seconds=seconds, pins=guide, weight=strength, drag=DRAG, guide=guide,
                pull=pull, contacts=contacts, friction=FRICTION, crowded=crowded,
            )  # fmt: skip
        cage, solids, normals = cage_next, solids_next, normals_next
    return np.array(result)


@dataclass(frozen=True, kw_only=True, slots=True)
class Touch:
    """The point of a solid that each cage vertex may touch, from one pose to the next."""

    start: np.ndarray  # [k, 3] metres
    end: np.ndarray  # [k, 3]
    turn: tuple[np.ndarray, np.ndarray]  # its normals `[k, 3]` at both
    margin: np.ndarray  # [k] metres

    def at(self, share: float, seconds: float) -> Contacts:
        """The contact at a share of the way, at the end of one step of `seconds`."""
        normal = (1 - share) * self.turn[0] + share * self.turn[1]
        normal /= np.maximum(np.sqrt(np.einsum("va,va->v", normal, normal)), 1e-9)[:, None]
        moved = self.end - self.start
        return Contacts(
            point=self.start + share * moved,
            moved=moved / STEPS,
            normal=normal,
            margin=self.margin,
            most=PUSH * seconds,
        )


def _touched(
    solid: Solid, place: np.ndarray, outward: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The point of a solid nearest to each cage vertex, and the margin to keep from it (-inf: it is too far away).

    A point that faces the cloth's wrong side does not count: cloth that a fast leg has run into would be pulled
    through it. Such cloth takes the nearest point that faces its own way, and gets out where it came from.
    """
    distance, near = cKDTree(points).query(place)
    facing = solid.side * np.einsum("va,va->v", outward, normals[near])
    lost = np.flatnonzero((facing < -0.3) & (distance < NEAR))
    if len(lost):
        apart = np.linalg.norm(place[lost, None] - points, axis=-1)
        apart[solid.side * (outward[lost] @ normals.T) < 0] = np.inf
        near[lost], distance[lost] = np.argmin(apart, axis=1), np.min(apart, axis=1)
    return near, np.where(distance < NEAR, solid.room, -np.inf)


def _path(dofs: np.ndarray, fps: float, times: np.ndarray) -> np.ndarray:
    """The degrees of freedom `[t, 3 + 3 j]` at any times: splined through the frames, which start at zero.

    Before them the joints ease from the rest pose into the first frame, while the pelvis moves on as it does there: no
    swing is inherited from a start.
    """
    padded = dofs if len(dofs) > 1 else np.repeat(dofs, 2, axis=0)
    spline = CubicSpline(np.arange(len(padded)) / fps, padded)
    result = spline(np.maximum(times, 0))
    early = np.minimum(times, 0)[:, None]
    result[:, :3] += early * spline(0.0, 1)[:3]
    result[:, 6:] *= smooth(1 + early / WARM_UP)
    return result
