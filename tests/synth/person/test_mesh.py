import numpy as np

from synth.person.mannequin import mannequin
from synth.person.mesh import Charted, decimate, locked_vertices, pack, subdivide, uv_charts
from synth.person.texture import rasterize_charts


def _plane(n: int = 9) -> Charted:
    """A flat square of n x n vertices with one chart and two parts."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    a, b, c, d = (((i + di) * n + j + dj).ravel() for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    part = (grid[faces].mean(axis=1)[:, 0] > 0.5).astype(np.int64)
    vertices = np.concatenate([grid, np.zeros((n * n, 1))], axis=1)
    weights = np.stack([grid[:, 0], 1 - grid[:, 0]], axis=1)
    return Charted(vertices=vertices, weights=weights, faces=faces, uvs=grid, uv_faces=faces, part=part)


def _area(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area of triangles; signed in the plane."""
    if points.shape[1] == 3:
        a, b, c = (points[faces[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    (ax, ay), (bx, by), (cx, cy) = (points[faces[:, k]].T for k in range(3))
    return ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / 2


def _edges_are_shared_by_at_most_two(faces: np.ndarray) -> bool:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool(np.unique(edges, axis=0, return_counts=True)[1].max() <= 2)


def test_subdividing_a_part_opens_no_crack():
    mesh = _plane()
    fine = subdivide(mesh, mesh.part == 1)
    assert np.isclose(_area(fine.vertices, fine.faces).sum(), 1.0)
    assert _edges_are_shared_by_at_most_two(fine.faces)
    np.testing.assert_array_equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)
    np.testing.assert_allclose(fine.weights[:, 0], fine.vertices[:, 0], atol=1e-15)
    np.testing.assert_allclose(fine.uvs[fine.uv_faces], fine.vertices[fine.faces][..., :2], atol=1e-15)
    # No vertex lies in the middle of an edge: the boundary of the square is all that is used once.
    edges = np.sort(fine.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    middles = fine.vertices[unique[count == 1]].mean(axis=1)
    assert ((middles[:, :2] < 1e-12) | (middles[:, :2] > 1 - 1e-12)).any(axis=1).all()


def test_decimating_keeps_borders_and_parts():
    mesh = _plane(15)
    faces, uv_faces = decimate(mesh, target=90, keep=np.ones(len(mesh.vertices)))
    kept = np.unique(faces)
    assert len(kept) == 90
    assert set(np.flatnonzero(locked_vertices(mesh))) <= set(kept)
    assert np.isclose(_area(mesh.vertices, faces).sum(), 1.0)
    assert (_area(mesh.uvs, uv_faces) > 0).all()
    np.testing.assert_allclose(mesh.uvs[uv_faces], mesh.vertices[faces][..., :2])
    assert _edges_are_shared_by_at_most_two(faces)


def test_decimating_loses_the_flat_and_keeps_the_bump():
    mesh = _plane(15)
    vertices = mesh.vertices.copy()
    bump = np.linalg.norm(vertices[:, :2] - [0.25, 0.5], axis=1) < 0.13
    vertices[bump, 2] = 0.2
    mesh = Charted(
        vertices=vertices, weights=mesh.weights, faces=mesh.faces, uvs=mesh.uvs, uv_faces=mesh.uv_faces, part=mesh.part
    )
    faces, _ = decimate(mesh, target=110, keep=np.ones(len(vertices)))
    assert bump[np.unique(faces)].sum() >= 0.6 * bump.sum()


def test_packed_charts_keep_their_shape_and_never_overlap():
    body = mannequin(skirt=True)
    surface = body.surface
    mesh = Charted(
        vertices=surface.vertices, weights=body.skin_weights, faces=surface.faces, uvs=surface.uvs,
        uv_faces=surface.uv_faces, part=surface.part,
    )  # fmt: skip
    chart = uv_charts(mesh.uv_faces, mesh.part)
    packed = pack(mesh, chart, np.ones(chart.max() + 1), gutter=0.004)
    assert packed.uvs.min() >= 0 and packed.uvs.max() <= 1
    before, after = (np.abs(_area(m.uvs, m.uv_faces)) for m in (mesh, packed))
    for k in range(chart.max() + 1):
        ratio = after[chart == k] / before[chart == k]
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    rows, columns, _, _ = rasterize_charts(packed.uvs, packed.uv_faces, 512)
    texels = rows * 512 + columns
    assert len(np.unique(texels)) / len(texels) > 0.998  # Texel centres on an edge may count for both faces.
    assert len(texels) / 512**2 > 0.45


def test_rasterised_charts_know_their_barycentrics():
    mesh = _plane()
    rows, columns, face, weights = rasterize_charts(0.1 + 0.8 * mesh.uvs, mesh.uv_faces, 64)
    points = np.einsum("nk,nka->na", weights, mesh.uvs[mesh.uv_faces[face]])
    np.testing.assert_allclose((0.1 + 0.8 * points) * 64, np.stack([columns + 0.5, 64 - rows - 0.5], 1), atol=1e-9)
    assert abs(len(np.unique(rows * 64 + columns)) / 64**2 - 0.64) < 0.03
