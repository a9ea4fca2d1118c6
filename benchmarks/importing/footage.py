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
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True, slots=True)
class HeldOut:
    """What no method may learn from. By default a quarter of the cameras, and of several sequences the last."""

    cameras: tuple[str, ...] = ()  # held out; none: a quarter, 1 to 8
    frames: tuple[int, int] | None = None  # from the first to before the second


@dataclass(frozen=True, kw_only=True, slots=True)
class Footage:
    """A folder whose small parts are read and whose files are listed."""

    folder: Path
    cameras: dict[str, Camera]
    skeleton: Skeleton
    template: TemplateMesh
    motion: Motion
    splits: dict[str, Split]
    images: Files
    masks: Files  # empty: the images have alpha

    @property
    def views(self) -> list[tuple[str, int]]:
        """All (camera, frame) pairs that become images of the capture."""
        return [view for split in self.splits.values() for view in split.views]


def read_footage(folder: Path, *, cameras: Path | None = None, test: HeldOut | None = None) -> Footage:
    """Read the small parts of a folder and list its pictures; none is opened.

    `cameras`: the file of cameras, where it is not one of those that the folder is searched for.

    Raises:
        InputError: a part is missing or damaged, or its lengths are no metres.
        Problems: cameras and pictures do not match, or pictures are missing.
    """
    skeleton = read_skeleton(folder / "skeleton.json")
    joints = len(skeleton.names)
    template = read_template(folder / "template.npz", joints=joints)
    motion = read_motion(folder / "motion.npz", joints=joints)
    rig = read_any_cameras(cameras or find_camera_file(folder))
    _require_metres(folder, template, skeleton, motion, rig)
    images, problems = _pictures(folder / "images", rig)
    masks: Files = {}
    if (folder / "masks").is_dir():
        masks, more = _pictures(folder / "masks", rig)
        problems += more
    if problems:
        raise Problems(problems)
    frames = sorted(set().union(*images.values()))
    if frames[-1] >= len(motion.dofs):
        raise InputError(f"{folder}/images: frame {frames[-1]}, and motion.npz ends with {len(motion.dofs) - 1}")
    splits = _splits(folder, list(rig), frames, motion, test or HeldOut())
    footage = Footage(
        folder=folder, cameras=rig, skeleton=skeleton, template=template, motion=motion, splits=splits,
        images=images, masks=masks,
    )  # fmt: skip
    wanted: dict[str, list[int]] = {name: [] for name in rig}
    for camera, frame in footage.views:
        wanted[camera].append(frame)
    for what, files in (("images", images), ("masks", masks)):
        if not files:
            continue
        for name, frames in wanted.items():
            if missing := [frame for frame in frames if frame not in files[name]]:
                count = f"{len(missing)} of {len(frames)} frames are missing"
                problems.append(f"{folder / what / name}: {count}, the first is {missing[0]}")
    if problems:
        raise Problems(problems)
    return footage


def import_footage(
    footage: Footage, out: Path, *, name: str = "", least_iou: float = LEAST_IOU
) -> tuple[Capture, list[Overlap]]:
    """Write footage as a capture without truth into `out`, which appears when all of it is good.

    `name`: of the scene, by default that of `out`; `least_iou`: what each camera's masks and the posed template must
    reach, 0 to 1.

    Raises:
        InputError: `out` is not empty, or the name is not plain.
        Problems: a picture is damaged or of another size, a mask is empty or full, or a camera's masks are elsewhere
            than the template.
    """
    out = out.resolve()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: expected an empty folder")
    try:
        scene = require_plain(name or out.name, what="scene")
    except ValueError as error:
        raise InputError(f"--name: {error}") from error
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name[:40]}."))
    try:
        problems = []
        for camera, frame in footage.views:
            try:
                write_image(image_path(made, camera, frame), _rgba(footage, camera, frame))
            except InputError as error:
                problems.append(str(error))
        if problems:
            raise Problems(problems)
        _write_parts(footage, made, scene)
        overlaps = template_overlaps(load_capture(made))
        if apart := [row for row in overlaps if row.iou < least_iou]:
            raise Problems(
                [
                    f"{footage.folder}: camera {row.camera}: masks and posed template overlap by {row.iou:.2f} (IoU),"
                    f" expected {least_iou:g} or more: do its name, axes, units and frame numbers fit?"
                    for row in apart
                ]
            )
        made.chmod(0o755)
        made.rename(out)
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return load_capture(out), overlaps


