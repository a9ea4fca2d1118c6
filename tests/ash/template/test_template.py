import itertools

import numpy as np
import pytest
import torch
from helpers.captures import tube_template
from helpers.figures import tube_mesh, tube_motion, tube_skeleton

from ash.capture.dataset import Motion, Pose
from ash.capture.formats import read_template_truth
from ash.config import TemplateConfig
from ash.files import InputError
from ash.template.template import (
    KnownDeformation,
    PerturbedDeformation,
    PlantedError,
    RestDeformation,
    Template,
    exact_template,
    vertex_normals,
)


def test_rest_pose_reproduces_the_mesh():
    still = Motion(dofs=np.zeros((1, 9)), sequence=np.zeros(1, dtype=np.int64), fps=25.0)
    posed = tube_template().pose(Pose(still, 0))
    np.testing.assert_allclose(posed.vertices.numpy(), tube_mesh().vertices, atol=1e-6)


def test_known_surface_is_met_exactly_through_skinning():
    motion = tube_motion()
    skinned = np.stack([tube_template().pose(Pose(motion, f)).vertices.numpy() for f in range(6)])
    truth = skinned + 0.05 * np.random.default_rng(1).standard_normal(skinned.shape)
    exact = Template(tube_mesh(), tube_skeleton(), KnownDeformation(motion, truth))
    for frame in range(6):
        np.testing.assert_allclose(exact.pose(Pose(motion, frame)).vertices.numpy(), truth[frame], atol=1e-6)


def test_known_surface_refuses_another_motion():
    exact = Template(tube_mesh(), tube_skeleton(), KnownDeformation(tube_motion(), np.zeros((6, 108, 3))))
    with pytest.raises(InputError, match="known only for the motion of the capture"):
        exact.pose(Pose(tube_motion(seed=9), 2))


def test_normals_of_a_tube_point_away_from_its_axis():
    mesh = tube_mesh()
    normals = vertex_normals(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)).numpy()
    outward = mesh.vertices * [1, 0, 1] / 0.1
    assert ((normals * outward).sum(1) > 0.99).all()


def test_kept_frames_do_not_mix_up_motions():
    template = tube_template()
    a, b = tube_motion(seed=1), tube_motion(seed=2)
    first = template.pose(Pose(a, 3)).vertices.clone()
    assert not torch.allclose(template.pose(Pose(b, 3)).vertices, first)
    torch.testing.assert_close(template.pose(Pose(a, 3)).vertices, first)


def errors_m(capture, error_mm: float, seed: int = 0, **kind) -> np.ndarray:
    truth = read_template_truth(capture)
    template = exact_template(capture, truth, planted=PlantedError(rms_mm=error_mm, **kind), seed=seed)
    posed = np.stack([template.pose(Pose(capture.motion, frame)).vertices.numpy() for frame in range(6)])
    return posed.astype(np.float64) - truth


def planted(seed: int = 0, *, static: float = 0.2, lag: float = 0.3) -> PerturbedDeformation:
    kind = PlantedError(rms_mm=8.0, static=static, lag=lag)
    return PerturbedDeformation(RestDeformation(tube_mesh()), tube_mesh(), kind, seed=seed)


@pytest.mark.parametrize("kind", [{}, {"static": 1.0}, {"static": 0.0, "lag": 0.9}])
def test_a_planted_error_has_exactly_the_stated_rms_in_every_posed_frame(capture, kind):
    for error_mm in (2.0, 16.0):
        rms_mm = 1e3 * np.sqrt((errors_m(capture, error_mm, **kind) ** 2).sum(-1).mean(-1))
        np.testing.assert_allclose(rms_mm, error_mm, rtol=1e-4)


def test_a_planted_error_of_zero_is_the_exact_surface(capture):
    np.testing.assert_allclose(errors_m(capture, 0.0), 0, atol=1e-6)


@pytest.mark.parametrize("static", [0.0, 0.7])
def test_the_stated_share_of_a_planted_errors_square_is_the_same_in_all_frames(static):
    perturbed = planted(3, static=static)
    errors = np.stack([perturbed.error(frame) for frame in range(400)])
    assert (errors.mean(0) ** 2).sum(1).mean() / 8e-3**2 == pytest.approx(static, abs=0.02)


@pytest.mark.parametrize("lag", [0.0, -0.4, 0.9])
def test_what_changes_of_a_planted_error_falls_off_as_stated_in_time(lag):
    perturbed = planted(3, lag=lag)
    static = 8e-3 * np.sqrt(0.2) * perturbed.static
    own = np.stack([perturbed.error(frame) for frame in range(300)]) - static
    for apart in (1, 2, 3):
        alike = (own[:-apart] * own[apart:]).sum() / np.sqrt((own[:-apart] ** 2).sum() * (own[apart:] ** 2).sum())
        assert alike == pytest.approx(lag**apart, abs=0.05)


def test_sequences_err_for_themselves(capture):
    """Frames 3 and 4 of the capture follow each other in no sequence: only what is static is common to them."""
    errors = errors_m(capture, 8.0, static=0.0, lag=0.95)
    alike = [(a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()) for a, b in itertools.pairwise(errors)]
    assert capture.motion.sequence.tolist() == [0, 0, 0, 0, 1, 1]
    assert min(alike[0], alike[4]) > 0.6 and abs(alike[3]) < 0.4


def test_a_planted_error_is_smooth_and_a_function_of_the_seed_and_the_frame():
    """Whatever frames were asked for before."""

    def error(frame: int, seed: int) -> np.ndarray:
        return planted(seed).error(frame)

    backwards = planted()
    last = [backwards.error(frame) for frame in reversed(range(5))]
    np.testing.assert_array_equal([error(frame, 0) for frame in range(5)], last[::-1])
    assert np.abs(error(2, 0) - error(2, 1)).max() > 1e-3
    assert np.abs(error(2, 0) - error(3, 0)).max() > 1e-3
    a, b = tube_mesh().faces[:, 0], tube_mesh().faces[:, 1]
    length = np.linalg.norm(tube_mesh().vertices[a] - tube_mesh().vertices[b], axis=1)
    near = length < 0.06
    change = np.linalg.norm(error(2, 0)[a] - error(2, 0)[b], axis=1)[near]
    assert np.sqrt((change**2).mean()) < 8e-3 * 0.06 / PerturbedDeformation.LENGTH_M * 1.2


def test_a_planted_error_needs_the_exact_surface():
    with pytest.raises(InputError, match="needs the exact surface, got 'skinned'"):
        TemplateConfig(error_mm=2.0)


def test_the_native_normals_are_the_defined_ones():
    mesh = tube_mesh()
    vertices = torch.from_numpy(mesh.vertices).float() + 0.02 * torch.randn(
        len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0)
    )
    faces = torch.from_numpy(mesh.faces)
    apart = torch.cat([vertices, torch.zeros(1, 3)])  # the last vertex belongs to no face
    normals = vertex_normals(apart, faces)
    defined = vertex_normals(apart.double(), faces).float()
    torch.testing.assert_close(normals, defined, atol=2e-6, rtol=0)
    assert not normals[-1].any()
