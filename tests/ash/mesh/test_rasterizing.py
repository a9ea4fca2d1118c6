"""`rasterize_mesh` against its definition, and against geometry that is known; OpenGL: `baselines/test_display.py`."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from ash.files import InputError
from ash.mesh.rasterizing import Rasterized, project_vertices, rasterize_by_warp, rasterize_mesh, rasterize_mesh_naive
from ash.native.library import use_instruction_set


def by_warp(vertices: Tensor, faces: Tensor, *, width: int, height: int, near: float = 0.01) -> Rasterized:
    """What `rasterize_mesh` does on CUDA, on the CPU."""
    return rasterize_by_warp(vertices.double(), faces.int(), width=width, height=height, near=near)


both = pytest.mark.parametrize("rasterize", [rasterize_mesh, by_warp], ids=["native", "warp"])


def assert_equal(a: Rasterized, b: Rasterized) -> None:
    assert torch.equal(a.triangle, b.triangle)
    assert (a.barycentric - b.barycentric).abs().max() < 1e-6
    assert torch.allclose(a.depth, b.depth, rtol=1e-6)


def triangle_soup(kind: str, seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    corners = torch.rand(30, 3, generator=generator) * torch.tensor([60.0, 50, 3]) + torch.tensor([0.0, 0, 1])
    if kind == "behind":
        corners[::3, 2] -= 3
    vertices = torch.cat([corners[:, :2] * corners[:, 2:], corners[:, 2:]], 1)
    if kind == "on_centres":  # corners exactly on pixel centres and edges through them: the top-left rule decides
        whole = torch.randint(0, 50, (30, 2), generator=generator) + 0.5
        vertices = torch.cat([whole, torch.ones(30, 1)], 1)
    faces = torch.stack([torch.randperm(30, generator=generator)[:3] for _ in range(25)])
    return vertices, faces


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["in_front", "behind", "on_centres"])
def test_rasterizer_is_its_definition(kind: str, seed: int, instructions: str) -> None:
    vertices, faces = triangle_soup(kind, seed)
    truth = rasterize_mesh_naive(vertices, faces, width=61, height=47)
    assert (truth.triangle >= 0).float().mean() > 0.2
    for threads in (1, 2, 4):
        drawn = rasterize_mesh(vertices, faces, width=61, height=47, threads=threads)
        assert_equal(drawn, truth)


def test_the_definition_stays_on_the_device_of_its_vertices() -> None:
    vertices, faces = triangle_soup("in_front", 0)
    with torch.device("meta"):  # of every tensor that does not say its own
        drawn = rasterize_mesh_naive(vertices, faces, width=61, height=47)
    assert_equal(drawn, rasterize_mesh_naive(vertices, faces, width=61, height=47))


def test_instruction_sets_and_threads_change_no_bit(instructions: str) -> None:
    vertices, faces = triangle_soup("behind", 3)
    drawn = rasterize_mesh(vertices, faces, width=157, height=93, threads=3)
    use_instruction_set("plain")  # The fixture takes the one before up again.
    plain = rasterize_mesh(vertices, faces, width=157, height=93)
    assert all(torch.equal(getattr(drawn, name), getattr(plain, name)) for name in ("triangle", "barycentric", "depth"))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["in_front", "behind", "on_centres"])
def test_warp_rasterizes_as_the_definition(kind: str, seed: int) -> None:
    vertices, faces = triangle_soup(kind, seed)
    drawn, again = (by_warp(vertices, faces, width=61, height=47) for _ in range(2))
    assert_equal(drawn, rasterize_mesh_naive(vertices, faces, width=61, height=47))
    assert torch.equal(drawn.triangle, again.triangle) and torch.equal(drawn.depth, again.depth)


@both
@pytest.mark.parametrize("offset", [0.0, 0.5, 0.123])
def test_a_grid_covers_every_pixel_exactly_once(offset: float, rasterize: Callable[..., Rasterized]) -> None:
    """Whole-pixel, half-pixel and arbitrary corners, either diagonal, both ways round: one triangle at a time."""
    steps = torch.arange(0.0, 41.0, 8)
    grid = torch.stack([*torch.meshgrid(steps, steps, indexing="xy"), torch.ones(6, 6)], -1).reshape(-1, 3)
    vertices = grid + torch.tensor([offset, offset, 0])
    faces = []
    for y in range(5):
        for x in range(5):
            a, b, c, d = y * 6 + x, y * 6 + x + 1, y * 6 + x + 6, y * 6 + x + 7
            pair = [[a, b, c], [b, d, c]] if (x + y) % 2 else [[a, d, b], [a, c, d]]
            faces += pair
    times = torch.zeros(48, 48, dtype=torch.int64)
    for face in faces:
        times += rasterize(vertices, torch.tensor([face]), width=48, height=48).triangle == 0
    # With corners on pixel centres left and top edges keep their pixels, right and bottom edges do not.
    inside = torch.zeros(48, 48, dtype=torch.int64)
    inside[:40, :40] = 1
    assert torch.equal(times, inside)


def test_barycentrics_are_perspective_correct() -> None:
    """They interpolate the points in space: every pixel's point projects onto the pixel, at the stated depth."""
    points = torch.tensor([[-1.0, -0.8, 2.0], [1.5, -0.5, 6.0], [0.1, 1.4, 3.0]])
    K = torch.tensor([[50.0, 0, 40], [0, 60, 30], [0, 0, 1]])
    vertices = project_vertices(points, torch.eye(4), K)
    drawn = rasterize_mesh(vertices, torch.tensor([[0, 1, 2]]), width=80, height=60)
    y, x = torch.nonzero(drawn.triangle == 0, as_tuple=True)
    assert len(x) > 300
    hit = drawn.barycentric[y, x] @ points @ K.T
    assert torch.allclose(hit[:, :2] / hit[:, 2:], torch.stack([x, y], 1) + 0.5, atol=1e-4)
    assert torch.allclose(hit[:, 2], drawn.depth[y, x], rtol=1e-5)
    assert torch.allclose(drawn.barycentric.sum(-1)[y, x], torch.ones(len(x)), atol=1e-6)
    assert (drawn.depth[drawn.triangle < 0] == 0).all() and (drawn.barycentric[drawn.triangle < 0] == 0).all()