def _write_parts(footage: Footage, folder: Path, scene: str) -> None:
    """Everything of a capture but its images, the manifest last."""
    write_cameras(folder / "cameras.json", list(footage.cameras.values()))
    write_skeleton(folder / "skeleton.json", footage.skeleton)
    write_template(folder / "template.npz", footage.template)
    write_motion(folder / "motion.npz", footage.motion)
    splits, files, novelty = footage.splits, hash_files(folder), None
    if "novel_pose" in splits:
        far = novelty_deg(footage.motion, train=splits["train"].frames, test=splits["novel_pose"].frames)
        novelty = float(np.mean(far))
    source = f"imported {hash_of(files)[:16]}"  # Tells captures apart that no scene describes.
    Manifest(scene=scene, seed=0, splits=splits, files=files, source=source, pose_novelty_deg=novelty).write(folder)


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


def _pictures(folder: Path, cameras: dict[str, Camera]) -> tuple[Files, list[str]]:
    """The pictures below a folder by camera and frame, and a line for each thing that does not fit."""
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder with a folder of pictures for each camera")
    folders = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir())
    problems = [f"{folder / name}: no camera is called so, expected {', '.join(cameras):.200}"
                for name in folders if name not in cameras]  # fmt: skip
    problems += [f"{folder / name}: camera {name} has no folder of pictures" for name in cameras if name not in folders]
    files: Files = {}
    for name in sorted(set(folders) & set(cameras)):
        files[name] = {}
        for count, entry in enumerate(sorted(os.scandir(folder / name), key=lambda entry: entry.name)):
            if count == MOST_FILES:
                raise InputError(f"{folder / name}: more than {MOST_FILES} files")
            matched = NUMBERED.fullmatch(entry.name)
            if matched is None:
                problems.append(f"{entry.path}: expected a .png or .jpg whose name ends with the frame's number")
            elif (frame := int(matched[1])) in files[name]:
                problems.append(f"{entry.path}: frame {frame} is also {files[name][frame].name}")
            else:
                files[name][frame] = Path(entry.path)
        if not files[name]:
            problems.append(f"{folder / name}: no pictures")
    return files, problems


def _splits(folder: Path, cameras: list[str], frames: list[int], motion: Motion, test: HeldOut) -> dict[str, Split]:
    """Training cameras in training frames; held-out cameras in those, and in test frames, which come last."""
    if unknown := sorted(set(test.cameras) - set(cameras)):
        raise InputError(f"test cameras: no camera {unknown[0]}, expected some of {', '.join(cameras):.200}")
    count = min(max(1, len(cameras) // 4), 8) if len(cameras) > 1 else 0
    held = tuple(dict.fromkeys(test.cameras)) or tuple(
        cameras[int(len(cameras) / count * (k + 0.5))] for k in range(count)
    )
    shown = tuple(name for name in cameras if name not in held)
    last = int(motion.sequence[frames[-1]])
    if test.frames is not None:
        tested = tuple(frame for frame in frames if test.frames[0] <= frame < test.frames[1])
    elif last != int(motion.sequence[frames[0]]):
        tested = tuple(frame for frame in frames if motion.sequence[frame] == last)
    else:
        tested = ()
    train = tuple(frame for frame in frames if frame not in set(tested))
    if not shown or not train or (test.frames is not None and not tested):
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


def _rgba(footage: Footage, camera: str, frame: int) -> np.ndarray:
    """A view as uint8 `[h, w, 4]`, straight alpha."""
    path, by = footage.images[camera][frame], footage.cameras[camera]
    if not footage.masks:
        rgba = _read(path, by, ("RGBA",), "with alpha, as there is no folder masks")
    else:
        colour = _read(path, by, ("RGB", "RGBA"), "in colour")[..., :3]
        path = footage.masks[camera][frame]
        rgba = np.dstack([colour, _read(path, by, ("L", "1", "P", "RGB"), "in grey")])
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
