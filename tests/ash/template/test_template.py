import numpy as np
import pytest
import torch
from helpers.captures import write_tube_capture
from helpers.figures import tube_mesh, tube_motion, tube_skeleton

from ash.capture.dataset import Motion, Pose
from ash.capture.formats import read_template_truth
from ash.config import TemplateConfig
from ash.files import InputError
from ash.template.template import KnownDeformation, PerturbedDeformation, RestDeformation, Template, vertex_normals
from ash.template_learning.learning import template_of


def rest_template() -> Template:
    return Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()))


def test_rest_pose_reproduces_the_mesh():
    still = Motion(dofs=np.zeros((1, 9)), sequence=np.zeros(1, dtype=np.int64), fps=25.0)
    posed = rest_template().pose(Pose(still, 0))
    np.testing.assert_allclose(posed.vertices.numpy(), tube_mesh().vertices, atol=1e-6)


def test_known_surface_is_met_exactly_through_skinning():
    motion = tube_motion()
    skinned = np.stack([rest_template().pose(Pose(motion, f)).vertices.numpy() for f in range(6)])
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
    template = rest_template()
    a, b = tube_motion(seed=1), tube_motion(seed=2)
    first = template.pose(Pose(a, 3)).vertices.clone()
    assert not torch.allclose(template.pose(Pose(b, 3)).vertices, first)
    torch.testing.assert_close(template.pose(Pose(a, 3)).vertices, first)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


def errors_m(capture, error_mm: float, seed: int = 0) -> np.ndarray:
    template = template_of(TemplateConfig(kind="exact", error_mm=error_mm), capture, seed=seed)
    posed = np.stack([template.pose(Pose(capture.motion, frame)).vertices.numpy() for frame in range(6)])
    return posed.astype(np.float64) - read_template_truth(capture)


def test_a_planted_error_has_exactly_the_stated_rms_in_every_posed_frame(capture):
    for error_mm in (2.0, 16.0):
        rms_mm = 1e3 * np.sqrt((errors_m(capture, error_mm) ** 2).sum(-1).mean(-1))
        np.testing.assert_allclose(rms_mm, error_mm, rtol=1e-4)


def test_a_planted_error_of_zero_is_the_exact_surface(capture):
    np.testing.assert_allclose(errors_m(capture, 0.0), 0, atol=1e-6)


def test_half_of_a_planted_errors_square_is_the_same_in_all_frames():
    perturbed = PerturbedDeformation(RestDeformation(tube_mesh()), tube_mesh(), error_mm=8.0, seed=3)
    errors = np.stack([perturbed.error(frame) for frame in range(400)])
    static = errors.mean(0)
    assert (static**2).sum(1).mean() / 8e-3**2 == pytest.approx(0.5, abs=0.02)


def test_a_planted_error_is_smooth_and_a_function_of_the_seed_and_the_frame():
    def error(frame: int, seed: int) -> np.ndarray:
        return PerturbedDeformation(RestDeformation(tube_mesh()), tube_mesh(), error_mm=8.0, seed=seed).error(frame)

    np.testing.assert_array_equal(error(2, 0), error(2, 0))
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
