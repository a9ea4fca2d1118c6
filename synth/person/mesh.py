"""Mesh surgery at rest: finer surfaces, coarser templates, and charts packed into one atlas."""

import heapq
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True, slots=True)
class Charted:
    """Triangles over vertices and over UVs, with values that are interpolated when an edge is split."""

    vertices: np.ndarray  # [s, 3]
    weights: np.ndarray  # [s, j] skin weights
    faces: np.ndarray  # [f, 3]
    uvs: np.ndarray  # [u, 2]
    uv_faces: np.ndarray  # [f, 3]
    part: np.ndarray  # [f]


def subdivide(mesh: Charted, chosen: np.ndarray) -> Charted:
    """Split the edges of the chosen faces `[f]` bool in half; neighbours are cut so that no crack opens.

    Old vertices and UVs keep their indices, new ones follow.
    """
    edges = np.sort(np.stack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]], axis=1), axis=2)
    unique, edge = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    edge = edge.reshape(-1, 3)
    split = np.zeros(len(unique), dtype=bool)
    split[edge[chosen]] = True
    while True:  # A face with two split edges gets the third one too: only whole and single splits remain.
        two = split[edge].sum(axis=1) == 2
        if not two.any():
            break
        split[edge[two]] = True
    middle = len(mesh.vertices) + np.cumsum(split) - 1
    halves = unique[split]
    vertices = np.concatenate([mesh.vertices, mesh.vertices[halves].mean(axis=1)])
    weights = np.concatenate([mesh.weights, mesh.weights[halves].mean(axis=1)])
    uv_edges = np.sort(
        np.stack([mesh.uv_faces[:, [0, 1]], mesh.uv_faces[:, [1, 2]], mesh.uv_faces[:, [2, 0]]], axis=1), axis=2
    )
    uv_split = split[edge]
    uv_unique, uv_inverse = np.unique(uv_edges[uv_split], axis=0, return_inverse=True)
    uv_middle = np.zeros(edge.shape, dtype=np.int64)
    uv_middle[uv_split] = len(mesh.uvs) + uv_inverse.ravel()
    uvs = np.concatenate([mesh.uvs, mesh.uvs[uv_unique].mean(axis=1)])
    faces, uv_faces, part = _cut(mesh, split[edge], middle[edge], uv_middle)
    return Charted(vertices=vertices, weights=weights, faces=faces, uvs=uvs, uv_faces=uv_faces, part=part)


