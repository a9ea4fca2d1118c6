"""A trained mesh avatar drawn in real time by OpenGL (pyrender, off-screen): how the mesh baseline is displayed.

The same picture as the training renderer's (`baselines.ddc`): bilinear texture samples at the centres of half pixels,
averaged. The light, which depends on the normal alone, travels as vertex colours.
"""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from torch import Tensor

from ash.capture.dataset import Camera, Pose, TemplateMesh
from ash.devices import CPU, moved
from ash.files import InputError
from ash.harmonics import sh_basis
from ash.mesh.drawing import SUPERSAMPLING
from ash.protocol import StageClock
from ash.template.template import PosedTemplate
from ash.textures import build_lattice

NEAR, FAR = 0.1, 50.0  # metres
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # Our cameras look along +z with y down, OpenGL's along -z with y up.
LINEAR, CLAMP_TO_EDGE = 9729, 33071  # OpenGL's names for: bilinear without mipmaps; the border's texels go on.


def pyrender_or_refuse() -> Any:
    """Import pyrender for drawing without a screen.

    `PYOPENGL_PLATFORM` is read when OpenGL is first imported; without it pyrender would look for a screen.

    Raises:
        InputError: a system library is missing, or the platform draws on screens only.
    """
    platform = os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if platform not in ("egl", "osmesa"):
        raise InputError(f"PYOPENGL_PLATFORM: expected egl or osmesa to draw without a screen, got {platform!r}")
    try:
        import pyrender
    except Exception as error:  # Missing libraries show as ImportError, AttributeError and others.
        raise InputError(f"pyrender cannot be imported ({type(error).__name__}: {error})") from error
    return pyrender


def _one_sample_renderer(pyrender: Any) -> Any:
    """An off-screen renderer that looks at the centre of each pixel, as the training renderer does.

    pyrender always asks for four samples per pixel, which costs twice the time and moves silhouettes; here its
    multisampled buffers are allocated again with one.
    """
    from OpenGL import GL
    from pyrender.renderer import Renderer

    class OneSample(Renderer):  # type: ignore[misc]
        def _configure_main_framebuffer(self) -> None:
            known = self._main_fb_dims
            super()._configure_main_framebuffer()
            if self._main_fb_dims == known:
                return
            formats = ((self._main_cb_ms, GL.GL_RGBA), (self._main_db_ms, GL.GL_DEPTH_COMPONENT24))
            for buffer, kind in formats:
                GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
                GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, self.viewport_width, self.viewport_height)

    class OffScreen(pyrender.OffscreenRenderer):  # type: ignore[misc, name-defined]
        def _create(self) -> None:
            super()._create()
            self._renderer.delete()  # type: ignore[has-type]
            self._renderer = OneSample(self.viewport_width, self.viewport_height)

    return OffScreen(64, 64)


