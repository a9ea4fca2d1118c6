"""The formats of a trained avatar by name, and one frame of it as a file."""

from pathlib import Path

from ash.capture.dataset import Pose
from ash.devices import CPU, moved
from ash.files import InputError
from ash.protocol import Avatar, DressesMesh, PosesGaussians
from benchmarks.export.gaussians import ply_bytes, spz_bytes
from benchmarks.export.gltf import gaussians_gltf, mesh_gltf

# The suffixes of each format's files, its own first.
FRAMES = {"ply": (".ply",), "spz": (".spz",), "gltf": (".glb", ".gltf")}
MOTIONS = {"bvh": (".bvh",), "mp4": (".mp4", ".webp"), "html": (".html",)}
FORMATS = FRAMES | MOTIONS


def suffix_of(form: str, path: Path) -> str:
    """The suffix of the format's files: that of `path`, or the format's own where `path` has none.

    Raises:
        InputError: a path with the suffix of another format.
    """
    if path.suffix and path.suffix not in FORMATS[form]:
        raise InputError(f"{path}: expected a name that ends with {' or '.join(FORMATS[form])} for the format {form}")
    return path.suffix or FORMATS[form][0]


def frame_bytes(avatar: Avatar, pose: Pose, *, suffix: str, title: str) -> bytes:
    """One frame of the avatar as a file with one of the suffixes of `FRAMES`; glTF of a mesh avatar holds the mesh.

    Raises:
        InputError: the avatar has no Gaussians; names it by `title`.
    """
    if suffix in FRAMES["gltf"] and isinstance(avatar, DressesMesh):
        return mesh_gltf(avatar.dressed_mesh(pose), binary=suffix == ".glb")
    if not isinstance(avatar, PosesGaussians):
        raise InputError(
            f"{title}: has no Gaussians, expected an avatar that has; of meshes, gltf, bvh and mp4 are made"
        )
    gaussians = moved(avatar.gaussians(pose), CPU)
    if suffix in FRAMES["gltf"]:
        return gaussians_gltf(gaussians, binary=suffix == ".glb")
    return ply_bytes(gaussians) if suffix == ".ply" else spz_bytes(gaussians)
