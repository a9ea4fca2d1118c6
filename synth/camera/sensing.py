"""Cameras as the renderer has them: Mitsuba's own pinhole, and a sensor for any other lens of a `Camera`.

Mitsuba is handed in (`mi`), so that `synth/camera/render.py` stays the only file that imports it.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ash.capture.dataset import Camera
from ash.files import InputError

BUCKET = 128  # pictures are cropped to the subject in steps of so many pixels: each new size compiles for 0.3 s
NEWTON_ROUNDS = 6  # in single precision; `ash.capture.lens.undistort` is the definition


@dataclass(frozen=True, kw_only=True, slots=True)
class Window:
    """The subject's place in the picture, in whole pixels."""

    left: int
    top: int
    width: int
    height: int

    def paste(self, inside: np.ndarray, camera: Camera, empty: int) -> np.ndarray:
        """The whole picture `[h, w, ...]`, `empty` outside of the window."""
        whole = np.full((camera.height, camera.width, *inside.shape[2:]), empty, dtype=inside.dtype)
        whole[self.top : self.top + self.height, self.left : self.left + self.width] = inside
        return whole

    @property
    def centres(self) -> np.ndarray:
        """Where the pixels' centres lie in the whole picture, `[n, 2]`, row by row."""
        x, y = np.meshgrid(self.left + np.arange(self.width) + 0.5, self.top + np.arange(self.height) + 0.5)
        return np.stack([x.ravel(), y.ravel()], axis=1)


def window_of(camera: Camera, points: np.ndarray) -> Window:
    """The window that shows all of `points` `[n, 3]` in front of the camera, in steps of a bucket."""
    pixels, _ = camera.project(points.astype(np.float64))
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, size - 1)
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 2, low + 1, size)
    extent = np.minimum(-(-(high - low) // BUCKET) * BUCKET, size)
    low = np.clip((low + high - extent) // 2, 0, size - extent)
    return Window(left=int(low[0]), top=int(low[1]), width=int(extent[0]), height=int(extent[1]))


def make_sensor(mi: Any, camera: Camera, window: Window, *, vectorised: bool) -> Any:
    """The camera restricted to a window, by moving its principal point: film offsets would be compiled in."""
    film = {
        "type": "hdrfilm", "width": window.width, "height": window.height, "pixel_format": "rgba",
        "component_format": "float32", "rfilter": {"type": "box"}, "sample_border": False,
    }  # fmt: skip
    shared = {"film": film, "sampler": {"type": "multijitter", "sample_count": 16}}
    focal, centre = camera.K[0, 0], camera.K[:2, 2] - [window.left, window.top]
    if camera.is_pinhole and abs(camera.K[1, 1] - focal) <= 1e-9 * focal and camera.K[0, 1] == 0:
        rotation = camera.viewmat[:3, :3].T @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba's x points left and y up
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = rotation, camera.position
        return mi.load_dict(
            {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f(place),
                "fov": float(np.rad2deg(2 * np.arctan(window.width / 2 / focal))),
                "fov_axis": "x",
                "near_clip": 0.05,
                "far_clip": 100.0,
                "principal_point_offset_x": float(0.5 - centre[0] / window.width),
                "principal_point_offset_y": float(0.5 - centre[1] / window.height),
                **shared,
            }
        )
    if not vectorised:
        raise InputError(
            f"camera {camera.name}: lens distortion and pixels that are not square need LLVM 17 or newer here, "
            "expected libllvm to be installed"
        )
    _register(mi)
    sensor = mi.load_dict({"type": "calibrated_lens", **shared})
    sensor.set(camera, window)
    return sensor


@lru_cache(maxsize=1)
def _register(mi: Any) -> None:
    """Teach Mitsuba the sensor `calibrated_lens`: any K, any lens that `ash.capture.lens` knows, traced ray by ray."""
    import drjit as dr

    class CalibratedLens(mi.Sensor):  # type: ignore[misc,name-defined]
        def set(self, camera: Camera, window: Window) -> None:
            to_image = np.linalg.inv(camera.K[:2, :2])
            scale = to_image * [window.width, window.height]
            shift = to_image @ ([window.left, window.top] - camera.K[:2, 2])
            numbers = [*scale.ravel(), *shift, *camera.distortion, *camera.viewmat[:3, :3].ravel(), *camera.position]
            # Opaque: numbers that the kernel knew would be compiled in, and every camera would cost a compilation.
            self.numbers = [mi.Float(float(number)) for number in numbers]
            dr.make_opaque(self.numbers)

        def sample_ray(
            self, time: Any, wavelength_sample: Any, position_sample: Any, aperture_sample: Any, active: Any = True
        ) -> Any:
            n = self.numbers
            u, v = position_sample.x, position_sample.y
            seen_x, seen_y = n[0] * u + n[1] * v + n[4], n[2] * u + n[3] * v + n[5]
            x, y = _ideal(seen_x, seen_y, *n[6:10])
            r = n[10:19]
            ray = dr.zeros(mi.Ray3f)
            ray.o = mi.Point3f(*n[19:22])
            ray.d = dr.normalize(
                mi.Vector3f(x * r[0] + y * r[3] + r[6], x * r[1] + y * r[4] + r[7], x * r[2] + y * r[5] + r[8])
            )
            ray.maxt = dr.largest(mi.Float)
            ray.time = time
            return ray, mi.Color3f(1.0)

        def sample_ray_differential(
            self, time: Any, wavelength_sample: Any, position_sample: Any, aperture_sample: Any, active: Any = True
        ) -> Any:
            ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
            return mi.RayDifferential3f(ray), weight

    mi.register_sensor("calibrated_lens", lambda settings: CalibratedLens(settings))


def _ideal(seen_x: Any, seen_y: Any, k1: Any, k2: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    """`ash.capture.lens.undistort` in Dr.Jit's arrays."""
    x, y = seen_x, seen_y
    for _ in range(NEWTON_ROUNDS):
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (k1 + k2 * r2), 2 * (k1 + 2 * k2 * r2)
        error_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - seen_x
        error_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - seen_y
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        determinant = xx * yy - xy * xy
        x, y = x - (yy * error_x - xy * error_y) / determinant, y - (xx * error_y - xy * error_x) / determinant
    return x, y
