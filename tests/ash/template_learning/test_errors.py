"""The kind of a template's errors, measured where it is known because it was planted."""

import numpy as np
import pytest
from helpers.captures import write_tube_capture

from ash.capture.dataset import TemplateMesh
from ash.config import TemplateConfig
from ash.template.template import PerturbedDeformation, PlantedError, RestDeformation
from ash.template_learning.errors import error_kind, measure_errors
from ash.template_learning.learning import template_of


def fine_mesh() -> TemplateMesh:
    """A wide tube, denser than errors change."""
    height, angle = np.meshgrid(np.linspace(0, 1, 50), np.linspace(0, 2 * np.pi, 60), indexing="ij")
    tube = np.stack([0.3 * np.sin(angle), height, 0.3 * np.cos(angle)], -1).reshape(-1, 3)
    corner = (np.arange(49)[:, None] * 60 + np.arange(59)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 60], 1), np.stack([corner + 1, corner + 61, corner + 60], 1)]
    )
    return TemplateMesh(
        vertices=tube, faces=faces, uvs=np.zeros((1, 2)), uv_faces=0 * faces, skin_weights=np.ones((3000, 1))
    )


@pytest.mark.parametrize(("static", "lag"), [(0.0, 0.0), (0.2, 0.3), (0.5, 0.0), (0.2, 0.7), (0.8, 0.4)])
def test_what_was_planted_is_found_in_few_frames(static: float, lag: float) -> None:
    """Forty frames of four sequences, as a capture has: the mean over so few holds some of what changes."""
    mesh, sequence = fine_mesh(), np.repeat([0, 1, 2, 3], 10)
    found = []
    for seed in range(4):
        planted = PlantedError(rms_mm=5.0, static=static, lag=lag)
        perturbed = PerturbedDeformation(RestDeformation(mesh), mesh, planted, seed=seed)
        errors = np.stack([perturbed.error(frame, int(sequence[frame])) for frame in range(40)])
        found.append(measure_errors(errors, sequence, mesh))
    assert [kind.rms_mm for kind in found] == pytest.approx([5.0] * 4, rel=1e-6)
    assert np.mean([kind.static for kind in found]) == pytest.approx(static, abs=0.05)
    assert np.mean([kind.lag for kind in found]) == pytest.approx(lag, abs=0.07)
    assert np.mean([kind.length_m for kind in found]) == pytest.approx(PerturbedDeformation.LENGTH_M, rel=0.15)


def test_layers_that_lie_on_each_other_err_for_themselves() -> None:
    """A second tube 5 mm inside, with errors of its own: the length is that along either."""
    outer, planted = fine_mesh(), PlantedError(rms_mm=5.0, static=0.0, lag=0.0)
    errors = [
        np.stack([PerturbedDeformation(RestDeformation(outer), outer, planted, seed=seed).error(f) for f in range(30)])
        for seed in (0, 1)
    ]
    both = TemplateMesh(
        vertices=np.concatenate([outer.vertices, outer.vertices * [0.985, 1, 0.985]]),
        faces=np.concatenate([outer.faces, outer.faces + 3000]),
        uvs=outer.uvs,
        uv_faces=outer.uv_faces,
        skin_weights=outer.skin_weights,
    )
    kind = measure_errors(np.concatenate(errors, 1), np.zeros(30, int), both)
    assert kind.length_m == pytest.approx(PerturbedDeformation.LENGTH_M, rel=0.2)


def test_a_template_is_measured_in_canonical_space(tmp_path) -> None:
    capture = write_tube_capture(tmp_path / "capture")
    config = TemplateConfig(kind="exact", error_mm=4.0, error_static=1.0)
    kind = error_kind(template_of(config, capture, seed=0), capture, tuple(range(6)))
    assert kind.rms_mm == pytest.approx(4.0, rel=1e-3) and kind.static == pytest.approx(1.0, abs=1e-3)


def test_no_error_and_a_single_frame_have_a_kind() -> None:
    mesh = fine_mesh()
    none = measure_errors(np.zeros((3, 3000, 3)), np.zeros(3, int), mesh)
    assert (none.rms_mm, none.static, none.length_m) == (0.0, 1.0, np.inf)
    one = measure_errors(np.full((1, 3000, 3), 1e-3), np.zeros(1, int), mesh)
    assert one.rms_mm == pytest.approx(3**0.5) and one.static == 1.0
