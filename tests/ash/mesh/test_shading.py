"""Native shading of a textured mesh against its definition in torch, in value and gradient."""

import pytest
import torch
from helpers.figures import front_camera, tube_mesh
from helpers.numerics import relative_error

from ash.mesh import drawing
from ash.mesh.drawing import textured, textured_naive
from ash.native.shading import add_shuffled


def shaded(make, dtype: torch.dtype, *, lit: bool, side: int = 12) -> list[torch.Tensor]:
    """Colours at random points of a tube, and their gradients in texture, weights and light."""
    generator = torch.Generator().manual_seed(0)
    mesh = tube_mesh()
    faces, uv_faces = torch.from_numpy(mesh.faces), torch.from_numpy(mesh.uv_faces)
    # UVs beyond the border: samples are held there, and do not move.
    uvs = (1.6 * torch.rand(len(mesh.uvs), 2, generator=generator) - 0.3).to(dtype)
    normals = torch.nn.functional.normalize(torch.randn(len(mesh.vertices), 3, generator=generator), dim=1).to(dtype)
    triangles = torch.randint(len(faces), (301,), generator=generator)
    weights = torch.rand(301, 3, generator=generator)
    leaves = [
        torch.rand(3, side, side + 5, generator=generator),
        weights / weights.sum(1, keepdim=True),
        0.3 * torch.randn(9, 3, generator=generator),
    ]
    texture, weights, light = leaves = [leaf.to(dtype).requires_grad_() for leaf in leaves]
    colours = make(texture, uvs, uv_faces, normals, faces, light if lit else None)(triangles, weights)
    upstream = torch.randn(colours.shape, generator=generator).to(dtype)
    return [colours.detach(), *torch.autograd.grad((colours * upstream).sum(), leaves[: 3 if lit else 2])]


def compare(*, lit: bool, side: int = 12) -> None:
    truth = shaded(textured_naive, torch.float64, lit=lit, side=side)
    found = shaded(textured, torch.float32, lit=lit, side=side)
    assert all(relative_error(a, b) < 2e-5 for a, b in zip(found, truth, strict=True))


@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.parametrize("side", [1, 12])
def test_shading_is_its_definition(lit, side, instructions):
    compare(lit=lit, side=side)


@pytest.mark.parametrize("moves", [False, True])
def test_a_picture_and_its_gradients_are_those_of_the_definition(moves, monkeypatch):
    """Both in float32: other roundings see other cells of a texture. Vertices learn through weights and outlines."""
    weights = drawing.corner_weights  # The native ones are exact to float32's last place, their definition is not.
    monkeypatch.setattr(
        drawing, "corner_weights", lambda a, b, c, *at: weights(a.double(), b.double(), c.double(), *at).float()
    )
    mesh = tube_mesh()
    faces, uvs = torch.from_numpy(mesh.faces), torch.from_numpy(mesh.uvs).float()
    results = []
    for natively in (False, True):
        monkeypatch.setattr(drawing, "_native", lambda *_, answer=natively: answer)
        vertices = torch.from_numpy(mesh.vertices).float().requires_grad_(moves)
        texture = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)).requires_grad_()
        normals = torch.nn.functional.normalize(vertices.detach() + 0.1, dim=1)
        shade = drawing.textured(texture, uvs, torch.from_numpy(mesh.uv_faces), normals, faces, None)
        background = torch.tensor([0.1, 0.5, 0.9])
        topology, camera = drawing.topology_of(faces), front_camera(40, 32)
        image = drawing.draw_mesh(vertices, topology, camera, shade, background, outlines=moves)
        upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
        leaves = [texture, vertices] if moves else [texture]
        results.append([image.detach(), *torch.autograd.grad((image * upstream).sum(), leaves)])
    assert all(relative_error(b, a) < 1e-5 for a, b in zip(*results, strict=True))


def test_a_texture_with_its_residual_is_its_definition():
    generator = torch.Generator().manual_seed(0)
    texture = torch.randn(3, 12, 20, generator=generator).requires_grad_()
    decoded = torch.randn(48, 3, 5, generator=generator).requires_grad_()
    upstream = torch.randn(3, 12, 20, generator=generator)
    found, truth = add_shuffled(texture, decoded, 4), texture + torch.nn.functional.pixel_shuffle(decoded, 4)
    assert torch.equal(found, truth)
    for ours, theirs in zip(
        torch.autograd.grad(found, (texture, decoded), upstream),
        torch.autograd.grad(truth, (texture, decoded), upstream),
        strict=True,
    ):
        assert torch.equal(ours, theirs)
