"""The formats by name, and one frame of an avatar in one of them."""

from collections.abc import Callable
from dataclasses import dataclass

from ash.capture.dataset import Pose
from ash.devices import CPU, moved
from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.protocol import Avatar, DressesMesh, PosesGaussians
from benchmarks.export.gltf import gaussians_glb, mesh_glb
from benchmarks.export.ply import ply_bytes
from benchmarks.export.splat import splat_bytes
from benchmarks.export.spz import spz_bytes


@dataclass(frozen=True, kw_only=True, slots=True)
class Format:
    """How Gaussians are written."""

    suffix: str
    write: Callable[[Gaussians], bytes]


GAUSSIAN_FORMATS = {
    "ply": Format(suffix=".ply", write=ply_bytes),  # as 3D Gaussian splatting writes them
    "splat": Format(suffix=".splat", write=splat_bytes),  # 32 bytes each, one colour from all sides
    "spz": Format(suffix=".spz", write=spz_bytes),  # compressed
    "gltf": Format(suffix=".glb", write=gaussians_glb),  # KHR_gaussian_splatting
}
MESH, SKELETON = "glb", "bvh"
FORMATS = (*GAUSSIAN_FORMATS, MESH, SKELETON)


def suffix_of(form: str) -> str:
    """How a file of the format ends.

    Raises:
        InputError: an unknown format; lists the known ones.
    """
    if form not in FORMATS:
        raise InputError(f"format: expected one of {', '.join(FORMATS)}, got {form!r}")
    return GAUSSIAN_FORMATS[form].suffix if form in GAUSSIAN_FORMATS else f".{form}"


def frame_bytes(avatar: Avatar, pose: Pose, *, form: str, title: str) -> bytes:
    """One frame of the avatar as a file.

    Raises:
        InputError: the avatar is made of something else than the format holds; names it by `title`.
    """
    if form == MESH:
        if not isinstance(avatar, DressesMesh):
            raise InputError(f"{title}: has no textured mesh; expected a mesh avatar (ddc) for the format {MESH}")
        return mesh_glb(avatar.dressed_mesh(pose))
    if not isinstance(avatar, PosesGaussians):
        raise InputError(f"{title}: has no Gaussians; expected an avatar made of them for the format {form}")
    return GAUSSIAN_FORMATS[form].write(moved(avatar.gaussians(pose), CPU))
