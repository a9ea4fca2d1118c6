"""The realistic body: the anny model (CC0 data), each subject's shape baked once into a small cache, then dressed.

anny is constructed in a process of its own with its cache in a temporary folder (0.8 GB, removed afterwards). That
takes most of the time, so a whole block of subjects is baked at once. What is kept of each is one body shape:
vertices, quads, UVs and skin weights merged onto our joints.
"""

import gzip
import hashlib
import os
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Skeleton
from ash.files import InputError, read_arrays, write_arrays
from synth.person.cast import BLOCK, FIRST, Shape, subject
from synth.posing import bone_frames, linear_blend_skinning, rotation_between, rotmat_to_rotvec, rotvec_to_rotmat
from synth.skeleton import JOINTS, SIDES, SIGNS

FORMAT = 3
BAKE_SECONDS = 900
BAKED = ("vertices", "quads", "uvs", "uv_quads", "weights", "heads", "eyes", "mouth")

# The joint that takes each of anny's bones, by the start of the bone's name; the first match counts.
BONES = (
    ("root", "pelvis"),
    ("pelvis", "pelvis"),
    ("spine05", "pelvis"),
    ("spine04", "spine"),
    ("spine03", "spine"),
    ("spine", "chest"),
    ("breast", "chest"),
    ("neck", "neck"),
    ("clavicle", "clavicle"),
    ("shoulder", "clavicle"),
    ("upperarm", "upper_arm"),
    ("lowerarm", "forearm"),
    ("wrist", "hand"),
    ("finger", "hand"),
    ("metacarpal", "hand"),
    ("upperleg", "thigh"),
    ("lowerleg", "shin"),
    ("foot", "foot"),
    ("toe", "toe"),
)
HEADS = {
    "pelvis": "spine05",
    "spine": "spine04",
    "chest": "spine02",
    "neck": "neck01",
    "head": "head",
    "clavicle": "clavicle",
    "upper_arm": "upperarm01",
    "forearm": "lowerarm01",
    "hand": "wrist",
    "thigh": "upperleg01",
    "shin": "lowerleg01",
    "foot": "foot",
    "toe": "toe2-1",
}


def cache_folder() -> Path:
    """Where baked bodies lie: `ASH_BENCH_CACHE`, or the user's cache folder."""
    given = os.environ.get("ASH_BENCH_CACHE")
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ash-bench"


def baked_body(number: int = 0) -> dict[str, np.ndarray]:
    """The baked arrays (`BAKED`) of a subject, from the cache or newly baked with the others of its block."""
    path = _path(subject(number).shape)
    if not path.is_file():
        _bake_apart(number)
    return read_arrays(path, expected=BAKED)


def bake_key(shape: Shape = FIRST.shape) -> str:
    """What identifies a baked body: the release of anny, the shape and how it is merged."""
    try:
        release = version("anny")
    except PackageNotFoundError as error:
        raise InputError("this scene needs the anny body model: expected the package anny to be installed") from error
    return hashlib.sha256(repr((FORMAT, release, sorted(shape.phenotypes.items()), BONES)).encode()).hexdigest()[:12]


def _path(shape: Shape) -> Path:
    return cache_folder() / f"body-{bake_key(shape)}.npz"


def _bake_apart(number: int) -> None:
    root = str(Path(__file__).resolve().parents[2])
    with tempfile.TemporaryDirectory(prefix="ash-bench-anny-") as scratch:
        environment = dict(os.environ)
        environment["ANNY_CACHE_DIR"] = str(Path(scratch) / "anny")
        environment["WARP_CACHE_PATH"] = str(Path(scratch) / "warp")
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
        command = [sys.executable, "-m", "synth.person.anny_body", str(number)]
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=BAKE_SECONDS, check=False
        )
    if done.returncode or not _path(subject(number).shape).is_file():
        raise InputError(f"baking the anny body failed: {done.stderr.strip().splitlines()[-1:] or 'no message'}")


def _bake(number: int) -> None:
    """Bake what is missing of a subject's block; the subject itself comes first."""
    import warnings

    warnings.simplefilter("ignore")
    import anny
    from anny.models import full_model
    from anny.models.legacy import legacy_rig_to_anny, legacy_topology_to_anny

    full_model.load_blend_shape = load_blend_shape  # anny's own takes a minute for its thousand files.
    first = number // BLOCK * BLOCK
    block = sorted(range(first, first + BLOCK), key=lambda k: k != number)
    missing = [shape for shape in (subject(k).shape for k in block) if not _path(shape).is_file()]
    # A descent needs anny's whole range of shapes; subject 0 has none and keeps the reduced model, and so its bytes.
    models = {
        False: anny.create_fullbody_model,
        True: lambda: anny.Anny(
            rig=legacy_rig_to_anny("default", "blender-rootidentity"),
            topology=legacy_topology_to_anny(),
            phenotypes="all",
            phenotype_blendshapes="original",
            pose_parameterization="local-bone",
        ),
    }
    for mixed, make in models.items():
        shapes = [shape for shape in missing if (shape.descent is not None) == mixed]
        model = make() if shapes else None
        for shape in shapes:
            write_arrays(_path(shape), **_baked(model, shape))


def load_blend_shape(filename: str, vertices_count: int, world_transformation: Any, dtype: Any) -> Any:
    """anny's function of this name: per line a vertex and its offset in decimetres. Twelve times as fast."""
    import torch

    with gzip.open(filename, "rt") as archive:
        rows = np.fromstring(archive.read(), sep=" ").reshape(-1, 4)
    offsets = torch.zeros((vertices_count, 3), dtype=dtype)
    offsets[rows[:, 0].astype(np.int64)] = torch.from_numpy(rows[:, 1:]).to(dtype)
    return world_transformation.apply(offsets)


