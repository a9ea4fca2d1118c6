import numpy as np
import pytest
from scipy.optimize import brentq

from synth.cloth.checks import self_intersections
from synth.cloth.xpbd import Contacts, Sheet, State, colour, crowd, edges_of, hinges_of, limit_stretch, make_sheet, step


def _grid(rows: int, columns: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A square sheet in the plane z = 0, rows downwards from y = 0."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    vertices = spacing * np.stack([j, -i, 0 * i], axis=-1).reshape(-1, 3).astype(np.float64)
    a = (i * columns + j)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([a, a + columns, a + 1], 1), np.stack([a + 1, a + columns, a + columns + 1], 1)]
    )  # fmt: skip
    return vertices, faces


def _run(sheet: Sheet, state: State, *, seconds: float, steps: int, **options) -> None:
    for _ in range(steps):
        step(sheet, state, seconds=seconds, pins=sheet.rest, **options)


def _still(sheet: Sheet) -> State:
    return State(place=sheet.rest.copy(), velocity=np.zeros_like(sheet.rest))


def test_pairs_of_one_colour_share_no_vertex():
    _, faces = _grid(7, 6, 1.0)
    pairs = np.concatenate([edges_of(faces), hinges_of(faces)])
    colours = colour(pairs)
    assert len(edges_of(faces)) == 7 * 5 + 6 * 6 + 6 * 5 and len(hinges_of(faces)) == len(edges_of(faces)) - 22
    assert colours.max() < 16
    for k in range(colours.max() + 1):
        assert len(np.unique(pairs[colours == k])) == 2 * (colours == k).sum()


def test_a_hanging_strip_comes_to_rest_at_its_own_length():
    rest, faces = _grid(21, 3, 0.02)
    sheet = make_sheet(rest, faces, pinned=rest[:, 1] == 0)
    state = _still(sheet)
    state.place[~sheet.pinned, 1] *= 0.9  # dropped from above
    _run(sheet, state, seconds=1e-3, steps=1200, drag=6.0)
    assert np.abs(state.velocity).max() < 2e-3
    np.testing.assert_allclose(state.place[-3:, 1], -0.4, rtol=0.01)


def test_compliance_is_metres_per_newton():
    """A weight on two elastic threads, 60 degrees from the vertical: statics solved by a root finder."""
    rest = np.array([[-0.1, 0, 0], [0.1, 0, 0], [0, -0.1 / np.sqrt(3), 0]])
    sheet = make_sheet(rest, np.array([[0, 2, 1]]), pinned=np.array([True, True, False]), stretch_compliance=2.0)
    sheet.reach[:] = np.inf
    mass, length = sheet.mass[2], 0.2 / np.sqrt(3)

    def excess(depth: float) -> float:
        now = np.hypot(0.1, depth)
        return 2 * (now - length) / 2.0 * depth / now - mass * 9.81

    state = _still(sheet)
    _run(sheet, state, seconds=1e-3, steps=3000, drag=6.0)
    expected = brentq(excess, 0.1 / np.sqrt(3), 1.0)
    assert expected > 0.0578 + 1e-4
    np.testing.assert_allclose(state.place[2], [0, -expected, 0], atol=1e-4)


def test_energy_does_not_grow():
    rest, faces = _grid(12, 8, 0.03)
    sheet = make_sheet(rest, faces, pinned=rest[:, 1] == 0)
    state = _still(sheet)
    turned = rest[:, [0, 2, 1]] * [1, 1, -1]  # held out horizontally, then let go
    state.place[:] = turned
    energies, lowest = [], 0.0
    for _ in range(700):
        step(sheet, state, seconds=1e-3, pins=turned)
        kinetic = 0.5 * np.sum(sheet.mass[:, None] * state.velocity**2)
        lowest = min(lowest, float(state.place[:, 1].min()))
        energies.append(kinetic + 9.81 * np.sum(sheet.mass * state.place[:, 1]))
    scale = 9.81 * np.sum(sheet.mass) * 0.33
    assert max(energies) < 0.01 * scale
    assert state.place[:, 1].max() > -1e-6 and lowest < -0.3  # It did fall.


def test_a_free_cloth_keeps_its_momentum():
    rest, faces = _grid(8, 8, 0.03)
    sheet = make_sheet(rest, faces, pinned=np.zeros(len(rest), dtype=bool))
    rng = np.random.default_rng(0)
    state = State(place=rest.copy(), velocity=rng.normal(size=rest.shape))
    before = sheet.mass @ state.velocity
    spin = np.sum(sheet.mass[:, None] * np.cross(state.place, state.velocity), axis=0)
    _run(sheet, state, seconds=1e-3, steps=100, weight=0.0)
    np.testing.assert_allclose(sheet.mass @ state.velocity, before, atol=1e-12)
    after = np.sum(sheet.mass[:, None] * np.cross(state.place, state.velocity), axis=0)
    np.testing.assert_allclose(after, spin, atol=0.02 * np.abs(spin).max())
    _run(sheet, state, seconds=1e-3, steps=100)
    np.testing.assert_allclose(sheet.mass @ state.velocity - before, [0, -0.981 * sheet.mass.sum(), 0], atol=1e-12)


def _capsule(place: np.ndarray, radius: float) -> Contacts:
    """A lying capsule around the x axis between -0.1 and 0.1, touched at its nearest points."""
    axis = place * [1, 0, 0]
    axis[:, 0] = np.clip(axis[:, 0], -0.1, 0.1)
    normal = place - axis
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Contacts(
        point=axis + radius * normal, moved=np.zeros_like(place), normal=normal, margin=np.full(len(place), 0.005)
    )


