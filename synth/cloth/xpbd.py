"""Extended position-based dynamics (Macklin et al. 2016) in small steps of one iteration each: NumPy, float64.

Constraints of one colour share no vertex, so a colour is solved at once and the order of everything is fixed: equal
input gives equal bytes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

GRAVITY = np.array([0.0, -9.81, 0.0])


@dataclass(frozen=True, kw_only=True, slots=True)
class Links:
    """Pairs of vertices that keep their distance; no vertex occurs twice."""

    ends: np.ndarray  # [2 n] first ends, then second ends
    length: np.ndarray  # [n] metres
    share: np.ndarray  # [n, 1] of the correction that the first end takes
    softness: np.ndarray  # [n] compliance over the sum of inverse masses, s^2
    edge: np.ndarray  # [n] 1.0 for an edge, 0.0 for a hinge


@dataclass(frozen=True, kw_only=True, slots=True)
class Sheet:
    """A piece of cloth at rest. Masses follow the area; pinned vertices are moved from outside."""

    rest: np.ndarray  # [v, 3] metres
    faces: np.ndarray  # [f, 3]
    mass: np.ndarray  # [v] kilograms
    pinned: np.ndarray  # [v] bool
    colours: tuple[Links, ...]  # of stretch and bending
    anchor: np.ndarray  # [v] the pinned vertex nearest along the cloth, -1 without any
    reach: np.ndarray  # [v] metres along the cloth to it


@dataclass(slots=True)
class State:
    """Where the cloth is and how it moves; replaced in every step."""

    place: np.ndarray  # [v, 3] metres
    velocity: np.ndarray  # [v, 3] metres per second


@dataclass(frozen=True, kw_only=True, slots=True)
class Contacts:
    """The piece of a solid's surface that each cloth vertex must stay in front of, during one step."""

    point: np.ndarray  # [v, 3] metres, at the end of the step
    moved: np.ndarray  # [v, 3] metres, its motion over the step
    normal: np.ndarray  # [v, 3] unit, out of the solid
    margin: np.ndarray  # [v] metres to keep from it; -inf where nothing is near
    most: float = np.inf  # metres that a vertex is pushed in a step: one found deep inside gets out gently


@dataclass(frozen=True, kw_only=True, slots=True)
class Crowd:
    """Pairs of vertices of one cloth that are near in space and not along the cloth."""

    pairs: np.ndarray  # [n, 2]
    least: float  # metres that they keep


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Edges `[e, 2]` of triangles, each once."""
    return np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)


def hinges_of(faces: np.ndarray) -> np.ndarray:
    """The two vertices opposite each inner edge `[h, 2]`: their distance is what bending changes."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    opposite = faces[:, [2, 0, 1]].ravel()
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    same = np.flatnonzero((sides[order[1:]] == sides[order[:-1]]).all(axis=1))
    return np.stack([opposite[order[same]], opposite[order[same + 1]]], axis=1)


def colour(pairs: np.ndarray) -> np.ndarray:
    """Greedy colouring `[n]`: pairs of one colour share no vertex; each pair takes the lowest colour still free."""
    taken: dict[int, int] = {}  # vertex -> bits of its colours
    result = np.zeros(len(pairs), dtype=np.int64)
    for index, (a, b) in enumerate(pairs.tolist()):
        used = taken.get(a, 0) | taken.get(b, 0)
        free = ~used & (used + 1)
        result[index] = free.bit_length() - 1
        taken[a] = taken.get(a, 0) | free
        taken[b] = taken.get(b, 0) | free
    return result


