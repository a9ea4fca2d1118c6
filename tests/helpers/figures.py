"""A tiny figure for tests: a bent-able tube of two joints, with an atlas, made from formulas alone."""

import numpy as np

from ash.capture.dataset import Camera, Motion, Skeleton, TemplateMesh

RINGS, SIDES = 9, 12


def tube_mesh() -> TemplateMesh:
    """A tube of radius 0.1 m from y = 0 to 1 m; its upper half follows joint 1, with a soft transition."""
    height, angle = np.meshgrid(np.linspace(0, 1, RINGS), np.arange(SIDES) / SIDES * 2 * np.pi, indexing="ij")
    vertices = np.stack([0.1 * np.sin(angle), height, 0.1 * np.cos(angle)], -1).reshape(-1, 3)
    # The atlas is the unrolled tube: one more column of UVs than of vertices, because the seam is cut.
    v, u = np.meshgrid(np.linspace(0.05, 0.95, RINGS), np.linspace(0.05, 0.95, SIDES + 1), indexing="ij")
    faces, uv_faces = [], []
    for ring in range(RINGS - 1):
        for side in range(SIDES):
            following = (side + 1) % SIDES
            a, b = ring * SIDES + side, ring * SIDES + following
            faces += [(a, b, a + SIDES), (b, b + SIDES, a + SIDES)]
            p, q = ring * (SIDES + 1) + side, ring * (SIDES + 1) + side + 1
            uv_faces += [(p, q, p + SIDES + 1), (q, q + SIDES + 1, p + SIDES + 1)]
    upper = np.clip((vertices[:, 1] - 0.35) / 0.3, 0, 1)
    return TemplateMesh(
        vertices=vertices,
        faces=np.array(faces),
        uvs=np.stack([u, v], -1).reshape(-1, 2),
        uv_faces=np.array(uv_faces),
        skin_weights=np.stack([1 - upper, upper], -1),
    )


def tube_skeleton() -> Skeleton:
    """A root at the bottom and a joint half-way up."""
    return Skeleton(
        names=("root", "bend"), parents=np.array([-1, 0]), heads=np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    )


def tube_motion(frames: int = 6, seed: int = 0) -> Motion:
    """A random smooth-ish motion of one sequence."""
    rng = np.random.default_rng(seed)
    dofs = np.cumsum(0.15 * rng.standard_normal((frames, 9)), axis=0)
    return Motion(dofs=dofs, sequence=np.zeros(frames, dtype=np.int64), fps=25.0)


def front_camera(width: int = 64, height: int = 64, distance: float = 2.0) -> Camera:
    """Looks along -z at the point (0, 0.5, 0), upright."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.diag([1.0, -1.0, -1.0])
    viewmat[:3, 3] = (0.0, 0.5, distance)
    K = np.array([[1.2 * height, 0, width / 2], [0, 1.2 * height, height / 2], [0, 0, 1.0]])
    return Camera(name="front", width=width, height=height, K=K, viewmat=viewmat)


def ring_cameras(count: int, size: int) -> list[Camera]:
    """Cameras around the tube, all upright and looking at its middle."""
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
        viewmat[:3, 3] = -viewmat[:3, :3] @ (np.array([0, 0.5, 0]) - 2.0 * viewmat[2, :3])
        K = np.array([[1.3 * size, 0, size / 2], [0, 1.3 * size, size / 2], [0, 0, 1.0]])
        cameras.append(Camera(name=f"cam{index}", width=size, height=size, K=K, viewmat=viewmat))
    return cameras
