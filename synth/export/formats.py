"""Exports of a finished capture: the released code's files, nerfstudio, COLMAP, plain files, and the test views."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ash.capture.dataset import Capture, Split, scan_path
from ash.capture.formats import write_cameras, write_skeleton, write_template
from ash.files import InputError, write_arrays, write_atomic, write_image, write_json
from synth.export.official import export_official
from synth.export.readme import PLAIN, TEST_VIEWS, readme
from synth.export.undistorted import undistort
from synth.posing import bone_frames, dual_quaternion_skinning, rotmat_to_unitquat, skinning_transforms


def export_nerfstudio(capture: Capture, folder: Path, *, split: str = "train", frame: int | None = None) -> Path:
    """`transforms.json` per frame folder, OpenGL cameras, images with alpha: one static scene per frame of a split."""
    chosen = _split(capture, split)
    frames = chosen.frames if frame is None else (_frame(chosen, split, frame),)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for index in frames:
        target = folder / f"frame_{index:06d}"
        rows = []
        for name in chosen.seeing(index):
            camera = capture.cameras[name]
            write_image(target / "images" / f"{name}.png", capture.image(name, index))
            rows.append(
                {
                    "file_path": f"images/{name}.png",
                    "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]),
                    "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
                    "w": camera.width, "h": camera.height,
                    **dict(zip(("k1", "k2", "p1", "p2"), camera.distortion.tolist(), strict=True)),
                    "transform_matrix": (np.linalg.inv(camera.viewmat) @ flip).tolist(),
                }
            )  # fmt: skip
        write_json(target / "transforms.json", {"camera_model": "OPENCV", "frames": rows})
    count = f"{len(frames)} frame{'s' if len(frames) > 1 else ''}"
    by = f"{len(chosen.seeing(frames[0]))} of its {len(chosen.cameras)} cameras"
    _write_about(capture, folder, f"{count} of split {split}, a folder each, seen by {by}")
    return folder


def export_colmap(capture: Capture, folder: Path, *, split: str = "train", frame: int | None = None) -> Path:
    """COLMAP text model of a frame (by default the first): cameras, images, points of the skinned template."""
    chosen = _split(capture, split)
    frame = chosen.frames[0] if frame is None else _frame(chosen, split, frame)
    cameras, images = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    seeing = chosen.seeing(frame)
    for index, name in enumerate(seeing, start=1):
        camera = capture.cameras[name]
        K = [float(value) for value in camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]]
        model = "PINHOLE" if camera.is_pinhole else "OPENCV"
        K += [] if camera.is_pinhole else camera.distortion.tolist()
        cameras.append(f"{index} {model} {camera.width} {camera.height} " + " ".join(map(repr, K)))
        pose = (*rotmat_to_unitquat(camera.viewmat[:3, :3]), *camera.viewmat[:3, 3])
        images += [f"{index} " + " ".join(repr(float(v)) for v in pose) + f" {index} {name}.png", ""]
        write_image(folder / "images" / f"{name}.png", capture.image(name, frame))
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK"]
    for index, point in enumerate(posed_template(capture, frame), start=1):
        points.append(f"{index} " + " ".join(repr(float(v)) for v in point) + " 128 128 128 0")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        text = "\n".join(lines) + "\n"
        write_atomic(folder / "sparse" / "0" / f"{name}.txt", text.encode())
    what = f"split {split}, frame {frame}, seen by {len(seeing)} of its {len(chosen.cameras)} cameras"
    _write_about(capture, folder, f"{what}; the points are the template's vertices, skinned to that frame")
    return folder


def posed_template(capture: Capture, frame: int) -> np.ndarray:
    """Vertices `[v, 3]` in metres of the template as the skeleton alone moves it in a frame."""
    transforms = skinning_transforms(capture.skeleton, capture.motion.dofs[[frame]])[0]
    return dual_quaternion_skinning(capture.template.vertices, capture.template.skin_weights, transforms)


def _split(capture: Capture, name: str) -> Split:
    if name not in capture.splits:
        raise InputError(f"{capture.folder}: no split {name!r}, expected one of {', '.join(capture.splits)}")
    return capture.splits[name]


def _frame(split: Split, name: str, frame: int) -> int:
    if frame not in split.frames:
        known = ", ".join(str(known) for known in split.frames[:20]) + (", ..." if len(split.frames) > 20 else "")
        raise InputError(f"no frame {frame} in split {name}, expected one of {known}")
    return frame


def _write_about(capture: Capture, folder: Path, what: str) -> None:
    """State in the export's folder what of the capture it holds."""
    write_atomic(folder / "ABOUT.txt", f"{capture.scene}, capture {capture.identity[:12]}: {what}.\n".encode())


