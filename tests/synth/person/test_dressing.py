"""The dressed body: the realistic person as captures have it."""

import numpy as np
import pytest

from synth.person.body import PARTS
from synth.person.dressing import TEMPLATE_VERTICES, anny_body


@pytest.mark.timeout(600)  # The first body of a machine is baked with 31 others.
@pytest.mark.parametrize(("skirt", "number"), [(True, 0), (False, 100)])
def test_a_dressed_body_is_one_surface_with_a_template_on_it(skirt: bool, number: int):
    body = anny_body(skirt=skirt, number=number)
    surface, template = body.surface, body.template()
    assert np.array_equal(np.unique(surface.faces), np.arange(len(surface.vertices)))
    assert np.array_equal(np.unique(surface.uv_faces), np.arange(len(surface.uvs)))
    assert surface.uvs.min() >= 0 and surface.uvs.max() <= 1
    assert (PARTS.index("skirt") in surface.part) == skirt == (len(body.cage) > 0)
    np.testing.assert_allclose(body.skin_weights.sum(axis=1), 1, atol=1e-6)
    assert np.array_equal(template.vertices, surface.vertices[body.template_to_surface])
    assert len(template.vertices) == pytest.approx(TEMPLATE_VERTICES, rel=0.02)
    assert np.array_equal(np.unique(template.faces), np.arange(len(template.vertices)))
    # A person of ordinary height, and a template whose triangles are small: it follows the surface.
    assert 1.3 < np.ptp(surface.vertices[:, 1]) < 2.1
    edges = template.vertices[template.faces] - template.vertices[np.roll(template.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() < 0.3
