"""The capture on disk: the one contract between the generator of ground truth and everything else.

A capture is a folder:

    manifest.json        schema, scene, its parameters, seed, versions, splits, SHA-256 of every file, complete or not
    cameras.json         width, height; per camera: name, K, viewmat (world -> camera, OpenCV axes); for a lens with
                         distortion its k1 k2 p1 p2, and then images and truth are those of the distorted picture
    skeleton.json        joints: name, parent, rest position of its head
    template.npz         the template mesh that methods are given: rest vertices, faces, UVs, skin weights
    body.npz             the same of the body without clothes, as a fitted body model would give it; may be absent
    motion.npz           degrees of freedom per frame, and the sequence each frame belongs to
    frames/CAM/FRAME.png RGBA, uint8 sRGB, straight alpha
    truth/               what no real capture knows; only oracles and the evaluation may read it
        template.npz     vertices [t, v, 3]: where the template's vertices really are, per frame
        surface.npz      faces, uvs, uv_faces, part (label per face) of the rendered surface
        surface/FRAME.npz  vertices [s, 3] of the rendered surface, metres
        pixels/CAM/FRAME.npz  triangle [h, w] (-1: none), barycentric [h, w, 2] (weights of corners
                         1 and 2; corner 0 has the rest), noise [h, w] (variance of sRGB in 0..1)

Units are metres, radians and seconds; right-handed, y up; cameras follow OpenCV (x right, y down, z forward) with pixel
centres at +0.5. NumPy only: this module knows formats, no method and no renderer.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ash.files import InputError, read_arrays, read_image, read_json, sha256_of, write_arrays, write_json
from ash.lens import distort, undistort

SCHEMA = 1
SPLITS = ("train", "novel_view", "novel_pose")


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """A calibrated camera. `K` is in pixels; `viewmat` maps world to camera (OpenCV axes, metres).

    Methods only ever see pinhole cameras: a capture whose lenses distort is undistorted first
    (`synth.undistorting`), and `Capture.training_only` refuses the others.
    """

    name: str
    width: int
    height: int
    K: np.ndarray  # [3, 3] float64
    viewmat: np.ndarray  # [4, 4] float64
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(4))  # [4] k1 k2 p1 p2; zeros: a pinhole

    @property
    def position(self) -> np.ndarray:
        """Optical centre in the world, `[3]` metres."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens leaves straight lines straight."""
        return not self.distortion.any()

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points `[..., 3]` to pixels `[..., 2]` and depth along the optical axis `[...]` in metres."""
        in_camera = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        if self.is_pinhole:
            in_image = in_camera @ self.K.T
            return in_image[..., :2] / in_image[..., 2:], in_camera[..., 2]
        seen = distort(in_camera[..., :2] / in_camera[..., 2:], self.distortion)
        return seen @ self.K[:2, :2].T + self.K[:2, 2], in_camera[..., 2]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """World directions `[..., 3]`, of depth 1 and not of length 1, that pixels `[..., 2]` look along."""
        seen = (pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        ideal = seen if self.is_pinhole else undistort(seen, self.distortion)
        return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ self.viewmat[:3, :3]


@dataclass(frozen=True, kw_only=True, slots=True)
class Skeleton:
    """Joints in topological order (a parent precedes its children; the root has parent -1).

    Every joint's rest frame has the world's axes. With rotation vectors r (radians, parent's frame) and root
    translation t,
        G_root = T(head_root + t) R(r_root),    G_j = G_parent T(head_j - head_parent) R(r_j),
    and the skinning transform of joint j, rest to posed, is G_j T(-head_j).
    """

    names: tuple[str, ...]
    parents: np.ndarray  # [j] int
    heads: np.ndarray  # [j, 3] float64, metres


@dataclass(frozen=True, kw_only=True, slots=True)
class TemplateMesh:
    """The clothed rest mesh that methods are given, as a person-specific scan would be."""

    vertices: np.ndarray  # [v, 3] float64, metres, rest pose
    faces: np.ndarray  # [f, 3] int64 into vertices
    uvs: np.ndarray  # [u, 2] float64 in [0, 1], u to the right, v up
    uv_faces: np.ndarray  # [f, 3] int64 into uvs
    skin_weights: np.ndarray  # [v, j] float64, rows sum to 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """Degrees of freedom per frame: root translation (metres), then one rotation vector per joint (radians).

    A window of motion never reaches across the start of a sequence: earlier frames repeat its first.
    """

    dofs: np.ndarray  # [t, 3 + 3 j] float64
    sequence: np.ndarray  # [t] int64, the sequence each frame belongs to
    fps: float

    def window(self, frame: int, length: int) -> np.ndarray:
        """Indices of the `length` frames that end with `frame`, newest first, clamped to the start of its sequence."""
        first = int(np.flatnonzero(self.sequence == self.sequence[frame])[0])
        return np.maximum(frame - np.arange(length), first)


@dataclass(frozen=True, kw_only=True, slots=True)
class Split:
    """Which cameras and frames belong together; every pair has an image."""

    cameras: tuple[str, ...]
    frames: tuple[int, ...]

    @property
    def views(self) -> list[tuple[str, int]]:
        """All (camera, frame) pairs, frame by frame."""
        return [(camera, frame) for frame in self.frames for camera in self.cameras]


@dataclass(frozen=True, kw_only=True, slots=True)
class Capture:
    """A loaded capture. Small parts are in memory; images and truth are read when asked for."""

    folder: Path
    scene: str
    manifest: dict[str, Any]  # as on disk, for provenance
    splits: dict[str, Split]
    cameras: dict[str, Camera]
    skeleton: Skeleton
    template: TemplateMesh
    motion: Motion
    store: Path | None = None  # where what is derived from the capture may be kept for other methods; None: nowhere

    @property
    def identity(self) -> str:
        """SHA-256 over the manifest: two captures with equal identity hold equal bytes."""
        return sha256_of(self.folder / "manifest.json")

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGBA of a view, uint8 `[h, w, 4]`, sRGB, straight alpha."""
        view = self.cameras[camera]
        return read_image(image_path(self.folder, camera, frame), shape=(view.height, view.width, 4))

    def training_only(self) -> "Capture":
        """What a method may learn from: training cameras, frames and motion; no held-out view and no test motion.

        Raises:
            InputError: a lens distorts, and methods know pinhole cameras only.
        """
        bent = [name for name, camera in self.cameras.items() if not camera.is_pinhole]
        if bent:
            raise InputError(f"{self.folder}: the lens of {bent[0]} distorts; run ash-bench undistort on it first")
        train = self.splits["train"]
        count = max(train.frames) + 1  # Training sequences come first, so indices stay as they are.
        motion = replace(self.motion, dofs=self.motion.dofs[:count], sequence=self.motion.sequence[:count])
        cameras = {name: self.cameras[name] for name in train.cameras}
        return replace(self, splits={"train": train}, cameras=cameras, motion=motion)


def require_pose(motion: Motion, frame: int, skeleton: Skeleton) -> None:
    """Refuse a frame that a motion lacks, a pose of another skeleton, and a pose with NaN or infinity.

    Raises:
        InputError: says what was expected and what came.
    """
    width = 3 + 3 * len(skeleton.names)
    if motion.dofs.ndim != 2 or motion.dofs.shape[1] != width:
        raise InputError(f"motion: expected degrees of freedom of shape [t, {width}], got {motion.dofs.shape}")
    if not 0 <= frame < len(motion.dofs):
        raise InputError(f"frame: expected 0 to {len(motion.dofs) - 1}, got {frame}")
    if not np.isfinite(motion.dofs[frame]).all():
        raise InputError(f"frame {frame}: expected a pose of finite numbers, got NaN or infinity")


def fewer_cameras(capture: Capture, share: float) -> Capture:
    """The capture with an evenly spread share (0..1] of its training cameras, at least one; other splits keep theirs.

    Cameras are added one by one, each the farthest from those chosen so far: a smaller share is a part of a larger.
    """
    train = capture.splits["train"]
    positions = np.stack([capture.cameras[name].position for name in train.cameras])
    chosen = [0]
    for _ in range(max(1, round(share * len(positions))) - 1):
        distance = np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(1)
        chosen.append(int(distance.argmax()))
    names = tuple(train.cameras[index] for index in sorted(chosen))
    return replace(capture, splits=capture.splits | {"train": replace(train, cameras=names)})


def image_path(folder: Path, camera: str, frame: int) -> Path:
    """Where the image of a view lies."""
    return folder / "frames" / camera / f"{frame:06d}.png"


def pixels_path(folder: Path, camera: str, frame: int) -> Path:
    """Where the per-pixel truth of a view lies."""
    return folder / "truth" / "pixels" / camera / f"{frame:06d}.npz"


def surface_path(folder: Path, frame: int) -> Path:
    """Where the rendered surface's vertices of a frame lie."""
    return folder / "truth" / "surface" / f"{frame:06d}.npz"


def write_cameras(path: Path, cameras: list[Camera]) -> None:
    """Write `cameras.json`; of a pinhole no distortion is mentioned."""
    rows = [
        {"name": c.name, "width": c.width, "height": c.height, "K": c.K.tolist(), "viewmat": c.viewmat.tolist()}
        | ({} if c.is_pinhole else {"distortion": c.distortion.tolist()})
        for c in cameras
    ]
    write_json(path, {"cameras": rows})


def read_cameras(path: Path) -> dict[str, Camera]:
    """Read and check `cameras.json`.

    Raises:
        InputError: a field is missing or misshapen, a rotation is not orthonormal, a lens folds the picture, or a name
            is not a plain file name or stands there twice.
    """
    cameras: dict[str, Camera] = {}
    try:
        for row in read_json(path)["cameras"]:
            camera = Camera(
                name=_plain_name(path, row["name"]),
                width=int(row["width"]),
                height=int(row["height"]),
                K=_matrix(row["K"], (3, 3)),
                viewmat=_matrix(row["viewmat"], (4, 4)),
                distortion=_matrix(row.get("distortion", [0, 0, 0, 0]), (4,)),
            )
            _check_camera(camera)
            if camera.name in cameras:
                raise ValueError(f"two cameras are called {camera.name}")
            cameras[camera.name] = camera
    except InputError:
        raise
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected a list of cameras with name, width, height, K, viewmat ({error})"
        ) from error
    if not cameras:
        raise InputError(f"{path}: expected at least one camera")
    return cameras


