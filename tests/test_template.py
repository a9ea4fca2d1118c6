import numpy as np
import pytest
import torch
from figures import tube_mesh, tube_motion, tube_skeleton

from ash.dataset import Motion
from ash.files import InputError
from ash.template import KnownDeformation, RestDeformation, Template, vertex_normals


def rest_template() -> Template:
    return Template(tube_mesh(), tube_skeleton(), RestDeformation(tube_mesh()))


def test_rest_pose_reproduces_the_mesh():
    still = Motion(dofs=np.zeros((1, 9)), sequence=np.zeros(1, dtype=np.int64), fps=25.0)
    posed = rest_template().pose(still, 0)
    np.testing.assert_allclose(posed.vertices.numpy(), tube_mesh().vertices, atol=1e-6)


def test_known_surface_is_met_exactly_through_skinning():
    motion = tube_motion()
    skinned = np.stack([rest_template().pose(motion, f).vertices.numpy() for f in range(6)])
    truth = skinned + 0.05 * np.random.default_rng(1).standard_normal(skinned.shape)
    exact = Template(tube_mesh(), tube_skeleton(), KnownDeformation(motion, truth))
    for frame in range(6):
        np.testing.assert_allclose(exact.pose(motion, frame).vertices.numpy(), truth[frame], atol=1e-6)


def test_known_surface_refuses_another_motion():
    exact = Template(tube_mesh(), tube_skeleton(), KnownDeformation(tube_motion(), np.zeros((6, 108, 3))))
    with pytest.raises(InputError, match="known only for the motion of the capture"):
        exact.pose(tube_motion(seed=9), 2)


def test_normals_of_a_tube_point_away_from_its_axis():
    mesh = tube_mesh()
    normals = vertex_normals(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)).numpy()
    outward = mesh.vertices * [1, 0, 1] / 0.1
    assert ((normals * outward).sum(1) > 0.99).all()


def test_kept_frames_do_not_mix_up_motions():
    template = rest_template()
    a, b = tube_motion(seed=1), tube_motion(seed=2)
    first = template.pose(a, 3).vertices.clone()
    assert not torch.allclose(template.pose(b, 3).vertices, first)
    torch.testing.assert_close(template.pose(a, 3).vertices, first)
