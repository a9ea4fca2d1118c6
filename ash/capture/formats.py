"""The files of a capture, each written and read by one pair of functions."""

from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Camera, Capture, Motion, Skeleton, TemplateMesh, scan_path, surface_path
from ash.capture.manifest import NAME, read_manifest
from ash.files import LIMITS, InputError, read_arrays, read_json, require_plain, write_arrays, write_json

LARGEST = 1e9  # of a number in a camera or a skeleton: metres, pixels


def write_cameras(path: Path, cameras: list[Camera]) -> None:
    """Write `cameras.json`; of a pinhole no distortion is mentioned."""
    rows = [
        {"name": c.name, "width": c.width, "height": c.height, "K": c.K.tolist(), "viewmat": c.viewmat.tolist()}
        | ({} if c.is_pinhole else {"distortion": c.distortion.tolist()})
        for c in cameras
    ]
    write_json(path, {"cameras": rows})


def read_cameras(path: Path) -> dict[str, Camera]:
    """Read and check `cameras.json`; the bare list of its cameras will do.

    Raises:
        InputError: a field is missing or misshapen, a rotation is not orthonormal, a lens folds the picture, or a name
            is not a plain file name or stands there twice.
    """
    cameras: dict[str, Camera] = {}
    try:
        content = read_json(path)
        for row in content if isinstance(content, list) else content["cameras"]:
            camera = Camera(
                name=_plain_name(path, row["name"]),
                width=_whole(row["width"]),
                height=_whole(row["height"]),
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
        parents = np.array([_whole(row["parent"]) for row in rows], dtype=np.int64)
        heads = _matrix([row["head"] for row in rows], (len(rows), 3))
        names = tuple(require_plain(row["name"], what="joint") for row in rows)
    except InputError:
        raise
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
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
    names = ("vertices", "faces", "uvs", "uv_faces", "skin_weights")
    arrays = read_arrays(path, expected=names, most=LIMITS["mesh bytes"])
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
    stored = read_arrays(path, expected=("dofs", "sequence", "fps"), most=LIMITS["motion bytes"])
    arrays = {name: _widest(array) for name, array in stored.items()}
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


def read_surface_truth(folder: Path, frame: int) -> np.ndarray:
    """Vertices of the rendered surface in a frame, `[s, 3]` metres: what a lab would reconstruct per frame."""
    path = surface_path(folder, frame)
    vertices = read_arrays(path, expected=("vertices",))["vertices"]
    _require(path, {"vertices [s, 3]": vertices.ndim == 2 and vertices.shape[1] == 3 and len(vertices) > 0})
    return vertices


def read_surface_mesh_truth(capture: Capture, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The true surface of a frame: vertices `[s, 3]` in metres and faces `[f, 3]`. For oracles only.

    Raises:
        InputError: the capture shows no truth.
    """
    shared = capture.folder / "truth" / "surface.npz"
    if not shared.exists():
        raise InputError(f"{capture.folder}: expected truth/surface.npz, found none; only oracles see the true surface")
    return _mesh(shared, read_surface_truth(capture.folder, frame), read_arrays(shared, expected=("faces",))["faces"])


def read_scan(capture: Capture, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """What a scanner made of a training frame: vertices `[n, 3]` in metres, and faces `[f, 3]`.

    With noise, with holes, and without any correspondence to the template or between frames.

    Raises:
        InputError: there is none of this frame; only training frames have one, in captures that have scans.
    """
    path = scan_path(capture.folder, frame)
    if frame not in capture.splits["train"].frames or not path.exists():
        raise InputError(f"{capture.folder}: expected a scan of training frame {frame}, found none")
    arrays = read_arrays(path, expected=("vertices", "faces"))
    return _mesh(path, arrays["vertices"], arrays["faces"])


def _mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = _widest(vertices), _widest(faces)
    _require(path, {"vertices [s, 3]": vertices.ndim == 2 and vertices.shape[1] == 3 and len(vertices) > 0})
    _require(path, {"faces [f, 3] into vertices": _are_indices(faces, len(vertices))})
    return vertices, faces


def load_capture(folder: Path) -> Capture:
    """Load a finished capture and check its small parts; images are checked when they are read.

    Raises:
        InputError: not a capture, unfinished, of another schema, or with a part that is damaged.
    """
    manifest = read_manifest(folder)
    if not manifest.complete:
        raise InputError(f"{folder}: the capture is unfinished; run the command that made it again to finish it")
    for name in manifest.files:
        if name.startswith("/") or ".." in name.split("/") or not name.isprintable():
            raise InputError(f"{folder}/manifest.json: the file {name!r:.100} lies outside the capture")
    skeleton = read_skeleton(folder / "skeleton.json")
    joints = len(skeleton.names)
    cameras = read_cameras(folder / "cameras.json")
    motion = read_motion(folder / "motion.npz", joints=joints)
    for name, split in manifest.splits.items():
        if not set(split.cameras) <= set(cameras) or not set(split.frames) <= set(range(len(motion.dofs))):
            raise InputError(f"{folder / NAME}: split {name} names a camera or frame that the capture lacks")
    return Capture(
        folder=folder,
        scene=manifest.scene,
        manifest=manifest,
        splits=manifest.splits,
        cameras=cameras,
        skeleton=skeleton,
        template=read_template(folder / "template.npz", joints=joints),
        motion=motion,
    )


def _matrix(rows: Any, shape: tuple[int, ...]) -> np.ndarray:
    if not _are_numbers(rows):
        raise ValueError(f"expected numbers of shape {shape}")
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != shape or not (np.abs(matrix) < LARGEST).all():
        raise ValueError(f"expected finite numbers of shape {shape}, below {LARGEST:g}, got {matrix.shape}")
    return matrix


def _are_numbers(rows: Any) -> bool:
    """Whether nested lists hold nothing but numbers, as JSON has them."""
    if isinstance(rows, list):
        return all(_are_numbers(row) for row in rows)
    return isinstance(rows, int | float) and not isinstance(rows, bool)


def _whole(number: Any) -> int:
    if type(number) is not int or abs(number) >= 2**53:
        raise ValueError(f"expected a whole number, got {number!r:.60}")
    return number


def _plain_name(path: Path, name: Any) -> str:
    if not isinstance(name, str) or not name or not name.replace("_", "").replace("-", "").isalnum():
        raise InputError(f"{path}: expected a camera name of letters, digits, - and _, got {name!r}")
    return name


def _widest(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        return np.zeros((0,) * 9)  # A shape that nothing expects, so that the check of shapes names what is wrong.
    return array.astype(np.float64 if array.dtype.kind == "f" else np.int64)


def _are_indices(array: np.ndarray, count: int) -> bool:
    shaped = array.ndim == 2 and array.shape[1] == 3 and len(array) > 0
    return shaped and bool(array.min() >= 0 and array.max() < count)


def _require(path: Path, checks: dict[str, bool]) -> None:
    for expectation, holds in checks.items():
        if not holds:
            raise InputError(f"{path}: expected {expectation}")
