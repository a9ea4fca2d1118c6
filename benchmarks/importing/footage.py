"""A folder of footage as a capture without truth: docs/import.md says what lies where.

    images/CAM/*FRAME.png   or .jpg; RGB, or RGBA with straight alpha; a file's name ends with the frame's number
    masks/CAM/*FRAME.png    grey, white is the person; absent where the images have alpha
    cameras.json            or another of `cameras.FILES`
    skeleton.json, motion.npz, template.npz   as captures have them

Pictures are read one at a time, and the capture appears when all of them are good.
"""

import io
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ash.capture.dataset import Camera, Capture, Motion, Skeleton, TemplateMesh, image_path
from ash.capture.formats import (
    load_capture,
    read_motion,
    read_skeleton,
    read_template,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.capture.manifest import Manifest, Split, hash_files
from ash.capture.novelty import novelty_deg
from ash.files import LIMITS, InputError, hash_of, open_regular, require_plain, write_image
from benchmarks.importing.cameras import find_camera_file, read_any_cameras
from benchmarks.importing.overlap import Overlap, template_overlaps
from benchmarks.problems import Problems

MOST_FILES = 1 << 20  # of a camera
PERSON = (0.5, 2.6)  # least and largest extent of a template, metres
FARTHEST_CAMERA = 50.0  # from the person, metres
LEAST_IOU = 0.3  # of a camera's masks and the posed template: below, something is mixed up
UNITS = {"centimetres": 100, "millimetres": 1000}
NUMBERED = re.compile(r".*?(\d{1,9})\.(?:png|jpg|jpeg)", re.IGNORECASE)

Files = dict[str, dict[int, Path]]  # by camera and frame


def import_footage(
    folder: Path,
    out: Path,
    *,
    name: str = "",
    subject: int = 0,
    cameras: Path | None = None,
    test_cameras: Sequence[str] = (),
    test_frames: tuple[int, int] | None = None,
    least_iou: float = LEAST_IOU,
) -> tuple[Capture, list[Overlap]]:
    """Write footage as a capture without truth into `out`, which appears when all of it is good.

    `name`: of the scene, by default that of `out`; `subject`: who it is, from 0; `cameras`: their file, where it is not
    one of those that the folder is searched for; `test_cameras`: held out, by default a quarter, 1 to 8;
    `test_frames`: held out, from the first to before the second, by default those of the last sequence of several;
    `least_iou`: what each camera's masks and the posed template must reach, 0 to 1.

    Raises:
        InputError: a part is missing or damaged, its lengths are no metres, `out` is not empty, or the name is not
            plain.
        Problems: cameras and pictures do not match, a picture is missing, damaged or of another size, a mask is empty
            or full, or a camera's masks are elsewhere than the template.
    """
    out = out.resolve()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: expected an empty folder")
    try:
        scene = require_plain(name or out.name, what="scene")
    except ValueError as error:
        raise InputError(f"--name: {error}") from error
    skeleton = read_skeleton(folder / "skeleton.json")
    template = read_template(folder / "template.npz", joints=len(skeleton.names))
    motion = read_motion(folder / "motion.npz", joints=len(skeleton.names))
    rig = read_any_cameras(cameras or find_camera_file(folder))
    _require_metres(folder, template, skeleton, motion, rig)
    kinds = ("images", "masks") if (folder / "masks").is_dir() else ("images",)
    files = _pictures(folder, kinds, rig)
    frames = sorted(set().union(*files["images"].values()))
    if frames[-1] >= len(motion.dofs):
        raise InputError(f"{folder}/images: frame {frames[-1]}, and motion.npz ends with {len(motion.dofs) - 1}")
    splits = _splits(folder, list(rig), frames, motion, test_cameras, test_frames)
    _require_complete(folder, files, splits)
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name[:40]}."))
    try:
        problems = []
        for camera, frame in (view for split in splits.values() for view in split.views):
            try:
                paths = [files[kind][camera][frame] for kind in kinds]
                write_image(image_path(made, camera, frame), _rgba(paths, rig[camera]))
            except InputError as error:
                problems.append(str(error))
        if problems:
            raise Problems(problems)
        write_cameras(made / "cameras.json", list(rig.values()))
        write_skeleton(made / "skeleton.json", skeleton)
        write_template(made / "template.npz", template)
        write_motion(made / "motion.npz", motion)
        _write_manifest(made, scene, subject, motion, splits)
        overlaps = template_overlaps(load_capture(made))
        if apart := [row for row in overlaps if row.iou < least_iou]:
            raise Problems(
                [
                    f"{folder}: camera {row.camera}: masks and posed template overlap by {row.iou:.2f} (IoU),"
                    f" expected {least_iou:g} or more: do its name, axes, units and frame numbers fit?"
                    for row in apart
                ]
            )
        made.chmod(0o755)
        made.rename(out)
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return load_capture(out), overlaps


