"""Rendering: the only file that knows Mitsuba. Path-traced pictures, and what each pixel's centre hits.

One thread per process: floating-point sums then have one order, and a picture has the same bytes in any sharding.
"""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Camera
from ash.files import InputError
from synth.camera.background import make_hall
from synth.camera.lighting import is_plain, make_integrator, make_lamps, make_sky, sky_and_lamps
from synth.camera.sensing import Window, make_sensor, window_of
from synth.person.body import Surface, vertex_normals
from synth.scene import Light

OLDEST_LLVM = 17  # 15 and 16 accept the first kernels and then abort the process ("Cannot select fminimum")
PROBE_SECONDS, PROBES = 300, 2
KILLED = (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP)  # by others; a wrong LLVM aborts by itself


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
    libraries = {str(path.resolve()) for folder in folders for path in Path(folder).glob("libLLVM*.so*")}
    libraries |= {str(path.resolve()) for folder in folders for path in Path(folder).glob("libLLVM*.dylib")}
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    usable = sorted((path for path in libraries if llvm_version(path) >= OLDEST_LLVM), key=llvm_version, reverse=True)
    if given and (llvm_version(given) == 0 or llvm_version(given) >= OLDEST_LLVM):
        usable = [given, *usable]
    return usable


@lru_cache(maxsize=1)
def probe() -> Renderer:
    """Find a renderer that really renders: each candidate draws a small textured scene in a process of its own.

    Raises:
        InputError: not even scalar_rgb works; or a probe was killed again and again.
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
    root = str(Path(__file__).resolve().parents[2])
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
    command = [sys.executable, "-m", "synth.camera.render", variant]
    for _ in range(PROBES):
        try:
            done = subprocess.run(command, env=environment, capture_output=True, timeout=PROBE_SECONDS)
        except subprocess.TimeoutExpired:
            continue
        except OSError:
            return ""
        if done.returncode in KILLED:
            continue  # That says nothing of what it tried.
        try:
            return str(json.loads(done.stdout)["mitsuba"]) if done.returncode == 0 else ""
        except (json.JSONDecodeError, KeyError):
            return ""
    raise InputError(f"the probe of Mitsuba's {variant} was killed from outside, or stopped, {PROBES} times; run again")


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
        self.lights = make_lamps(self.mi, light)
        self.plain = is_plain(light, depth=depth, vectorised=self.vectorised)
        if self.plain:
            self.integrator = sky_and_lamps(self.mi, light)
        else:
            self.lights["sky"] = make_sky(self.mi, light)
            self.integrator = make_integrator(self.mi, light, depth=depth)
        self.scene: Any = None
        self.bare: Any = None
        self.vertices = np.zeros((0, 3))

    def _material(self, texture: np.ndarray, light: Light) -> Any:
        mi = self.mi
        bitmap = mi.Bitmap(np.array(texture), pixel_format=mi.Bitmap.PixelFormat.RGB)
        colour = {"type": "bitmap", "bitmap": bitmap, "filter_type": "bilinear", "wrap_mode": "clamp", "raw": False}
        diffuse = {"type": "diffuse", "reflectance": colour}
        if light.gloss == 0:
            return mi.load_dict({"type": "twosided", "bsdf": diffuse})
        # A coat of low refraction mirrors the lamps and hardly the sky, which would lie like milk on dark cloth.
        satin = {
            "type": "roughplastic", "diffuse_reflectance": colour, "specular_reflectance": light.gloss,
            "int_ior": 1.36, "alpha": 0.1,
        }  # fmt: skip
        return mi.load_dict({"type": "twosided", "bsdf": satin})

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
        self.bare = mi.load_dict({"type": "scene", "person": mesh})  # No lamp stands between a pixel and its truth.
        if self.plain:
            self.integrator.person = self.bare

    def render(
        self,
        pose: np.ndarray,
        cameras: list[Camera],
        *,
        samples: int,
        seeds: list[int],
    ) -> list[Picture]:
        """Render views of a `pose` `[s, 3]`.

        Light is gathered in two halves of independent noise. One ray through every pixel's centre tells what is there.
        """
        windows = [window_of(camera, pose) for camera in cameras]
        halves = [[np.zeros((window.height, window.width, 4)) for _ in range(2)] for window in windows]
        self._wear(pose)
        for camera, window, pair, seed in zip(cameras, windows, halves, seeds, strict=True):
            sensor = make_sensor(self.mi, camera, window, vectorised=self.vectorised)
            for index, half in enumerate(pair):
                half += self._render(sensor, -(-samples // 2), (seed + index) % 2**32)
        return [self._develop(*view) for view in zip(cameras, windows, halves, strict=True)]

    def _wear(self, pose: np.ndarray) -> None:
        if pose.shape != self.vertices.shape or not np.array_equal(pose.astype(np.float32), self.vertices):
            self.dress(pose)

    def _render(self, sensor: Any, samples: int, seed: int) -> np.ndarray:
        image = self.mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=samples, seed=seed)
        return np.array(image, dtype=np.float64)

    def _develop(self, camera: Camera, window: Window, halves: list[np.ndarray]) -> Picture:
        """The picture from its two halves, and its truth."""
        mean = (halves[0] + halves[1]) / 2
        alpha = np.clip(mean[..., 3:], 0, 1)
        colours = [_to_srgb(half[..., :3] / np.maximum(half[..., 3:], 1e-6)) for half in halves]
        noise = np.mean((colours[0] - colours[1]) ** 2, axis=-1) / 4
        rgba = np.concatenate([_to_srgb(mean[..., :3] / np.maximum(alpha, 1e-6)), alpha], axis=-1)
        rgba = np.where(np.round(255 * alpha) > 0, np.round(255 * rgba), 0).astype(np.uint8)
        noise = np.where(rgba[..., 3] > 0, noise, 0).astype(np.float32)
        triangle, barycentric = self._cast(camera, window)
        return Picture(
            rgba=window.paste(rgba, camera, 0),
            triangle=window.paste(triangle, camera, -1),
            barycentric=window.paste(barycentric, camera, 0),
            noise=window.paste(noise, camera, 0),
        )

    def look(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """What each pixel's centre sees of the person: triangle `[h, w]` (-1: none) and barycentrics `[h, w, 2]`."""
        window = window_of(camera, self.vertices)
        triangle, barycentric = self._cast(camera, window)
        return window.paste(triangle, camera, -1), window.paste(barycentric, camera, 0)

    def hits(self, origin: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays from `origin` `[3]` towards `targets` `[n, 3]` first meet the person, and which triangle (-1)."""
        directions = targets - origin
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        distance, triangle, _ = self._trace(origin.astype(np.float32), directions)
        return origin + np.where(triangle >= 0, distance, 0)[:, None] * directions, triangle

    def _trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance `[n]`, triangle `[n]` (-1: none) and barycentrics `[n, 2]` of what rays of unit length hit."""
        mi = self.mi
        if self.vectorised:
            ray = mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(np.ascontiguousarray(directions.T)))
            hit = self.bare.ray_intersect_preliminary(ray, False)
            triangle = np.where(np.array(hit.is_valid()), np.array(hit.prim_index).astype(np.int64), -1)
            return np.array(hit.t), triangle, np.array(hit.prim_uv).T
        hits = [self.bare.ray_intersect_preliminary(mi.Ray3f(origin, d), False) for d in directions]
        triangle = np.array([h.prim_index if h.is_valid() else -1 for h in hits], dtype=np.int64)
        return np.array([h.t for h in hits]), triangle, np.array([list(h.prim_uv) for h in hits])

    def _cast(self, camera: Camera, window: Window) -> tuple[np.ndarray, np.ndarray]:
        directions = camera.directions(window.centres)
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        origin = camera.position.astype(np.float32)
        _, triangle, barycentric = self._trace(origin, directions)
        # A ray that misses leaves garbage in its barycentrics.
        barycentric = np.where((triangle >= 0)[:, None], barycentric, 0).astype(np.float32)
        shape = (window.height, window.width)
        return triangle.astype(np.int32).reshape(shape), barycentric.reshape(*shape, 2)