View = tuple[str, str, int]  # split, camera, frame


def export_plain(capture: Capture, folder: Path) -> Path:
    """The training images with cameras, poses, template and scans, for a program that reads JSON, NumPy and PNG.

    README.md there says what each file means.
    """
    train = capture.splits["train"]
    for camera, frame in train.views:
        write_image(folder / _image(camera, frame), capture.image(camera, frame))
    _write_model(capture, folder, cameras=train.cameras, frames=train.frames)
    images = [{"camera": camera, "frame": frame, "image": _image(camera, frame)} for camera, frame in train.views]
    write_json(folder / "views.json", {"views": images})
    for frame in train.frames:
        if (scan := scan_path(capture.folder, frame)).is_file():
            write_atomic(scan_path(folder, frame), scan.read_bytes())
    write_atomic(folder / "README.md", readme(PLAIN, capture))
    _write_about(capture, folder, f"split train, {len(images)} images, straight alpha; README.md says what is what")
    return folder


def export_test_views(capture: Capture, folder: Path, *, views: Sequence[View]) -> Path:
    """What a method elsewhere is asked to render: cameras and poses of the scored views, none of their images.

    Pictures are named as they are in a cell, so that `ash-bench score` reads them; README.md there says how.
    """
    rows = [
        {"split": split, "camera": camera, "frame": frame, "image": _image(camera, frame, split=split)}
        for split, camera, frame in views
    ]
    cameras = tuple(dict.fromkeys(camera for _, camera, _ in views))
    _write_model(capture, folder, cameras=cameras, frames=range(len(capture.motion.dofs)))
    splits = {name: [row["image"] for row in rows if row["split"] == name] for name, _, _ in views}
    write_json(folder / "views.json", {"views": rows, "splits": splits})
    write_atomic(folder / "README.md", readme(TEST_VIEWS, capture))
    _write_about(capture, folder, f"{len(rows)} views to render as PNG files; README.md says how")
    return folder


def _image(camera: str, frame: int, *, split: str = "") -> str:
    return "/".join(["images", *([split] if split else []), camera, f"{frame:06d}.png"])


def _write_model(capture: Capture, folder: Path, *, cameras: Sequence[str], frames: Sequence[int]) -> None:
    """Cameras, skeleton, template, and the poses of some frames, also as the template that the skeleton moves."""
    motion, chosen = capture.motion, list(frames)
    write_cameras(folder / "cameras.json", [capture.cameras[name] for name in cameras])
    write_skeleton(folder / "skeleton.json", capture.skeleton)
    write_template(folder / "template.npz", capture.template)
    write_arrays(
        folder / "poses.npz",
        frame=np.array(chosen),
        sequence=motion.sequence[chosen],
        fps=np.array(motion.fps),
        dofs=motion.dofs[chosen],
        joints=bone_frames(capture.skeleton, motion.dofs[chosen]),
        skinning=skinning_transforms(capture.skeleton, motion.dofs[chosen]),
    )
    for frame in chosen:
        posed = posed_template(capture, frame).astype(np.float32)
        write_arrays(folder / "posed_template" / f"{frame:06d}.npz", vertices=posed)


FORMATS: dict[str, Callable[..., Path]] = {
    "ash": export_official,
    "nerfstudio": export_nerfstudio,
    "colmap": export_colmap,
    "plain": export_plain,
    "test-views": export_test_views,
    "undistorted": lambda capture, folder: undistort(capture.folder, folder),
}


def export(
    capture: Capture,
    folder: Path,
    *,
    form: str,
    split: str | None = None,
    frame: int | None = None,
    views: Sequence[View] = (),
) -> Path:
    """Write a capture into `folder` in one of the `FORMATS`.

    `split` and `frame` choose what nerfstudio and COLMAP hold; `views` are the scored ones, for `test-views`.

    Raises:
        InputError: an unknown split or frame, or a folder that cannot be written.
    """
    choice: dict = {"split": split or "train", "frame": frame} if form in ("nerfstudio", "colmap") else {}
    if form == "test-views":
        choice = {"views": views}
    try:
        return FORMATS[form](capture, folder, **choice)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