@both
def test_floor_through_the_camera_is_seen_up_to_the_horizon(rasterize: Callable[..., Rasterized]) -> None:
    """A floor that reaches far behind the camera fills exactly the lower half of the image."""
    floor = torch.tensor([[-1e4, 1.0, -1e4], [1e4, 1, -1e4], [1e4, 1, 1e4], [-1e4, 1, 1e4]])
    K = torch.tensor([[20.0, 0, 24], [0, 20, 20], [0, 0, 1]])
    vertices = project_vertices(floor, torch.eye(4), K)
    drawn = rasterize(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), width=48, height=40)
    assert (drawn.triangle[:20] == -1).all() and (drawn.triangle[20:] >= 0).all()
    rows = torch.arange(20, 40) + 0.5
    assert torch.allclose(drawn.depth[20:, 7], 20 / (rows - 20), rtol=1e-5)
    near = rasterize(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), width=48, height=40, near=2.0)
    assert torch.equal(near.triangle >= 0, (drawn.triangle >= 0) & (drawn.depth >= 2.0))


@both
def test_ties_nearer_and_degenerate_triangles(rasterize: Callable[..., Rasterized]) -> None:
    square = torch.tensor([[0.0, 0, 1], [20, 0, 1], [0, 20, 1]])
    far = square * 2
    vertices = torch.cat([far, square, square])
    drawn = rasterize(vertices, torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8]]), width=20, height=20)
    assert drawn.triangle[2, 2] == 1 and drawn.depth[2, 2] == 1
    flat = rasterize(square, torch.tensor([[0, 1, 1], [2, 2, 2]]), width=20, height=20)
    assert (flat.triangle == -1).all()
    none = rasterize(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), width=3, height=2)
    assert none.triangle.shape == (2, 3) and (none.triangle == -1).all()


def test_wrong_input_is_named() -> None:
    vertices, faces = triangle_soup("in_front", 0)
    wrong = vertices.clone()
    wrong[3, 1] = torch.nan
    with pytest.raises(InputError, match="vertices: expected finite"):
        rasterize_mesh(wrong, faces, width=5, height=5)
    for outside in (-1, 30):
        with pytest.raises(InputError, match="faces: expected rows of the 30 vertices"):
            rasterize_mesh(vertices, torch.tensor([[0, 1, outside]]), width=5, height=5)
    with pytest.raises(InputError, match="0 x 5"):
        rasterize_mesh(vertices, faces, width=0, height=5)
    with pytest.raises(InputError, match="threads"):
        rasterize_mesh(vertices, faces, width=5, height=5, threads=0)
