"""Rendering: the only file that knows Mitsuba. Path-traced pictures, and what each pixel's centre hits.

One thread per process: floating-point sums then have one order, and a picture has the same bytes in any sharding.
"""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ash.dataset import Camera
from ash.files import InputError
from synth.body import Surface, vertex_normals
from synth.scene import Light

OLDEST_LLVM = 17  # 15 and 16 accept the first kernels and then abort the process ("Cannot select fminimum")
PROBE_SECONDS = 300
BUCKET = 32  # pictures are cropped to the subject in steps of so many pixels: every new size costs a compilation


@dataclass(frozen=True, kw_only=True, slots=True)
class Renderer:
    """What this machine renders with, as found by a probe render."""

    variant: str
    libllvm: str  # path, or empty for scalar_rgb
    mitsuba: str  # version
    note: str  # one line for the user


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """A rendered view and its truth."""

    rgba: np.ndarray  # [h, w, 4] uint8 sRGB, straight alpha
    triangle: np.ndarray  # [h, w] int32, -1: none
    barycentric: np.ndarray  # [h, w, 2] float32, weights of the triangle's second and third corner
    noise: np.ndarray  # [h, w] float32, variance of sRGB in 0..1, mean of the channels


def llvm_version(path: str) -> int:
    """Major version that a library's file name tells, 0 if it tells none."""
    match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", Path(path).name)
    return int(match.group(1)) if match else 0


def find_libllvm() -> list[str]:
    """LLVM libraries that Dr.Jit could use, best first; never one known to abort the process."""
    folders = ["/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib"]
    folders += [str(path) for root in ("/usr/lib", "/usr/lib64") for path in Path(root).glob("*-linux-gnu*")]
    folders += [str(path) for path in Path("/usr/lib").glob("llvm-*/lib")]
    folders += [str(Path(sys.prefix) / "lib"), *filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep))]
    found = {str(path.resolve()) for folder in folders for path in Path(folder).glob("libLLVM*.so*")}
    found |= {str(path.resolve()) for folder in folders for path in Path(folder).glob("libLLVM*.dylib")}
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    usable = sorted((path for path in found if llvm_version(path) >= OLDEST_LLVM), key=llvm_version, reverse=True)
    if given and (llvm_version(given) == 0 or llvm_version(given) >= OLDEST_LLVM):
        usable = [given, *usable]
    return usable


@lru_cache(maxsize=1)
def probe() -> Renderer:
    """Find a renderer that really renders: each candidate draws a small textured scene in a process of its own.

    Raises:
        InputError: not even scalar_rgb works.
    """
    for libllvm in find_libllvm():
        version = _try("llvm_ad_rgb", libllvm)
        if version:
            note = f"Mitsuba {version}, llvm_ad_rgb with {Path(libllvm).name}"
            return Renderer(variant="llvm_ad_rgb", libllvm=libllvm, mitsuba=version, note=note)
    version = _try("scalar_rgb", "")
    if version:
        note = f"Mitsuba {version}, scalar_rgb: no LLVM from {OLDEST_LLVM} on was found, rendering takes 3x as long"
        return Renderer(variant="scalar_rgb", libllvm="", mitsuba=version, note=note)
    raise InputError("Mitsuba does not render here: expected the mitsuba package to import (is libatomic1 installed?)")


def _try(variant: str, libllvm: str) -> str:
    environment = dict(os.environ)
    environment.pop("DRJIT_LIBLLVM_PATH", None)
    if libllvm:
        environment["DRJIT_LIBLLVM_PATH"] = libllvm
    root = str(Path(__file__).resolve().parent.parent)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", "synth.render", variant]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, timeout=PROBE_SECONDS, check=True)
        return str(json.loads(done.stdout)["mitsuba"])
    except (OSError, subprocess.SubprocessError, json.JSONDecodeError, KeyError):
        return ""