def test_cloth_that_falls_onto_a_capsule_stays_outside_of_it():
    flat, faces = _grid(16, 16, 0.02)
    rest = flat[:, [0, 2, 1]] + [-0.15, 0.1, 0.16]
    sheet = make_sheet(rest, faces, pinned=np.zeros(len(rest), dtype=bool))
    state = _still(sheet)
    for _ in range(400):
        contact = _capsule(state.place, 0.08)
        step(sheet, state, seconds=1e-3, pins=rest, drag=2.0, contacts=(contact,), friction=0.5)
        axis = state.place * [1, 0, 0]
        axis[:, 0] = np.clip(axis[:, 0], -0.1, 0.1)
        assert np.linalg.norm(state.place - axis, axis=1).min() > 0.08
    assert state.place[:, 1].max() < 0.095 and state.place[:, 1].min() < 0.03  # It lies on top and hangs down.


@pytest.mark.parametrize("colliding", [False, True])
def test_cloth_does_not_pass_through_itself(colliding: bool):
    """A strip folded in two whose upper half is thrown through the lower one."""
    flat, faces = _grid(24, 8, 0.02)
    sheet = make_sheet(flat, faces, pinned=flat[:, 1] > -0.2)
    down = -flat[:, 1]
    folded = np.stack([flat[:, 0], np.where(down > 0.23, 0.06, 0.0), np.minimum(down, 0.46 - down)], axis=1)
    state = State(place=folded.copy(), velocity=np.where(down > 0.26, -2.0, 0.0)[:, None] * [0, 1, 0])
    beyond, pierced = [], []
    for _ in range(30):
        crowded = crowd(sheet, state.place, least=0.015, soon=0.015) if colliding else None
        for _ in range(5):
            step(sheet, state, seconds=1e-3, pins=folded, weight=0.0, crowded=crowded)
        beyond.append(np.mean(state.place[down > 0.28, 1] < 0))
        pierced.append(self_intersections(state.place, faces)[down[faces].min(axis=1) > 0.28].mean())
    if colliding:
        assert max(beyond) == 0 and max(pierced) < 0.06 and state.place[down > 0.28, 1].mean() > 0.04
    else:
        assert max(beyond) > 0.5 and max(pierced) > 0.1


def test_pairs_that_are_near_along_the_cloth_do_not_part():
    rest, faces = _grid(12, 12, 0.02)
    sheet = make_sheet(rest, faces, pinned=np.zeros(len(rest), dtype=bool))
    assert not len(crowd(sheet, rest, least=0.013, soon=0.013).pairs)
    rolled = rest * [1, 0.05, 1]
    pairs = crowd(sheet, rolled, least=0.013, soon=0.0).pairs
    assert len(pairs) and np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1).min() > 0.026
    assert np.linalg.norm(rolled[pairs[:, 0]] - rolled[pairs[:, 1]], axis=1).max() <= 0.013


@pytest.mark.parametrize("friction", [0.0, 0.3, 0.8])
def test_cloth_slides_down_a_slope_as_coulomb_says(friction: float):
    """A small sheet on a slope of 30 degrees: it stays above tan 30 = 0.577, else g (sin - mu cos) t^2 / 2."""
    flat, faces = _grid(3, 3, 0.02)
    down, normal = np.array([0, -0.5, np.sqrt(0.75)]), np.array([0, np.sqrt(0.75), 0.5])
    rest = flat[:, :1] * [1, 0, 0] + flat[:, 1:2] * down
    sheet = make_sheet(rest, faces, pinned=np.zeros(len(rest), dtype=bool))
    state = _still(sheet)
    contact = Contacts(
        point=np.zeros_like(rest), moved=np.zeros_like(rest), normal=np.tile(normal, (9, 1)), margin=np.zeros(9)
    )
    _run(sheet, state, seconds=1e-3, steps=400, contacts=(contact,), friction=friction)
    slid = (state.place - rest) @ down
    expected = max(0.5 * 9.81 * (0.5 - friction * np.sqrt(0.75)) * 0.4**2, 0)
    np.testing.assert_allclose(slid, expected, atol=0.01 * 0.4)


def test_strain_limiting_shortens_what_is_too_long_and_leaves_the_rest():
    rest, faces = _grid(6, 6, 0.02)
    sheet = make_sheet(rest, faces, pinned=rest[:, 1] == 0)
    fine, long = rest.copy(), rest * [1.0, 1.15, 1.0]
    limit_stretch(sheet, fine, most=1.04, rounds=5)
    np.testing.assert_array_equal(fine, rest)
    limit_stretch(sheet, long, most=1.04, rounds=200)
    a, b = edges_of(faces).T
    lengths = np.linalg.norm(long[a] - long[b], axis=1) / np.linalg.norm(rest[a] - rest[b], axis=1)
    assert lengths.max() < 1.043


def test_wrong_materials_are_refused():
    rest, faces = _grid(3, 3, 0.1)
    free = np.zeros(9, dtype=bool)
    for wrong in ({"density": -1.0}, {"density": np.nan}, {"stretch_compliance": -1e-3}, {"bend_compliance": np.nan}):
        with pytest.raises(ValueError, match="expected 0 or more"):
            make_sheet(rest, faces, pinned=free, **wrong)
    with pytest.raises(ValueError, match="not finite"):
        make_sheet(np.where(rest == 0.1, np.nan, rest), faces, pinned=free)
    with pytest.raises(ValueError, match="no face"):
        make_sheet(np.concatenate([rest, [[5.0, 5, 5]]]), faces, pinned=np.zeros(10, dtype=bool))