def _write_manifest(folder: Path, scene: str, subject: int, motion: Motion, splits: dict[str, Split]) -> None:
    files, novelty = hash_files(folder), None
    if "novel_pose" in splits:
        novelty = float(np.mean(novelty_deg(motion, train=splits["train"].frames, test=splits["novel_pose"].frames)))
    source = f"imported {hash_of(files)[:16]}"  # Tells captures apart that no scene describes.
    Manifest(
        scene=scene,
        seed=0,
        splits=splits,
        files=files,
        source=source,
        parameters={"subject": subject} if subject else {},
        pose_novelty_deg=novelty,
    ).write(folder)


def _require_metres(
    folder: Path, template: TemplateMesh, skeleton: Skeleton, motion: Motion, cameras: dict[str, Camera]
) -> None:
    """Refuse lengths that are too large or too small for metres, with the unit that they may have."""
    extent = float(np.ptp(template.vertices, axis=0).max())
    middle = template.vertices.mean(axis=0) + np.median(motion.dofs[:, :3], axis=0)
    away = float(np.median([np.linalg.norm(camera.position - middle) for camera in cameras.values()]))
    moved = float(np.ptp(motion.dofs[:, :3], axis=0).max())
    for what, value, (least, most), likely in (
        ("template.npz: the template extends over", extent, PERSON, PERSON),
        ("skeleton.json: the joints extend over", float(np.ptp(skeleton.heads, axis=0).max()), (0, PERSON[1]), PERSON),
        ("motion.npz: the root moves over", moved, (0, FARTHEST_CAMERA), (0.1, 10)),
        ("cameras: their median distance to the person is", away, (0.1, FARTHEST_CAMERA), (0.5, 15)),
    ):
        if not least <= value <= most:
            units = [unit for unit, count in UNITS.items() if likely[0] <= value / count <= likely[1]]
            guess = f"; is it {' or '.join(units)}?" if units else ""
            raise InputError(f"{folder}: {what} {value:.4g} units, expected metres, {least:g} to {most:g}{guess}")


def _pictures(folder: Path, kinds: Sequence[str], cameras: dict[str, Camera]) -> dict[str, Files]:
    """The pictures of each kind by camera and frame; `Problems` has a line for each thing that does not fit."""
    files: dict[str, Files] = {kind: {name: {} for name in cameras} for kind in kinds}
    problems = []
    for kind in kinds:
        place = folder / kind
        if not place.is_dir():
            raise InputError(f"{place}: expected a folder with a folder of pictures for each camera")
        for name in sorted({entry.name for entry in os.scandir(place) if entry.is_dir()} | set(cameras)):
            if name not in cameras:
                problems.append(f"{place / name}: no camera is called so, expected {', '.join(cameras):.200}")
                continue
            if not (place / name).is_dir():
                problems.append(f"{place / name}: camera {name} has no folder of pictures")
                continue
            listed = files[kind][name]
            for count, entry in enumerate(sorted(os.scandir(place / name), key=lambda entry: entry.name)):
                if count == MOST_FILES:
                    raise InputError(f"{place / name}: more than {MOST_FILES} files")
                matched = NUMBERED.fullmatch(entry.name)
                if matched is None:
                    problems.append(f"{entry.path}: expected a .png or .jpg whose name ends with the frame's number")
                elif (frame := int(matched[1])) in listed:
                    problems.append(f"{entry.path}: frame {frame} is also {listed[frame].name}")
                else:
                    listed[frame] = Path(entry.path)
            if not listed:
                problems.append(f"{place / name}: no pictures")
    if problems:
        raise Problems(problems)
    return files


