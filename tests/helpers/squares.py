"""Small squares in space, and a studio that draws them: pictures whose every edge is known in closed form."""

from functools import lru_cache

import numpy as np

from ash.capture.dataset import Camera
from synth.camera.render import Studio, probe
from synth.person.body import Surface
from synth.scene import Light

CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def squares(centres: np.ndarray, half: float) -> np.ndarray:
    """Vertices `[4 n, 3]` of squares that face +z."""
    return (centres[:, None] + half * CORNERS).reshape(-1, 3)


@lru_cache(maxsize=4)
def studio(count: int) -> Studio:
    """A studio for `count` squares under the sky alone."""
    corners = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    faces = corners.reshape(-1, 3)
    uvs = np.tile([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]], (count, 1))
    rest = squares(np.zeros((count, 3)), 1.0)
    surface = Surface(vertices=rest, faces=faces, uvs=uvs, uv_faces=faces, part=np.zeros(len(faces), dtype=np.int64))
    grey = np.full((8, 8, 3), 128, dtype=np.uint8)
    return Studio(probe(), surface, grey, Light(area=0.0), depth=2)


def camera(width: int, height: int, *, fx: float, fy: float, skew: float = 0.0, distortion=(0, 0, 0, 0)) -> Camera:
    """A camera 3 m in front of the origin, looking along -z, its centre off the middle of the picture."""
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[:3, 3] = [0.02, -0.03, 3.0]
    K = np.array([[fx, skew, width / 2 + 3.3], [0, fy, height / 2 - 2.1], [0, 0, 1.0]])
    lens = np.array(distortion, dtype=np.float64)
    return Camera(name="lens", width=width, height=height, K=K, viewmat=viewmat, distortion=lens)
