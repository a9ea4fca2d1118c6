import numpy as np

from synth.person.body import PARTS
from synth.person.garments import HEM, THICKNESS, cut_garment, straightened
from synth.person.mesh import Charted, beside, joined, largest_piece, open_edges, select, uv_charts
from synth.person.tubes import chart_uvs, grid_faces

ROWS, COLUMNS, RADIUS = 25, 32, 0.1


def _limb() -> Charted:
    """An upright cylinder, 0.48 m long, open at both ends, unrolled in one chart."""
    height, angle = np.meshgrid(0.02 * np.arange(ROWS), 2 * np.pi * np.arange(COLUMNS) / COLUMNS, indexing="ij")
    vertices = np.stack([RADIUS * np.sin(angle), height, RADIUS * np.cos(angle)], axis=-1).reshape(-1, 3)
    faces = grid_faces(ROWS, COLUMNS, stride=COLUMNS, wrap=COLUMNS)
    share = vertices[:, 1] / 0.48
    return Charted(
        vertices=vertices,
        weights=np.stack([share, 1 - share], axis=1),
        faces=faces if _outwards(vertices, faces) else faces[:, ::-1],
        uvs=chart_uvs(ROWS, COLUMNS),
        uv_faces=_uv_faces(_outwards(vertices, faces)),
        part=np.full(len(faces), PARTS.index("skin")),
    )


def _outwards(vertices: np.ndarray, faces: np.ndarray) -> bool:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return bool(np.sum(np.cross(b - a, c - a) * (a + b + c) * [1, 0, 1]) > 0)


def _uv_faces(forwards: bool) -> np.ndarray:
    faces = grid_faces(ROWS, COLUMNS, stride=COLUMNS + 1, wrap=COLUMNS + 1)
    return faces if forwards else faces[:, ::-1]


def _sleeve() -> tuple[Charted, Charted, np.ndarray]:
    """A sleeve over the middle of the limb, its lower hem cut in steps."""
    bare = _limb()
    centre = bare.vertices[bare.faces].mean(axis=1)
    steps = np.where(np.sin(6 * np.arctan2(centre[:, 0], centre[:, 2])) > 0, 0.12, 0.14)
    chosen = (centre[:, 1] > steps) & (centre[:, 1] < 0.36)
    garment, source = cut_garment(bare, chosen, name="shirt", fit="loose")
    return bare, garment, source


def test_a_garment_lies_over_the_body_and_closer_at_its_hems():
    bare, garment, source = _sleeve()
    radius = np.linalg.norm(garment.vertices[:, [0, 2]], axis=1)
    height = garment.vertices[:, 1]
    middle = np.abs(height - 0.25) < 0.01
    np.testing.assert_allclose(radius[middle], RADIUS + THICKNESS["loose"]["shirt"], atol=0.002)
    rim = np.unique(open_edges(garment.faces))
    np.testing.assert_allclose(radius[rim], RADIUS + 0.001, atol=0.002)
    hem = np.setdiff1d(
        np.unique(garment.faces[beside(garment.faces, np.isin(garment.faces, rim).any(axis=1), rings=0)]), rim
    )
    at_hem = hem[np.abs(height[hem] - np.median(height[hem[height[hem] > 0.3]])) < 1e-3]
    np.testing.assert_allclose(radius[at_hem], RADIUS + HEM["shirt"], atol=0.002)
    assert (garment.part == PARTS.index("shirt")).all()
    np.testing.assert_allclose(garment.weights.sum(axis=1), 1, atol=1e-12)
    # A face of the garment is where its face of the body is; a rim's is next to it.
    near = garment.vertices[garment.faces].mean(axis=1) - bare.vertices[bare.faces[source]].mean(axis=1)
    assert np.linalg.norm(near, axis=1).max() < 0.035


def test_a_garment_is_a_surface_closed_towards_the_body():
    _, garment, _ = _sleeve()
    sides = np.sort(garment.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    directed = garment.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)  # All faces turn the same way around.
    assert np.unique(sides, axis=0, return_counts=True)[1].max() == 2
    a, b, c = (garment.uvs[garment.uv_faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert -area[area < 0].sum() < 0.002 * area.sum()  # Hardly any rim is folded over its chart.
    assert uv_charts(garment.uv_faces, np.zeros(len(area), dtype=np.int64)).max() == 0


def test_hems_are_straightened_and_do_not_shrink():
    angle = 2 * np.pi * np.arange(40) / 40
    circle = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    stepped = circle + [0, 0.1, 0] * (np.arange(40) % 2)[:, None]
    edges = np.stack([np.arange(40), (np.arange(40) + 1) % 40], axis=1)
    result = straightened(stepped, edges)
    assert np.ptp(result[:, 1]) < 0.02
    np.testing.assert_allclose(np.linalg.norm(result[:, [0, 2]], axis=1), 1, atol=0.02)


def test_pieces_are_joined_and_selected_without_renumbering():
    bare, garment, _ = _sleeve()
    both = joined([bare, garment])
    assert len(both.faces) == len(bare.faces) + len(garment.faces)
    np.testing.assert_array_equal(both.vertices[both.faces[len(bare.faces) :]], garment.vertices[garment.faces])
    np.testing.assert_array_equal(both.uvs[both.uv_faces[len(bare.faces) :]], garment.uvs[garment.uv_faces])
    low = bare.vertices[bare.faces].mean(axis=1)[:, 1] < 0.1
    assert len(select(bare, low).faces) == low.sum()
    high = bare.vertices[bare.faces].mean(axis=1)[:, 1] > 0.4
    assert high.sum() < low.sum()
    np.testing.assert_array_equal(largest_piece(bare.faces, low | high), low)
    assert low.sum() < beside(bare.faces, low, rings=1).sum() < beside(bare.faces, low, rings=2).sum()