def _require_complete(folder: Path, files: dict[str, Files], splits: dict[str, Split]) -> None:
    """Refuse missing pictures, with a line per camera."""
    frames_of: dict[str, list[int]] = {}
    for camera, frame in (view for split in splits.values() for view in split.views):
        frames_of.setdefault(camera, []).append(frame)
    problems = []
    for kind, listed in files.items():
        for name, frames in frames_of.items():
            if missing := [frame for frame in frames if frame not in listed[name]]:
                count = f"{len(missing)} of {len(frames)} frames are missing"
                problems.append(f"{folder / kind / name}: {count}, the first is {missing[0]}")
    if problems:
        raise Problems(problems)


def _splits(
    folder: Path,
    cameras: list[str],
    frames: list[int],
    motion: Motion,
    test_cameras: Sequence[str],
    test_frames: tuple[int, int] | None,
) -> dict[str, Split]:
    """Training cameras in training frames; held-out cameras in those, and in test frames, which come last."""
    if unknown := sorted(set(test_cameras) - set(cameras)):
        raise InputError(f"test cameras: no camera {unknown[0]}, expected some of {', '.join(cameras):.200}")
    count = min(max(1, len(cameras) // 4), 8) if len(cameras) > 1 else 0
    held = tuple(dict.fromkeys(test_cameras)) or tuple(
        cameras[int(len(cameras) / count * (k + 0.5))] for k in range(count)
    )
    shown = tuple(name for name in cameras if name not in held)
    last = int(motion.sequence[frames[-1]])
    if test_frames is not None:
        tested = tuple(frame for frame in frames if test_frames[0] <= frame < test_frames[1])
    elif last != int(motion.sequence[frames[0]]):
        tested = tuple(frame for frame in frames if motion.sequence[frame] == last)
    else:
        tested = ()
    train = tuple(frame for frame in frames if frame not in set(tested))
    if not shown or not train or (test_frames is not None and not tested):
        raise InputError(
            f"{folder}: expected frames and cameras to train on besides those to test on, and frames there"
        )
    if tested and tested[0] < train[-1]:
        raise InputError(f"{folder}: test frame {tested[0]} lies before training frame {train[-1]}, expected it behind")
    splits = {"train": Split(cameras=shown, frames=train)}
    if held:
        splits["novel_view"] = Split(cameras=held, frames=train)
    if tested:
        splits["novel_pose"] = Split(cameras=held or shown, frames=tested)
    return splits


def _rgba(paths: Sequence[Path], camera: Camera) -> np.ndarray:
    """A view from its picture and, where it has no alpha, its mask: uint8 `[h, w, 4]`, straight alpha."""
    path = paths[-1]
    if len(paths) == 1:
        rgba = _read(path, camera, ("RGBA",), "with alpha, as there is no folder masks")
    else:
        colour = _read(paths[0], camera, ("RGB", "RGBA"), "in colour")[..., :3]
        rgba = np.dstack([colour, _read(path, camera, ("L", "1", "P", "RGB"), "in grey")])
    mask = rgba[..., 3] > 127
    if mask.all() or not mask.any():
        most = int(rgba[..., 3].max())
        raise InputError(
            f"{path}: the mask covers the whole picture"
            if mask.any()
            else f"{path}: the mask is empty: its values go to {most}, expected some above 127"
        )
    return rgba


def _read(path: Path, camera: Camera, modes: Sequence[str], expected: str) -> np.ndarray:
    """A picture of a camera's size and one of Pillow's modes, uint8; grey ones `[h, w]`."""
    try:
        with open_regular(path, most=16 * LIMITS["image pixels"]) as file:
            content = io.BytesIO(file.read())
        with Image.open(content, formats=["PNG", "JPEG"]) as image:
            if image.size != (camera.width, camera.height):
                got = "{}x{}".format(*image.size)
                raise InputError(f"{path}: {got} pixels, expected {camera.width}x{camera.height} of its camera")
            if image.mode not in modes or image.width * image.height > LIMITS["image pixels"]:
                raise InputError(f"{path}: a picture of mode {image.mode}, expected one {expected} with 8 bits")
            return np.array(image.convert("L") if "L" in modes else image)
    except InputError:
        raise
    except Exception as error:  # Pillow meets damage with a dozen kinds of errors.
        raise InputError(f"{path}: expected a PNG or JPEG picture ({error})") from error