class MeshDisplay:
    """Draws a mesh avatar. Has `render` as an avatar has, so that it is timed and compared in the same way."""

    def __init__(
        self,
        dress: Callable[[Pose, StageClock], tuple[PosedTemplate, Tensor]],
        *,
        faces: Int[Tensor, "f 3"],
        uvs: Float[Tensor, "u 2"],
        uv_faces: Int[Tensor, "f 3"],
        light: Float[Tensor, "9 3"] | None,
    ) -> None:
        """Open an OpenGL context. `dress`: the posed template of a frame and its texture `[3, t, t]`.

        Raises:
            InputError: there is no off-screen OpenGL here.
        """
        self.dress, self.light = dress, moved(light, CPU)
        self.pyrender = pyrender_or_refuse()
        try:
            self.renderer = _one_sample_renderer(self.pyrender)
        except Exception as error:
            raise InputError(f"no off-screen OpenGL here ({type(error).__name__}: {error})") from error
        # OpenGL knows one UV per vertex: vertices at seams are listed once per UV.
        pairs = torch.stack([faces.reshape(-1), uv_faces.reshape(-1)], 1).cpu()
        corners, index = torch.unique(pairs, dim=0, return_inverse=True)
        self.vertex, self.uvs = corners[:, 0], uvs.cpu()[corners[:, 1]].numpy()
        self.faces = index.reshape(-1, 3).numpy()

    def close(self) -> None:
        """Free the OpenGL context."""
        self.renderer.delete()

    @torch.no_grad()
    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`, as the avatar's own `render`."""
        posed, texture = self.dress(pose, clock)
        with clock.stage("stg4"):
            return self._draw(*moved((posed, texture), CPU), camera)

    def _draw(self, posed: PosedTemplate, texture: Tensor, camera: Camera) -> Float[np.ndarray, "h w 4"]:
        # Texels are stored in eight bits between 0 and 1; what exceeds 1 is scaled down, and up again with the light.
        scale = texture.max().clamp(min=1.0)
        material = self._material((texture / scale).clamp(0, 1))
        light = torch.ones_like(posed.normals)
        if self.light is not None:
            light = (sh_basis(posed.normals, 2) @ self.light).exp()
        colours = torch.cat([scale * light, torch.ones_like(light[:, :1])], 1)
        primitive = self.pyrender.Primitive(
            positions=posed.vertices[self.vertex].numpy(),
            texcoord_0=self.uvs,
            color_0=colours[self.vertex].numpy(),
            indices=self.faces,
            material=material,
            mode=4,  # triangles
        )
        scene = self.pyrender.Scene(bg_color=np.zeros(4))
        scene.add(self.pyrender.Mesh([primitive]))
        K = camera.K * SUPERSAMPLING
        eye = self.pyrender.IntrinsicsCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], znear=NEAR, zfar=FAR)
        scene.add(eye, pose=np.linalg.inv(camera.viewmat) @ TO_OPENGL)
        self.renderer.viewport_width = camera.width * SUPERSAMPLING
        self.renderer.viewport_height = camera.height * SUPERSAMPLING
        flags = self.pyrender.RenderFlags
        drawn, _ = self.renderer.render(scene, flags.FLAT | flags.RGBA | flags.SKIP_CULL_FACES)
        # Sums of strided views are ten times as fast as a mean over two axes.
        steps = range(SUPERSAMPLING)
        total = sum(drawn[y::SUPERSAMPLING, x::SUPERSAMPLING].astype(np.uint16) for y in steps for x in steps)
        return np.asarray(total, np.float32) / np.float32(255 * SUPERSAMPLING**2)

    def _material(self, texture: Tensor) -> Any:
        pixels = (255 * texture).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
        sampler = self.pyrender.Sampler(magFilter=LINEAR, minFilter=LINEAR, wrapS=CLAMP_TO_EDGE, wrapT=CLAMP_TO_EDGE)
        image = self.pyrender.Texture(sampler=sampler, source=pixels, source_channels="RGB")
        return self.pyrender.MetallicRoughnessMaterial(baseColorTexture=image, baseColorFactor=np.ones(4))


def texture_gain(
    light: Float[Tensor, "9 3"] | None, normals: Float[Tensor, "v 3"], mesh: TemplateMesh, size: int
) -> Float[Tensor, "3 t t"]:
    """What the light multiplies every texel by; beside the charts, as at the nearest texel of one."""
    if light is None:
        return torch.ones(3, size, size)
    lattice = build_lattice(mesh, size)
    unit = torch.nn.functional.normalize(lattice.interpolate(normals), dim=-1)
    beside = np.ones((size, size), dtype=bool)
    beside.reshape(-1)[lattice.texels.numpy()] = False
    nearest = ndimage.distance_transform_edt(beside, return_distances=False, return_indices=True).astype(np.int64)
    gain = lattice.to_texture((sh_basis(unit, 2) @ light).exp())
    return gain[:, torch.from_numpy(nearest[0]), torch.from_numpy(nearest[1])]