def _baked(model: Any, shape: Shape) -> dict[str, np.ndarray]:
    """What is kept of one shape of a body model."""
    import torch

    phenotypes = {name: torch.tensor([value], dtype=torch.float32) for name, value in shape.phenotypes.items()}
    body = model(phenotype_kwargs=phenotypes)
    bones = tuple(model.bone_labels)
    heads = _to_ours(body["rest_bone_heads"][0].numpy())
    rig = Skeleton(names=bones, parents=np.array(model.bone_parents), heads=heads)
    dense = np.zeros((len(model.vertex_bone_indices), len(bones)))
    rows = np.arange(len(dense))
    for column in range(model.vertex_bone_indices.shape[1]):
        np.add.at(
            dense, (rows, model.vertex_bone_indices[:, column].numpy()), model.vertex_bone_weights[:, column].numpy()
        )
    dense /= dense.sum(axis=1, keepdims=True)
    vertices, heads = _relax_hands(rig, _to_ours(body["rest_vertices"][0].numpy()), dense)
    floor = np.array([0, vertices[:, 1].min(), 0])
    heads = heads - floor
    names = [name for name, _ in JOINTS]
    merge = np.zeros((len(bones), len(names)))
    merge[np.arange(len(bones)), [names.index(_joint_of(bone)) for bone in bones]] = 1
    return {
        "vertices": vertices - floor,
        "quads": model.faces.numpy().astype(np.int64),
        "uvs": model.texture_coordinates.numpy().astype(np.float64),
        "uv_quads": model.face_texture_coordinate_indices.numpy().astype(np.int64),
        "weights": dense @ merge,
        "heads": np.stack([heads[bones.index(_bone_of(name))] for name in names]),
        "eyes": np.stack([heads[bones.index(f"eye.{side}")] for side in "LR"]),
        "mouth": (heads[bones.index("oris05")] + heads[bones.index("oris01")]) / 2,
    }


def _relax_hands(rig: Skeleton, vertices: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Curl the spread fingers and turn the palms so that they face the thighs when the arms hang."""
    head = {name: rig.heads[j] for j, name in enumerate(rig.names)}
    rotvecs = np.zeros((len(rig.names), 3))
    for mark, sign in zip("LR", SIGNS, strict=True):
        along = {k: _unit(head[f"finger{k}-2.{mark}"] - head[f"finger{k}-1.{mark}"]) for k in range(1, 6)}
        middle = _unit(along[2] + along[3] + along[4] + along[5])
        # Fingers rest a little bent: the way they bend is the palm's side.
        bent = sum(_unit(head[f"finger{k}-3.{mark}"] - head[f"finger{k}-2.{mark}"]) - along[k] for k in (2, 3, 4, 5))
        across = head[f"finger2-1.{mark}"] - head[f"finger5-1.{mark}"]
        palm = _unit(np.cross(across, middle))
        palm = palm * np.sign(palm @ bent)
        for k in range(2, 6):
            closing = rotvec_to_rotmat(0.55 * rotmat_to_rotvec(rotation_between(along[k], middle)))
            curl = _unit(np.cross(middle, palm))
            for joint, angle in ((1, 0.22 + 0.06 * k), (2, 0.45), (3, 0.3)):
                turn = rotvec_to_rotmat(angle * curl) @ (closing if joint == 1 else np.eye(3))
                rotvecs[rig.names.index(f"finger{k}-{joint}.{mark}")] = rotmat_to_rotvec(turn)
        thumb = rotvec_to_rotmat(0.4 * rotmat_to_rotvec(rotation_between(along[1], middle)))
        rotvecs[rig.names.index(f"finger1-1.{mark}")] = rotmat_to_rotvec(thumb)
        forearm = _unit(head[f"wrist.{mark}"] - head[f"lowerarm01.{mark}"])
        hang = rotation_between(
            head[f"lowerarm01.{mark}"] - head[f"upperarm01.{mark}"], np.array([0.05 * sign, -1.0, 0])
        )
        hang = rotation_between(hang @ forearm, np.array([0, -1.0, 0])) @ hang
        facing, wanted = hang @ palm, np.array([-sign, 0, -0.35])
        twist = np.arctan2(
            np.cross(facing, wanted)[1], facing[[0, 2]] @ wanted[[0, 2]]
        )  # about +y; the arm points to -y
        for bone in ("lowerarm02", "wrist"):
            rotvecs[rig.names.index(f"{bone}.{mark}")] += -0.5 * twist * forearm
    frames = bone_frames(rig, np.concatenate([np.zeros(3), rotvecs.ravel()])[None])[0]
    transforms = frames.copy()
    transforms[:, :3, 3] -= np.einsum("jab,jb->ja", frames[:, :3, :3], rig.heads)
    return linear_blend_skinning(vertices, weights, transforms), frames[:, :3, 3]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _to_ours(points: np.ndarray) -> np.ndarray:
    """From anny's axes (z up, facing -y) to ours (y up, facing +z)."""
    x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
    return np.stack([x, z, -y], axis=-1)


def _joint_of(bone: str) -> str:
    for start, joint in BONES:
        if bone.startswith(start):
            paired = joint in HEADS and joint not in ("pelvis", "spine", "chest", "neck", "head")
            return f"{joint}_{'left' if bone.endswith('.L') else 'right'}" if paired else joint
    return "head"  # jaw, lips, eyes, brows


def _bone_of(joint: str) -> str:
    for side, mark in zip(SIDES, "LR", strict=True):
        if joint.endswith(f"_{side}"):
            return f"{HEADS[joint.removesuffix(f'_{side}')]}.{mark}"
    return HEADS[joint]


if __name__ == "__main__":
    _bake(int(sys.argv[1]))
