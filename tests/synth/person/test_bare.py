from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.scenes import small_scene

from ash.capture.formats import read_template
from synth.capture import make_body
from synth.person.bare import MANNEQUIN_CLOTH, bare_template
from synth.person.dressing import TEMPLATE_VERTICES
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


def test_a_capture_brings_the_bare_body(small_capture: Path):
    joints = len(make_body(small_scene()).skeleton.names)
    found = read_template(small_capture / "body.npz", joints=joints)
    np.testing.assert_array_equal(found.vertices, bare_template(small_scene()).vertices)


@pytest.mark.parametrize("number", [0, 1])
def test_vertices_and_faces_of_the_bare_body_belong_together(number: int) -> None:
    bare = bare_template(replace(scene("tight", size="ci"), subject=number))
    assert len(np.unique(bare.faces)) == len(bare.vertices) == TEMPLATE_VERTICES
    assert len(np.unique(bare.uv_faces)) == len(bare.uvs)
    mesh = trimesh.Trimesh(bare.vertices, bare.faces, process=False)
    assert mesh.edges_unique_length.max() < 0.1  # metres
    assert 1.4 < mesh.area < 2.4  # square metres