def _use(renderer: Renderer) -> Any:
    if renderer.libllvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = renderer.libllvm
    import mitsuba as mi

    mi.set_variant(renderer.variant)
    mi.set_log_level(mi.LogLevel.Error)
    if renderer.libllvm:
        import drjit as dr

        dr.set_thread_count(1)
    return mi


class Studio:
    """Lights, material and integrator, loaded once per process; the person changes with every frame."""

    def __init__(self, renderer: Renderer, surface: Surface, texture: np.ndarray, light: Light, *, depth: int) -> None:
        self.mi = _use(renderer)
        self.vectorised = bool(renderer.libllvm)
        self.surface = surface
        # Mitsuba wants one UV per vertex: vertices on a chart's border are listed once per chart.
        pairs = np.stack([surface.faces.ravel(), surface.uv_faces.ravel()], axis=1)
        self.pairs, corners = np.unique(pairs, axis=0, return_inverse=True)
        self.corners = corners.reshape(-1, 3)
        self.material = self._material(texture, light)
        self.lights = self._lights(light)
        # A depth counts path edges: 2 is direct light only, 3 adds one bounce.
        direct = {"type": "direct", "hide_emitters": True}
        path = {"type": "path", "max_depth": depth, "hide_emitters": True}
        self.integrator = self.mi.load_dict(direct if depth <= 2 else path)
        self.scene: Any = None
        self.vertices = np.zeros((0, 3))

    def _material(self, texture: np.ndarray, light: Light) -> Any:
        mi = self.mi
        bitmap = mi.Bitmap(np.array(texture), pixel_format=mi.Bitmap.PixelFormat.RGB)
        colour = {"type": "bitmap", "bitmap": bitmap, "filter_type": "bilinear", "wrap_mode": "clamp", "raw": False}
        diffuse = {"type": "diffuse", "reflectance": colour}
        if light.gloss == 0:
            return mi.load_dict({"type": "twosided", "bsdf": diffuse})
        satin = {"type": "principled", "base_color": colour, "roughness": 0.28, "specular": 0.45 * light.gloss}
        return mi.load_dict({"type": "twosided", "bsdf": satin})

    def _lights(self, light: Light) -> dict[str, Any]:
        mi = self.mi

        # Lamps stand far away, so that light does not vary over the floor unless `falloff` asks for it.
        # Sampling weights: the sky is sampled by the material, so lamps get the light samples (+1 dB at equal cost).
        def panel(
            position: tuple[float, ...], size: float, radiance: float, tint: tuple[float, ...], weight: float
        ) -> Any:
            place = mi.ScalarTransform4f().look_at(origin=list(position), target=[0, 1, 0], up=[0, 1, 0.01])
            shape = mi.ScalarTransform4f().scale([size, size, 1])
            colour = {"type": "rgb", "value": [radiance * channel for channel in tint]}
            emitter = {"type": "area", "radiance": colour, "sampling_weight": weight}
            return mi.load_dict({"type": "rectangle", "to_world": place @ shape, "emitter": emitter})

        sky = {"type": "constant", "radiance": {"type": "rgb", "value": light.sky}, "sampling_weight": 0.1}
        lights = {"sky": mi.load_dict(sky)}
        if light.area > 0:
            lights["key"] = panel((10.4, 11.4, 12.8), 5.2, 4.8 * light.area, (1.0, 0.95, 0.87), 2.0)
            lights["fill"] = panel((-13.6, 5.8, 6.4), 6.0, 1.8 * light.area, (0.86, 0.93, 1.0), 1.0)
            lights["rim"] = panel((-2.4, 11.4, -14.4), 4.8, 3.2 * light.area, (1.0, 0.97, 0.93), 1.3)
        if light.falloff > 0:
            lights["lamp"] = panel((1.7, 1.5, 0.2), 0.25, 40.0 * light.falloff, (1.0, 0.85, 0.65), 2.0)
        return lights

    def dress(self, vertices: np.ndarray) -> None:
        """Put the person into the scene with the posed `vertices` `[s, 3]`."""
        mi = self.mi
        self.vertices = vertices.astype(np.float32)
        normals = vertex_normals(self.vertices.astype(np.float64), self.surface.faces)
        properties = mi.Properties()
        properties["mesh_bsdf"] = self.material
        mesh = mi.Mesh(
            "person",
            len(self.pairs),
            len(self.corners),
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=properties,
        )
        # The UVs' v runs down in Mitsuba's bitmaps, as rows do.
        uvs = self.surface.uvs[self.pairs[:, 1]] * [1, -1] + [0, 1]
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ravel(self.vertices[self.pairs[:, 0]]).astype(np.float32)
        parameters["vertex_normals"] = np.ravel(normals[self.pairs[:, 0]]).astype(np.float32)
        parameters["vertex_texcoords"] = np.ravel(uvs).astype(np.float32)
        parameters["faces"] = np.ravel(self.corners).astype(np.uint32)
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "person": mesh, **self.lights})

    def picture(self, camera: Camera, *, samples: int, seed: int) -> Picture:
        """Render a view in two halves of independent noise, and cast one ray through every pixel's centre."""
        left, top, width, height = self._window(camera)
        sensor = self._sensor(camera, left, top, width, height)
        halves = [self._render(sensor, samples // 2, (seed + k) % 2**32) for k in range(2)]
        mean = (halves[0] + halves[1]) / 2
        alpha = np.clip(mean[..., 3:], 0, 1)
        colours = [_to_srgb(half[..., :3] / np.maximum(half[..., 3:], 1e-6)) for half in halves]
        noise = np.mean((colours[0] - colours[1]) ** 2, axis=-1) / 4
        rgba = np.concatenate([_to_srgb(mean[..., :3] / np.maximum(alpha, 1e-6)), alpha], axis=-1)
        rgba = np.where(np.round(255 * alpha) > 0, np.round(255 * rgba), 0).astype(np.uint8)
        triangle, barycentric = self._cast(camera, left, top, width, height)
        noise = np.where(rgba[..., 3] > 0, noise, 0).astype(np.float32)
        return Picture(
            rgba=_paste(rgba, camera, left, top, 0),
            triangle=_paste(triangle, camera, left, top, -1),
            barycentric=_paste(barycentric, camera, left, top, 0),
            noise=_paste(noise, camera, left, top, 0),
        )

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Left, top, width and height of the subject's place in the picture, in steps of a bucket."""
        pixels, _ = camera.project(self.vertices.astype(np.float64))
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, size - 1)
        high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 2, low + 1, size)
        extent = np.minimum(-(-(high - low) // BUCKET) * BUCKET, size)
        low = np.clip((low + high - extent) // 2, 0, size - extent)
        return int(low[0]), int(low[1]), int(extent[0]), int(extent[1])

    def _sensor(self, camera: Camera, left: int, top: int, width: int, height: int) -> Any:
        """The camera restricted to a window, by moving its principal point: film offsets would be compiled in."""
        mi = self.mi
        focal = camera.K[0, 0]
        if abs(camera.K[1, 1] - focal) > 1e-9 * focal or camera.K[0, 1] != 0:
            raise InputError(f"camera {camera.name}: expected square pixels (fx = fy, no skew) for rendering")
        rotation = camera.viewmat[:3, :3].T @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba's x points left and y up
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = rotation, camera.position
        centre = camera.K[:2, 2] - [left, top]
        return mi.load_dict(
            {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f(place),
                "fov": float(np.rad2deg(2 * np.arctan(width / 2 / focal))),
                "fov_axis": "x",
                "near_clip": 0.05,
                "far_clip": 100.0,
                "principal_point_offset_x": float(0.5 - centre[0] / width),
                "principal_point_offset_y": float(0.5 - centre[1] / height),
                "film": {
                    "type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba",
                    "component_format": "float32", "rfilter": {"type": "box"}, "sample_border": False,
                },
                "sampler": {"type": "multijitter", "sample_count": 16},
            }
        )  # fmt: skip

    def _render(self, sensor: Any, samples: int, seed: int) -> np.ndarray:
        image = self.mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=samples, seed=seed)
        return np.array(image, dtype=np.float64)

    def _cast(self, camera: Camera, left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        mi = self.mi
        x, y = np.meshgrid(left + np.arange(width) + 0.5, top + np.arange(height) + 0.5)
        rays = np.stack(
            [(x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1], np.ones_like(x)], -1
        )
        directions = rays.reshape(-1, 3) @ camera.viewmat[:3, :3]
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        origin = camera.position.astype(np.float32)
        if self.vectorised:
            ray = mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(np.ascontiguousarray(directions.T)))
            hit = self.scene.ray_intersect_preliminary(ray, False)
            person = np.array(hit.is_valid()) & (np.array(hit.t) < 1e4)
            triangle = np.where(person, np.array(hit.prim_index).astype(np.int64), -1)
            barycentric = np.array(hit.prim_uv).T
        else:
            hits = [self.scene.ray_intersect_preliminary(mi.Ray3f(origin, d), False) for d in directions]
            triangle = np.array([h.prim_index if h.is_valid() else -1 for h in hits], dtype=np.int64)
            barycentric = np.array([list(h.prim_uv) for h in hits])
        barycentric = np.where((triangle >= 0)[:, None], barycentric, 0)  # A miss leaves garbage there.
        # A ray may end at a light: only hits that lie where the person's triangle lies count.
        corners = self.vertices[self.surface.faces[np.clip(triangle, 0, len(self.surface.faces) - 1)]].astype(
            np.float64
        )
        weights = np.concatenate([1 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
        points = np.einsum("nk,nka->na", weights, corners) - origin
        aside = np.linalg.norm(points - np.sum(points * directions, axis=1, keepdims=True) * directions, axis=1)
        valid = (triangle >= 0) & (aside < 1e-3)
        triangle = np.where(valid, triangle, -1).astype(np.int32).reshape(height, width)
        barycentric = np.where(valid[:, None], barycentric, 0).astype(np.float32).reshape(height, width, 2)
        return triangle, barycentric


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)


def _paste(window: np.ndarray, camera: Camera, left: int, top: int, empty: int) -> np.ndarray:
    whole = np.full((camera.height, camera.width, *window.shape[2:]), empty, dtype=window.dtype)
    whole[top : top + window.shape[0], left : left + window.shape[1]] = window
    return whole


def _probe_here(variant: str) -> None:
    """Render a small textured square; run in a process of its own because a wrong LLVM aborts it."""
    libllvm = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    surface = Surface(
        vertices=np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], dtype=np.float64),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64),
        uv_faces=np.array([[0, 1, 2], [0, 2, 3]]),
        part=np.zeros(2, dtype=np.int64),
    )
    texture = np.full((8, 8, 3), 128, dtype=np.uint8)
    renderer = Renderer(variant=variant, libllvm=libllvm, mitsuba="", note="")
    studio = Studio(renderer, surface, texture, Light(), depth=3)
    studio.dress(surface.vertices)
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[:3, 3] = [0, 1, 4]
    K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    camera = Camera(name="probe", width=32, height=32, K=K, viewmat=viewmat)
    picture = studio.picture(camera, samples=8, seed=0)
    if picture.rgba[16, 16, 3] != 255 or picture.triangle[16, 16] < 0 or not 20 < picture.rgba[16, 16, :3].mean() < 250:
        raise SystemExit("the probe picture is wrong")
    print(json.dumps({"mitsuba": studio.mi.__version__}))


if __name__ == "__main__":
    _probe_here(sys.argv[1])