def _cut(
    mesh: Charted, split: np.ndarray, middle: np.ndarray, uv_middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = split.sum(axis=1)
    pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    none, whole = count == 0, count == 3
    pieces.append((mesh.faces[none], mesh.uv_faces[none], mesh.part[none]))
    corners = np.concatenate([mesh.faces, middle], axis=1)  # a b c, then the middles of ab bc ca
    uv_corners = np.concatenate([mesh.uv_faces, uv_middle], axis=1)
    for triangle in ([0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]):
        pieces.append((corners[whole][:, triangle], uv_corners[whole][:, triangle], mesh.part[whole]))
    for k in range(3):
        one = (count == 1) & split[:, k]
        a, b, c, m = k, (k + 1) % 3, (k + 2) % 3, 3 + k
        for triangle in ([a, m, c], [m, b, c]):
            pieces.append((corners[one][:, triangle], uv_corners[one][:, triangle], mesh.part[one]))
    faces, uv_faces, part = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    return faces, uv_faces, part


def open_sides(faces: np.ndarray) -> np.ndarray:
    """Sides that only one face has, as 3 face + corner: from that corner to the next."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    numbers = sides[:, 0] * (faces.max(initial=0) + 1) + sides[:, 1]  # One number per side: rows sort ten times slower.
    _, inverse, uses = np.unique(numbers, return_inverse=True, return_counts=True)
    return np.flatnonzero(uses[inverse] == 1)


def open_edges(faces: np.ndarray) -> np.ndarray:
    """Edges `[e, 2]` that only one face has, in its direction."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)[open_sides(faces)]


def beside(faces: np.ndarray, chosen: np.ndarray, *, rings: int) -> np.ndarray:
    """The chosen faces and some rings of faces around them, `[f]` bool."""
    for _ in range(rings):
        chosen = np.asarray(np.isin(faces, faces[chosen]).any(axis=1))
    return chosen


def largest_piece(faces: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Of the chosen faces `[f]` bool, the connected piece that has the most."""
    piece = uv_charts(faces[chosen], np.zeros(chosen.sum(), dtype=np.int64))
    result = np.zeros(len(faces), dtype=bool)
    result[np.flatnonzero(chosen)[piece == np.argmax(np.bincount(piece))]] = True
    return result


def select(mesh: Charted, chosen: np.ndarray) -> Charted:
    """Only the chosen faces `[f]`; all vertices and UVs stay."""
    return replace(mesh, faces=mesh.faces[chosen], uv_faces=mesh.uv_faces[chosen], part=mesh.part[chosen])


def joined(pieces: list[Charted]) -> Charted:
    """Several meshes as one; nothing is shared between them."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    uv_starts = np.cumsum([0, *(len(piece.uvs) for piece in pieces)])
    return Charted(
        vertices=np.concatenate([piece.vertices for piece in pieces]),
        weights=np.concatenate([piece.weights for piece in pieces]),
        faces=np.concatenate([start + piece.faces for start, piece in zip(starts, pieces, strict=False)]),
        uvs=np.concatenate([piece.uvs for piece in pieces]),
        uv_faces=np.concatenate([start + piece.uv_faces for start, piece in zip(uv_starts, pieces, strict=False)]),
        part=np.concatenate([piece.part for piece in pieces]),
    )


def locked_vertices(mesh: Charted) -> np.ndarray:
    """Vertices on a boundary, a chart's border or between two parts, `[s]` bool: a coarser mesh must keep them."""
    locked = np.zeros(len(mesh.vertices), dtype=bool)
    pairs = np.unique(np.stack([mesh.faces.ravel(), mesh.uv_faces.ravel()], axis=1), axis=0)
    locked |= np.bincount(pairs[:, 0], minlength=len(locked)) > 1
    parts = np.unique(np.stack([mesh.faces.ravel(), np.repeat(mesh.part, 3)], axis=1), axis=0)
    locked |= np.bincount(parts[:, 0], minlength=len(locked)) > 1
    locked[open_edges(mesh.faces)] = True
    return locked


def decimate(mesh: Charted, *, target: int, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Collapse vertices onto neighbours, flattest first, until `target` vertices are left.

    `keep` `[s]` scales the cost of losing a vertex. Charts, parts and boundaries stay. Returns faces and UV faces
    into the mesh's own vertices and UVs.
    """
    work = _Collapser(mesh, keep)
    work.run(target)
    left = [index for index, face in enumerate(work.faces) if face]
    return np.array([work.faces[index] for index in left]), np.array([work.uv_faces[index] for index in left])


class _Collapser:
    """Greedy half-edge collapse on quadric error. Plain floats: the arrays would all be tiny."""

    def __init__(self, mesh: Charted, keep: np.ndarray) -> None:
        self.position = [tuple(point) for point in mesh.vertices.tolist()]
        self.locked = locked_vertices(mesh).tolist()
        self.keep = keep.tolist()
        self.faces: list[list[int]] = mesh.faces.tolist()  # an empty list: collapsed
        self.uv_faces: list[list[int]] = mesh.uv_faces.tolist()
        self.around: list[set[int]] = [set() for _ in self.position]
        for index, face in enumerate(self.faces):
            for corner in face:
                self.around[corner].add(index)
        self.quadrics = _quadrics(mesh).tolist()
        self.stamp = [0] * len(self.position)

    def run(self, target: int) -> None:
        alive = sum(1 for faces in self.around if faces)
        heap: list[tuple[float, int, int, int]] = []
        for vertex in range(len(self.position)):
            self._push(heap, vertex)
        while alive > target and heap:
            _, vertex, other, stamp = heapq.heappop(heap)
            if self.stamp[vertex] != stamp or not self.around[vertex]:
                continue
            neighbours = {corner for index in self.around[vertex] for corner in self.faces[index]} - {vertex}
            self._collapse(vertex, other)
            alive -= 1
            for neighbour in neighbours:
                self.stamp[neighbour] += 1
                self._push(heap, neighbour)

    def _push(self, heap: list[tuple[float, int, int, int]], vertex: int) -> None:
        if self.locked[vertex] or not self.around[vertex]:
            return
        ring = {corner for index in self.around[vertex] for corner in self.faces[index]} - {vertex}
        choices = sorted((self._cost(vertex, other), other) for other in ring)
        for cost, other in choices:
            if self._is_allowed(vertex, other, ring):
                heapq.heappush(heap, (cost, vertex, other, self.stamp[vertex]))
                return

    def _cost(self, vertex: int, other: int) -> float:
        x, y, z = self.position[other]
        a = self.quadrics[vertex]
        b = self.quadrics[other]
        q = [p + r for p, r in zip(a, b, strict=True)]
        flat = (
            x * (q[0] * x + 2 * (q[1] * y + q[2] * z + q[3]))
            + y * (q[4] * y + 2 * (q[5] * z + q[6]))
            + z * (q[7] * z + 2 * q[8])
            + q[9]
        )
        u, v, w = self.position[vertex]
        length = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        return self.keep[vertex] * (max(flat, 0.0) + 1e-4 * length * length)

    def _is_allowed(self, vertex: int, other: int, ring: set[int]) -> bool:
        """The collapse keeps the mesh a surface, and turns no face by more than 60 degrees."""
        shared = [index for index in self.around[vertex] if other in self.faces[index]]
        far = {corner for index in self.around[other] for corner in self.faces[index]}
        if len(shared) != 2 or len((far & ring) - {other}) != 2:
            return False
        for index in self.around[vertex]:
            if index in shared:
                continue
            old = [self.position[corner] for corner in self.faces[index]]
            new = [self.position[other if corner == vertex else corner] for corner in self.faces[index]]
            n, m = _cross(*old), _cross(*new)
            sizes = (n[0] ** 2 + n[1] ** 2 + n[2] ** 2) * (m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
            turn = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
            if sizes < 1e-32 or turn <= 0 or turn * turn < 0.25 * sizes:
                return False
        return True

    def _collapse(self, vertex: int, other: int) -> None:
        shared = [index for index in self.around[vertex] if other in self.faces[index]]
        uv = self.uv_faces[shared[0]][self.faces[shared[0]].index(other)]
        for index in sorted(self.around[vertex]):
            if index in shared:
                for corner in self.faces[index]:
                    self.around[corner].discard(index)
                self.faces[index] = []
            else:
                place = self.faces[index].index(vertex)
                self.faces[index][place] = other
                self.uv_faces[index][place] = uv
                self.around[other].add(index)
        self.around[vertex] = set()
        self.quadrics[other] = [p + q for p, q in zip(self.quadrics[other], self.quadrics[vertex], strict=True)]


def _cross(a: tuple[float, ...], b: tuple[float, ...], c: tuple[float, ...]) -> tuple[float, float, float]:
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _quadrics(mesh: Charted) -> np.ndarray:
    """Sum of squared distances to the planes around each vertex, as the upper triangle `[s, 10]` of a 4x4 matrix."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-18)[:, None]
    planes = np.concatenate([normal, -np.sum(normal * a, axis=1, keepdims=True)], axis=1)
    rows, columns = np.triu_indices(4)
    entries = area[:, None] * planes[:, rows] * planes[:, columns]
    quadrics = np.zeros((len(mesh.vertices), 10))
    for k in range(3):
        np.add.at(quadrics, mesh.faces[:, k], entries)
    return quadrics


def uv_charts(uv_faces: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Chart of each face: faces of one group that are connected in UV space, `[f]` numbered from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(uv_faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(uv_faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    first, second = owner[order[:-1]][same], owner[order[1:]][same]
    linked = group[first] == group[second]
    links = coo_matrix((np.ones(linked.sum()), (first[linked], second[linked])), shape=(len(uv_faces),) * 2)
    return connected_components(links, directed=False)[1]


def pack(mesh: Charted, chart: np.ndarray, density: np.ndarray, *, gutter: float) -> Charted:
    """Lay the charts out in one unit square: each scaled to its density (texels per metre, relative), then shelved.

    `gutter` is the free border around a chart in the units of the final square.
    """
    uvs, uv_faces = _separate(mesh, chart)
    boxes, scaled = [], uvs.copy()
    for k in range(chart.max() + 1):
        inside = np.unique(uv_faces[chart == k])
        flat = np.concatenate([uvs, np.zeros((len(uvs), 1))], axis=1)
        scale = np.sqrt(_area(mesh.vertices, mesh.faces[chart == k]) / _area(flat, uv_faces[chart == k])) * density[k]
        part = uvs[inside] * scale
        part -= part.min(axis=0)
        if part[:, 1].max() > part[:, 0].max():  # Lie down, so that shelves are low and full.
            part = np.stack([part[:, 1], part[:, 0].max() - part[:, 0]], axis=1)
        scaled[inside] = part
        boxes.append(part.max(axis=0))
    sizes = np.array(boxes)
    side = np.sqrt(sizes.prod(axis=1).sum())
    while (corners := _shelve(sizes + 2 * gutter * side, side)) is None:
        side *= 1.01
    for k in range(chart.max() + 1):
        inside = np.unique(uv_faces[chart == k])
        scaled[inside] = (scaled[inside] + corners[k] + gutter * side) / side
    return Charted(
        vertices=mesh.vertices, weights=mesh.weights, faces=mesh.faces, uvs=scaled, uv_faces=uv_faces, part=mesh.part
    )


def _separate(mesh: Charted, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List a UV once per chart that uses it."""
    pairs = np.stack([mesh.uv_faces.ravel(), np.repeat(chart, 3)], axis=1)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    return mesh.uvs[unique[:, 0]], inverse.reshape(-1, 3)


def _area(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _shelve(sizes: np.ndarray, side: float) -> np.ndarray | None:
    """Lower left corners of boxes put on shelves, highest first, or None where they do not fit into the square."""
    corners = np.zeros((len(sizes), 2))
    shelves: list[list[float]] = []  # bottom, height, filled width
    top = 0.0
    for k in np.argsort(-sizes[:, 1], kind="stable"):
        width, height = sizes[k]
        shelf = next((s for s in shelves if s[2] + width <= side), None)
        if shelf is None:
            shelf = [top, height, 0.0]
            shelves.append(shelf)
            top += height
        if width > side or top > side:
            return None
        corners[k] = [shelf[2], shelf[0]]
        shelf[2] += width
    return corners
