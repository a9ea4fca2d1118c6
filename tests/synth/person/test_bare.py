from pathlib import Path

import numpy as np
import pytest

from ash.capture.formats import read_template
from synth.capture import describe, make_body
from synth.person.bare import MANNEQUIN_CLOTH, bare_template
from synth.presets import scene


def test_the_bare_mannequin_lies_inside_its_clothes_and_wears_no_skirt():
    named = scene("mannequin", size="ci")
    bare, dressed = bare_template(named), make_body(named)
    skirted = dressed.surface.vertices_of("skirt")[dressed.template_to_surface]
    assert len(bare.vertices) == len(dressed.template_to_surface) - skirted.sum()
    inwards = np.linalg.norm(dressed.surface.vertices[dressed.template_to_surface][~skirted] - bare.vertices, axis=1)
    shirt = dressed.surface.vertices_of("shirt", "trousers")[dressed.template_to_surface][~skirted]
    assert inwards[shirt] == pytest.approx(MANNEQUIN_CLOTH, rel=1e-6)
    assert inwards[~shirt] == pytest.approx(0, abs=1e-12)
    hips = (bare.vertices[:, 1] > 0.6) & (bare.vertices[:, 1] < 0.8) & (np.abs(bare.vertices[:, 0]) < 0.3)
    assert np.abs(bare.vertices[hips, 2]).max() < 0.12 < np.abs(dressed.surface.vertices[:, 2]).max()


def test_a_capture_brings_the_bare_body(tmp_path: Path):
    named = scene("skinned", size="ci")
    describe(named, tmp_path)
    joints = len(make_body(named).skeleton.names)
    np.testing.assert_array_equal(
        read_template(tmp_path / "body.npz", joints=joints).vertices, bare_template(named).vertices
    )