def _check_camera(camera: Camera) -> None:
    rotation, K = camera.viewmat[:3, :3], camera.K
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise ValueError(f"the rotation of camera {camera.name} is not orthonormal and right-handed")
    if not (0 < camera.width <= 16384 and 0 < camera.height <= 16384):
        raise ValueError(f"camera {camera.name} has size {camera.width}x{camera.height}, expected 1..16384")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
        raise ValueError(f"camera {camera.name}: K is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    if (camera.viewmat[3] != [0, 0, 0, 1]).any():
        raise ValueError(f"camera {camera.name}: the last row of viewmat is not 0 0 0 1")
    if not camera.is_pinhole:
        try:  # The rim bends most: a lens that has a direction for every pixel there has one for all.
            across, down = np.linspace(0, camera.width, 65), np.linspace(0, camera.height, 65)
            rim = [np.stack([across, 0 * across + y], axis=1) for y in (0, camera.height)]
            rim += [np.stack([0 * down + x, down], axis=1) for x in (0, camera.width)]
            camera.directions(np.concatenate(rim))
        except ValueError as error:
            raise ValueError(f"camera {camera.name}: {error}") from error


def write_skeleton(path: Path, skeleton: Skeleton) -> None:
    """Write `skeleton.json`."""
    rows = [
        {"name": name, "parent": int(parent), "head": head.tolist()}
        for name, parent, head in zip(skeleton.names, skeleton.parents, skeleton.heads, strict=True)
    ]
    write_json(path, {"joints": rows})


def read_skeleton(path: Path) -> Skeleton:
    """Read and check `skeleton.json`: one root, and every parent before its children."""
    try:
        rows = read_json(path)["joints"]
        parents = np.array([int(row["parent"]) for row in rows], dtype=np.int64)
        heads = _matrix([row["head"] for row in rows], (len(rows), 3))
        names = tuple(str(row["name"]) for row in rows)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a list of joints with name, parent, head ({error})") from error
    if len(rows) == 0 or parents[0] != -1 or not all(0 <= parents[j] < j for j in range(1, len(parents))):
        raise InputError(f"{path}: expected the root first with parent -1, and every parent before its children")
    return Skeleton(names=names, parents=parents, heads=heads)


def write_template(path: Path, template: TemplateMesh) -> None:
    """Write `template.npz`."""
    write_arrays(
        path,
        vertices=template.vertices,
        faces=template.faces,
        uvs=template.uvs,
        uv_faces=template.uv_faces,
        skin_weights=template.skin_weights,
    )


def read_template(path: Path, *, joints: int) -> TemplateMesh:
    """Read and check `template.npz` against a skeleton of `joints` joints."""
    arrays = read_arrays(path, expected=("vertices", "faces", "uvs", "uv_faces", "skin_weights"))
    template = TemplateMesh(**{name: _widest(array) for name, array in arrays.items()})
    vertices, faces, weights = template.vertices, template.faces, template.skin_weights
    checks = {
        "vertices [v, 3]": vertices.ndim == 2 and vertices.shape[1] == 3,
        "faces [f, 3] into vertices": _are_indices(faces, len(vertices)),
        "uvs [u, 2]": template.uvs.ndim == 2 and template.uvs.shape[1] == 2,
        "uv_faces [f, 3] into uvs": _are_indices(template.uv_faces, len(template.uvs))
        and len(faces) == len(template.uv_faces),
        f"skin_weights [v, {joints}]": weights.shape == (len(vertices), joints),
    }
    _require(path, checks)
    _require(path, {"skin weights that sum to 1": bool(np.abs(weights.sum(1) - 1).max() < 1e-4)})
    return template


def read_body(capture: Capture) -> TemplateMesh:
    """The body without clothes, for methods that are to do without a scan of the person."""
    path = capture.folder / "body.npz"
    if not path.exists():
        raise InputError(f"{path}: this capture has no bare body; remove the capture and render it again")
    return read_template(path, joints=len(capture.skeleton.names))


def write_motion(path: Path, motion: Motion) -> None:
    """Write `motion.npz`."""
    write_arrays(path, dofs=motion.dofs, sequence=motion.sequence, fps=np.array(motion.fps))


def read_motion(path: Path, *, joints: int) -> Motion:
    """Read and check `motion.npz` against a skeleton of `joints` joints."""
    arrays = {name: _widest(array) for name, array in read_arrays(path, expected=("dofs", "sequence", "fps")).items()}
    dofs, sequence = arrays["dofs"], arrays["sequence"]
    checks = {
        f"dofs [t, {3 + 3 * joints}]": dofs.ndim == 2 and dofs.shape[1] == 3 + 3 * joints and len(dofs) > 0,
        "sequence [t], never decreasing": sequence.shape == (len(dofs),) and bool((np.diff(sequence) >= 0).all()),
        "fps > 0": arrays["fps"].shape == () and float(arrays["fps"]) > 0,
    }
    _require(path, checks)
    return Motion(dofs=dofs, sequence=sequence, fps=float(arrays["fps"]))


def read_template_truth(capture: Capture) -> np.ndarray:
    """Where the template's vertices really are, `[t, v, 3]` metres. For oracles and the evaluation only."""
    path = capture.folder / "truth" / "template.npz"
    vertices = read_arrays(path, expected=("vertices",))["vertices"]
    expected = (len(capture.motion.dofs), len(capture.template.vertices), 3)
    _require(path, {f"vertices {expected}": vertices.shape == expected})
    return vertices


def read_surface_truth(capture: Capture, frame: int) -> np.ndarray:
    """Vertices of the rendered surface in a frame, `[s, 3]` metres: what a lab would reconstruct per frame."""
    path = surface_path(capture.folder, frame)
    vertices = read_arrays(path, expected=("vertices",))["vertices"]
    _require(path, {"vertices [s, 3]": vertices.ndim == 2 and vertices.shape[1] == 3 and len(vertices) > 0})
    return vertices


def scan_path(folder: Path, frame: int) -> Path:
    """Where the reconstructed surface of a training frame lies, in a capture that has been given to a method."""
    return folder / "scans" / f"{frame:06d}.npz"


def read_scan(capture: Capture, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """What a lab would reconstruct of a training frame: the surface's vertices `[s, 3]` in metres, and faces `[f, 3]`.

    Without any correspondence to the template or between frames that a method could rely on. Here it is the true
    surface.

    Raises:
        InputError: there is none of this frame; only training frames have one.
    """
    path, shared = scan_path(capture.folder, frame), capture.folder / "scans" / "faces.npz"
    if not path.exists():
        path, shared = surface_path(capture.folder, frame), capture.folder / "truth" / "surface.npz"
    if frame not in capture.splits["train"].frames or not path.exists() or not shared.exists():
        raise InputError(f"{capture.folder}: expected a scan of training frame {frame}, found none")
    vertices = read_arrays(path, expected=("vertices",))["vertices"]
    faces = _widest(read_arrays(shared, expected=("faces",))["faces"])
    _require(path, {"vertices [s, 3]": vertices.ndim == 2 and vertices.shape[1] == 3 and len(vertices) > 0})
    _require(shared, {"faces [f, 3] into vertices": _are_indices(faces, len(vertices))})
    return vertices, faces


def load_capture(folder: Path) -> Capture:
    """Load a finished capture and check its small parts; images are checked when they are read.

    Raises:
        InputError: not a capture, unfinished, of another schema, or with a part that is damaged.
    """
    manifest = read_manifest(folder)
    if not manifest["complete"]:
        raise InputError(f"{folder}: the capture is unfinished; run the command that made it again to finish it")
    skeleton = read_skeleton(folder / "skeleton.json")
    joints = len(skeleton.names)
    cameras = read_cameras(folder / "cameras.json")
    motion = read_motion(folder / "motion.npz", joints=joints)
    splits = {
        name: Split(cameras=tuple(split["cameras"]), frames=tuple(split["frames"]))
        for name, split in manifest["splits"].items()
    }
    for name, split in splits.items():
        if not set(split.cameras) <= set(cameras) or not set(split.frames) <= set(range(len(motion.dofs))):
            raise InputError(f"{folder}/manifest.json: split {name} names a camera or frame that the capture lacks")
    return Capture(
        folder=folder,
        scene=manifest["scene"],
        manifest=manifest,
        splits=splits,
        cameras=cameras,
        skeleton=skeleton,
        template=read_template(folder / "template.npz", joints=joints),
        motion=motion,
    )


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read `manifest.json` and check that this version of the package understands it."""
    path = folder / "manifest.json"
    manifest = read_json(path)
    if not isinstance(manifest, dict) or manifest.get("schema") != SCHEMA:
        found = manifest.get("schema") if isinstance(manifest, dict) else None
        raise InputError(f"{path}: expected capture schema {SCHEMA}, got {found}")
    missing = {"scene", "seed", "splits", "files", "complete"} - set(manifest)
    if missing or set(manifest["splits"]) - set(SPLITS) or "train" not in manifest["splits"]:
        raise InputError(f"{path}: expected the keys scene, seed, splits ({', '.join(SPLITS)}), files, complete")
    return manifest


def verify_capture(folder: Path) -> list[str]:
    """Hash every file of a capture again. Returns one line per file that is missing, altered or not in the manifest."""
    manifest = read_manifest(folder)
    problems = []
    for name, expected in sorted(manifest["files"].items()):
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            problems.append(f"{name}: outside the capture")
        elif not path.is_file():
            problems.append(f"{name}: missing")
        elif sha256_of(path) != expected:
            problems.append(f"{name}: altered (SHA-256 differs from the manifest)")
    present = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} - {"manifest.json"}
    problems += [f"{name}: not in the manifest" for name in sorted(present - set(manifest["files"]))]
    return problems


def _matrix(rows: Any, shape: tuple[int, ...]) -> np.ndarray:
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise ValueError(f"expected finite numbers of shape {shape}, got {matrix.shape}")
    return matrix


def _plain_name(path: Path, name: Any) -> str:
    if not isinstance(name, str) or not name or not name.replace("_", "").replace("-", "").isalnum():
        raise InputError(f"{path}: expected a camera name of letters, digits, - and _, got {name!r}")
    return name


def _widest(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float64 if array.dtype.kind == "f" else np.int64)


def _are_indices(array: np.ndarray, count: int) -> bool:
    shaped = array.ndim == 2 and array.shape[1] == 3 and len(array) > 0
    return shaped and bool(array.min() >= 0 and array.max() < count)


def _require(path: Path, checks: dict[str, bool]) -> None:
    for expectation, holds in checks.items():
        if not holds:
            raise InputError(f"{path}: expected {expectation}")