def empty_studio(renderer: Renderer, cameras: list[Camera], *, seed: int, samples: int = 64) -> list[np.ndarray]:
    """The empty studio in every camera, sRGB uint8 `[h, w, 3]`."""
    mi = _use(renderer)
    radius = max(float(np.hypot(*camera.position[[0, 2]])) for camera in cameras)
    hall, integrator = make_hall(mi, radius, seed), mi.load_dict({"type": "direct"})
    images = []
    for camera in cameras:
        whole = Window(left=0, top=0, width=camera.width, height=camera.height)
        sensor = make_sensor(mi, camera, whole, vectorised=bool(renderer.libllvm))
        image = np.array(mi.render(hall, sensor=sensor, integrator=integrator, spp=samples, seed=seed % 2**32))
        images.append(np.round(255 * _to_srgb(image[..., :3].astype(np.float64))).astype(np.uint8))
    return images


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)


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
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[:3, 3] = [0, 1, 4]
    K = np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    camera = Camera(name="probe", width=32, height=32, K=K, viewmat=viewmat)
    picture = studio.render(surface.vertices, [camera], samples=8, seeds=[0])[0]
    if picture.rgba[16, 16, 3] != 255 or picture.triangle[16, 16] < 0 or not 20 < picture.rgba[16, 16, :3].mean() < 250:
        raise SystemExit("the probe picture is wrong")
    print(json.dumps({"mitsuba": studio.mi.__version__}))


if __name__ == "__main__":
    _probe_here(sys.argv[1])
