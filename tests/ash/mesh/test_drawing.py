"""The differentiable mesh drawer: its gradients against finite differences, and coverage against areas."""

import pytest
import torch
from helpers.figures import front_camera, tube_mesh
from helpers.numerics import relative_error

from ash.capture.dataset import Camera
from ash.mesh.drawing import _weights_of, draw_mesh, topology_of
from ash.mesh.rasterizing import project_vertices, rasterize_mesh


def tube() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = tube_mesh()
    return torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)


def smooth_shade(faces: torch.Tensor, rest: torch.Tensor):
    """A colour that is a smooth function of the place on the rest surface, also across edges."""

    def shade(triangles: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        place = (rest[faces[triangles]] * weights[..., None]).sum(1)
        return torch.stack([0.5 + 0.4 * torch.sin(9 * place[:, 1]), 0.5 + 2 * place[:, 0]], 1)

    return shade


def picture(vertices: torch.Tensor, camera: Camera) -> torch.Tensor:
    rest, faces = tube()
    return draw_mesh(
        vertices, topology_of(faces), camera, smooth_shade(faces, rest), rest.new_tensor([0.1, 0.9]), outlines=True
    )


def test_neighbours_of_faces():
    across = topology_of(torch.tensor([[0, 1, 2], [2, 1, 3]])).across
    assert across.tolist() == [[-1, 1, -1], [0, -1, -1]]
    _, faces = tube()
    across = topology_of(faces).across
    assert (across < 0).sum() == 2 * 12  # The open ends.


def test_weights_are_those_of_the_rasteriser_and_the_native_ones_their_definition_in_value_and_gradient():
    rest, faces = tube()
    camera = front_camera(40, 32)
    corners = project_vertices(rest, torch.from_numpy(camera.viewmat), torch.from_numpy(camera.K)).float()
    drawn = rasterize_mesh(corners, faces, width=40, height=32)
    covered = (drawn.triangle.reshape(-1) >= 0).nonzero().squeeze(1)
    seen = drawn.triangle.reshape(-1)[covered].long()
    upstream = torch.randn(len(covered), 3, generator=torch.Generator().manual_seed(0))
    results = []
    for leaf in (corners.double().requires_grad_(), corners.requires_grad_()):
        weights = _weights_of(leaf, faces, seen, covered, 40)
        results.append((weights, *torch.autograd.grad((weights * upstream).sum(), leaf)))
    assert all(relative_error(found, truth) < 1e-6 for truth, found in zip(*results, strict=True))
    (defined, _), _ = results
    torch.testing.assert_close(defined, drawn.barycentric.reshape(-1, 3)[covered].double(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_gradients_in_the_vertices_are_those_of_finite_differences(seed):
    """Outlines, texture and coverage at once; a random linear function of the picture, along random directions."""
    rest, _ = tube()
    generator = torch.Generator().manual_seed(seed)
    camera = front_camera(32, 32)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    vertices = rest + 0.004 * random(*rest.shape)
    judge = random(32, 32, 3)
    judge = torch.nn.functional.avg_pool2d(judge.permute(2, 0, 1)[None], 3, 1, 1)[0].permute(1, 2, 0)

    def value(moved: torch.Tensor) -> torch.Tensor:
        return (picture(moved.requires_grad_(), camera) * judge).sum()

    at = vertices.clone()
    (gradient,) = torch.autograd.grad(value(at), at)
    step = 1e-7  # Small: where two outlines meet in a corner, a sample changes hands with a jump.
    for direction in (torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0]), 0.3 * random(*rest.shape)):
        move = direction.double().expand_as(rest)
        ahead, behind = value(vertices + step * move), value(vertices - step * move)
        numeric = float((ahead - behind).detach() / (2 * step))
        assert float((gradient * move).sum()) == pytest.approx(numeric, rel=0.02, abs=0.05)


def test_coverage_is_the_area_and_grows_continuously():
    """A tube that moves by less than a sample changes its columns by what it gains and loses, without a jump."""
    rest, _ = tube()
    camera = front_camera(32, 32)
    with torch.no_grad():
        moved = [picture(rest + torch.tensor([shift, 0, 0]), camera)[10, :, 2] for shift in torch.linspace(0, 0.05, 41)]
    areas, steps = torch.stack(moved).sum(1), (torch.stack(moved)[1:] - torch.stack(moved)[:-1]).abs()
    assert areas.std() < 0.02
    pixels_per_m = 1.2 * 32 / 1.9
    assert steps.max() < 1.3 * 0.05 / 40 * pixels_per_m


def test_interior_edges_are_no_outlines():
    rest, _ = tube()
    coverage = picture(rest, front_camera(64, 64))[..., 2]
    inside = coverage[24:40, 30:34]
    torch.testing.assert_close(inside, torch.ones_like(inside), atol=1e-12, rtol=0)


def test_pictures_with_and_without_gradients_agree():
    camera, (rest, _) = front_camera(24, 24), tube()
    with_gradient = picture(rest.clone().requires_grad_(), camera).detach()
    torch.testing.assert_close(picture(rest, camera), with_gradient, atol=1e-5, rtol=0)