def make_sheet(
    rest: np.ndarray,
    faces: np.ndarray,
    *,
    pinned: np.ndarray,
    density: float = 0.25,
    stretch_compliance: float = 0.0,
    bend_compliance: float = 1e-1,
) -> Sheet:
    """Cloth from its rest shape; density in kg/m^2, compliances in m/N.

    Raises:
        ValueError: a compliance or the density is negative or not a number, or a vertex has no face.
    """
    if not (density > 0 and stretch_compliance >= 0 and bend_compliance >= 0):
        raise ValueError(f"density {density}, compliances {stretch_compliance}, {bend_compliance}: expected 0 or more")
    a, b, c = (rest[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    mass = density / 3 * np.bincount(faces.ravel(), weights=np.repeat(area, 3), minlength=len(rest))
    if not (mass > 0).all():
        raise ValueError("a vertex of the cloth has no face or its rest shape is not finite")
    inverse = np.where(pinned, 0.0, 1 / mass)
    edges, hinges = edges_of(faces), hinges_of(faces)
    pairs = np.concatenate([edges, hinges])
    compliance = np.repeat([stretch_compliance, bend_compliance], [len(edges), len(hinges)])
    edge = np.repeat([1.0, 0.0], [len(edges), len(hinges)])
    movable = (inverse[pairs] > 0).any(axis=1)
    pairs, compliance, edge = pairs[movable], compliance[movable], edge[movable]
    colours = colour(pairs)
    links = []
    for index in range(colours.max(initial=-1) + 1):
        first, second = pairs[colours == index].T
        total = inverse[first] + inverse[second]
        links.append(
            Links(
                ends=np.concatenate([first, second]),
                length=np.linalg.norm(rest[first] - rest[second], axis=1),
                share=(inverse[first] / total)[:, None],
                softness=compliance[colours == index] / total,
                edge=edge[colours == index],
            )
        )
    anchor, reach = _tethers(rest, edges, pinned)
    return Sheet(
        rest=rest, faces=faces, mass=mass, pinned=pinned, colours=tuple(links), anchor=anchor, reach=reach
    )  # fmt: skip


def _tethers(rest: np.ndarray, edges: np.ndarray, pinned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest pinned vertex along the cloth's edges and how far it is: `[v]`, `[v]`."""
    if not pinned.any():
        return np.full(len(rest), -1), np.full(len(rest), np.inf)
    lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    graph = csr_array((lengths, (edges[:, 0], edges[:, 1])), shape=(len(rest),) * 2)
    reach, _, anchor = dijkstra(
        graph, directed=False, indices=np.flatnonzero(pinned), min_only=True, return_predecessors=True
    )
    return np.where(np.isfinite(reach), anchor, -1), reach


def crowd(sheet: Sheet, place: np.ndarray, *, least: float, soon: float) -> Crowd:
    """The pairs that may come nearer than `least` metres while they approach by `soon`, and at rest lie far apart.

    Vertices are balls: those of two layers cannot pass between each other when `least` is about two thirds of the
    cloth's edges. Neighbours, nearer than twice `least` at rest, are kept apart by bending.
    """
    near = cKDTree(place).query_pairs(least + soon, output_type="ndarray")
    apart = np.linalg.norm(sheet.rest[near[:, 0]] - sheet.rest[near[:, 1]], axis=1) > 2 * least
    near = near[apart & ~sheet.pinned[near].all(axis=1)]
    return Crowd(pairs=near[np.lexsort((near[:, 1], near[:, 0]))], least=least)


def step(
    sheet: Sheet,
    state: State,
    *,
    seconds: float,
    pins: np.ndarray,
    weight: float = 1.0,
    drag: float = 0.0,
    guide: np.ndarray | None = None,
    pull: float = 0.0,
    contacts: tuple[Contacts, ...] = (),
    friction: float = 0.0,
    crowded: Crowd | None = None,
) -> None:
    """One step of the simulation, in place.

    Pinned vertices go to their rows of `pins` `[v, 3]`. Others fall under `weight` times gravity, are slowed by still
    air (`drag`, 1/s), drawn to `guide` `[v, 3]` by springs (`pull`, 1/s^2, relative to mass), keep their distances, do
    not pass through `crowded` others and stay in front of `contacts`, later ones winning, on which they slide against
    Coulomb friction.
    """
    before = state.place
    place = before + seconds / (1 + drag * seconds) * (state.velocity + seconds * weight * GRAVITY)
    place[sheet.pinned] = pins[sheet.pinned]
    if guide is not None and pull > 0:
        # A spring to a fixed point is a constraint whose inverse compliance is mass times `pull`.
        place += (pull * seconds**2 / (1 + pull * seconds**2)) * (guide - place) * ~sheet.pinned[:, None]
    for links in sheet.colours:
        _keep_distance(place, links, seconds)
    tied = sheet.anchor >= 0
    if tied.any():
        _tether(place, sheet, tied)
    if crowded is not None and len(crowded.pairs):
        _part(place, crowded, sheet.pinned)
    for contact in contacts:
        _separate(place, before, contact, friction, sheet.pinned)
    state.velocity = (place - before) / seconds
    state.place = place


def _keep_distance(place: np.ndarray, links: Links, seconds: float) -> None:
    """Move both ends of each link by their share of C / (1 + compliance / (w dt^2)), along the link."""
    ends, offset, length = _span(place, links)
    gain = 1 / (1 + links.softness / seconds**2)
    offset *= (gain * (1 - links.length / np.maximum(length, 1e-9)))[:, None]
    _shorten(place, links, ends, offset)


def limit_stretch(sheet: Sheet, place: np.ndarray, *, most: float, rounds: int) -> None:
    """Shorten edges that are longer than `most` times their rest, in place: what the steps had no time to do."""
    for _ in range(rounds):
        worst = 0.0
        for links in sheet.colours:
            if not links.edge.any():
                continue
            ends, offset, length = _span(place, links)
            excess = np.maximum(1 - most * links.length / np.maximum(length, 1e-9), 0) * links.edge
            if excess.any():
                worst = max(worst, float(excess.max()))
                _shorten(place, links, ends, offset * excess[:, None])
        if worst < 0.002:
            break


def _span(place: np.ndarray, links: Links) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ends = place.take(links.ends, axis=0)
    offset = ends[len(links.length) :] - ends[: len(links.length)]
    return ends, offset, np.sqrt(np.einsum("na,na->n", offset, offset))


def _shorten(place: np.ndarray, links: Links, ends: np.ndarray, offset: np.ndarray) -> None:
    """Take the vectors `[n, 3]` off the links, shared between their ends; `ends` is where these are."""
    own = links.share * offset
    ends[: len(own)] += own
    ends[len(own) :] += own - offset
    place[links.ends] = ends


def _tether(place: np.ndarray, sheet: Sheet, tied: np.ndarray) -> None:
    """No vertex gets farther from its anchor than the cloth between them is long (Kim et al. 2012)."""
    offset = place[tied] - place[sheet.anchor[tied]]
    length = np.sqrt(np.einsum("na,na->n", offset, offset))
    place[tied] -= (np.maximum(1 - sheet.reach[tied] / np.maximum(length, 1e-9), 0))[:, None] * offset


def _part(place: np.ndarray, crowded: Crowd, pinned: np.ndarray) -> None:
    """Push pairs that are too near apart, all at once: a vertex moves by the mean of what its pairs ask of it."""
    first, second = crowded.pairs.T
    offset = place[second] - place[first]
    length = np.sqrt(np.einsum("na,na->n", offset, offset))
    close = np.flatnonzero(length < crowded.least)
    if not len(close):
        return
    push = (0.5 * (crowded.least / np.maximum(length[close], 1e-9) - 1))[:, None] * offset[close]
    ends = np.concatenate([first[close], second[close]])
    asked = np.concatenate([-push, push])
    moved = np.stack([np.bincount(ends, weights=asked[:, k], minlength=len(place)) for k in range(3)], axis=1)
    count = np.maximum(np.bincount(ends, minlength=len(place)), 1)
    place += moved / count[:, None] * ~pinned[:, None]


def _separate(
    place: np.ndarray, before: np.ndarray, contact: Contacts, friction: float, pinned: np.ndarray
) -> None:  # fmt: skip
    """Push vertices out along the surface's normal; what they then slide is cut by friction times that push."""
    depth = contact.margin - np.einsum("va,va->v", place - contact.point, contact.normal)
    hit = np.flatnonzero((depth > 0) & ~pinned)
    if not len(hit):
        return
    normal, push = contact.normal[hit], np.minimum(depth[hit, None], contact.most)
    place[hit] += push * normal
    slid = place[hit] - before[hit] - contact.moved[hit]
    slid -= np.einsum("va,va->v", slid, normal)[:, None] * normal
    length = np.sqrt(np.einsum("va,va->v", slid, slid))[:, None]
    place[hit] -= np.minimum(friction * push / np.maximum(length, 1e-12), 1) * slid
