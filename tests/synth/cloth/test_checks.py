from pathlib import Path

import numpy as np

from ash.capture.formats import read_surface_truth
from ash.files import read_arrays
from synth.cloth.checks import penetrations, self_intersections, stretch
from synth.person.mannequin import mannequin

BODY = mannequin(skirt=True)
SKIRT = BODY.surface.vertices_of("skirt")


def test_legs_that_poke_through_are_found_and_measured():
    rest = BODY.surface.vertices
    tight = rest.copy()
    tight[SKIRT] *= [0.5, 1, 0.5]  # a skirt of half the width: the thighs stick out at the sides
    found = penetrations(BODY, np.stack([rest, tight]))
    assert found.share[0] == 0 and found.deepest[0] < 0.005
    assert found.share[1] > 0.05 and found.deepest[1] > 0.01


def test_stretch_is_relative_to_rest():
    rest = BODY.surface.vertices
    np.testing.assert_allclose(stretch(BODY, np.stack([rest, 1.2 * rest]), "skirt"), [1.0, 1.2])


def test_cloth_that_passes_through_itself_is_found():
    """Two triangles that cross at a right angle, and the same ones apart."""
    one, two = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0]]), np.array([[0, 1, 2], [3, 4, 5]])
    far = np.concatenate([one, one[:, [2, 1, 0]] + [0.4, 0.1, -0.2]])
    assert self_intersections(far, two).any()
    assert not self_intersections(far + np.repeat([[0, 0, 0], [0, 0, 2]], 3, axis=0), two).any()
    assert not self_intersections(BODY.surface.vertices[BODY.cage], BODY.cage_faces).any()


def test_a_capture_tells_what_its_clothes_do_in_every_frame(small_capture: Path):
    folder = small_capture
    told = read_arrays(folder / "truth" / "clothes.npz", expected=("penetrating", "penetration_mm", "stretch"))
    posed = np.stack([read_surface_truth(folder, frame) for frame in range(5)]).astype(np.float64)
    np.testing.assert_allclose(told["stretch"], stretch(BODY, posed, "skirt"), atol=1e-5)
    np.testing.assert_allclose(told["penetration_mm"], 1000 * penetrations(BODY, posed).deepest, atol=1e-3)
    assert told["stretch"].max() < 1.08 and told["penetrating"].max() < 0.01
