"""`rasterize_mesh` against its definition, against geometry that is known, and against another renderer."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from ash.files import InputError
from ash.mesh.rasterizing import Rasterized, project_vertices, rasterize_by_warp, rasterize_mesh, rasterize_mesh_naive
from ash.native.library import use_instruction_set

WIDTH, HEIGHT = 96, 80


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


# --- another renderer ------------------------------------------------------------------------------------------------


def interlocking_shapes() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Vertices, faces, viewmat and K of two interlocking shapes, one of them smooth and finely meshed."""
    ring = trimesh.creation.torus(major_radius=0.7, minor_radius=0.25, major_sections=40, minor_sections=20)
    box = trimesh.creation.box(extents=(0.5, 1.6, 0.5))
    mesh = trimesh.util.concatenate([ring, box])
    turn = trimesh.transformations.euler_matrix(0.5, 0.4, 0.2)
    turn[:3, 3] = (0.1, -0.05, 2.6)
    K = torch.tensor([[100.0, 0, 45.3], [0, 100, 41.7], [0, 0, 1]], dtype=torch.float64)
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces)), torch.from_numpy(turn), K


def edge_distance(drawn: Rasterized, vertices: Tensor, faces: Tensor) -> Tensor:
    """Pixels to the nearest edge of the triangle that each pixel sees; 0 where it sees none."""
    corners = (vertices[:, :2] / vertices[:, 2:])[faces[drawn.triangle.clamp_min(0).long()]]
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixel = torch.stack([x, y], -1)
    distances = []
    for i in range(3):
        a, b = corners[..., i, :], corners[..., (i + 1) % 3, :]
        along, across = b - a, pixel - a
        distances.append((along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]).abs() / along.norm(dim=-1))
    return torch.where(drawn.triangle >= 0, torch.stack(distances).amin(0), 0.0)


def test_ids_are_those_of_mitsubas_ray_cast() -> None:
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    shapes = interlocking_shapes()
    points, faces, viewmat, K = (tensor.numpy() for tensor in shapes)
    mesh = mitsuba.Mesh("mesh", vertex_count=len(points), face_count=len(faces))
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = points.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    world = mitsuba.load_dict({"type": "scene", "mesh": mesh})
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    ids = np.full((HEIGHT, WIDTH), -1)
    inverse = viewmat[:3, :3].T @ np.linalg.inv(K)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            direction = inverse @ [x + 0.5, y + 0.5, 1]
            ray = mitsuba.Ray3f(mitsuba.Point3f(origin), mitsuba.Vector3f(direction / np.linalg.norm(direction)))
            hit = world.ray_intersect_preliminary(ray)
            if hit.is_valid():
                ids[y, x] = hit.prim_index
    vertices = project_vertices(shapes[0], *shapes[2:])
    drawn = rasterize_mesh(vertices, shapes[1], width=WIDTH, height=HEIGHT)
    different = drawn.triangle.numpy() != ids
    # On the silhouette one of the two sees nothing, or what lies behind: a neighbour of a pixel at an edge.
    near_edge = (edge_distance(drawn, vertices, shapes[1]) < 0.01).numpy()
    assert (drawn.triangle >= 0).float().mean() > 0.25
    assert different.mean() < 0.005 and not (different & ~near_edge).any()
