"""Cameras of a user's footage: our `cameras.json`, nerfstudio, 3D Gaussian Splatting, or a text model of COLMAP."""

import json
import tempfile
from pathlib import Path
from typing import Any

from ash.capture.dataset import Camera
from ash.capture.formats import read_cameras
from ash.files import InputError, open_regular, read_json
from synth.camera.rig import rig_from_file

FILES = ("cameras.json", "transforms.json", "sparse/0/cameras.txt", "sparse/cameras.txt")
LARGEST = 64 << 20  # bytes of such a file
# Of COLMAP's models: where among the parameters fx, fy, cx and cy stand, and after how many the lens's k1 k2 p1 p2.
MODELS = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), 3),
    "PINHOLE": ((0, 1, 2, 3), 4),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), 3),
    "RADIAL": ((0, 0, 1, 2), 3),
    "OPENCV": ((0, 1, 2, 3), 4),
}


def find_camera_file(folder: Path) -> Path:
    """The one file of `FILES` that a folder holds.

    Raises:
        InputError: there is none, or several.
    """
    there = [folder / name for name in FILES if (folder / name).is_file()]
    if len(there) != 1:
        got = " and ".join(str(path.relative_to(folder)) for path in there) or "none"
        raise InputError(f"{folder}: expected one of {', '.join(FILES)}, got {got}; --cameras FILE chooses")
    return there[0]


def read_any_cameras(path: Path) -> dict[str, Camera]:
    """Cameras by name from a file of any of the formats; metres and OpenCV axes, as captures have them.

    A camera is called as its image without suffix (`cam0` of `images/cam0.png`). Cameras of nerfstudio and of 3D
    Gaussian Splatting are at least two and of one size.

    Raises:
        InputError: the file is of no such format, larger than 64 MiB, or a camera in it is not of our kind.
    """
    if path.suffix == ".txt":
        return read_colmap(path, path.with_name("images.txt"))
    content = read_json(path, most=LARGEST)
    rows = content.get("cameras") if isinstance(content, dict) else content
    if isinstance(rows, list) and any(isinstance(row, dict) and "viewmat" in row for row in rows):
        return read_cameras(path)
    try:
        return _checked(path, json.loads(rig_from_file(path).given)["cameras"])
    except OverflowError as error:
        raise InputError(f"{path}: a number is out of range ({error})") from error


def read_colmap(cameras: Path, images: Path) -> dict[str, Camera]:
    """The cameras of a text model of COLMAP: one per image, its pose with the lens that it names.

    Raises:
        InputError: a file is missing or damaged, or a lens is of a model other than `MODELS`.
    """
    from scipy.spatial.transform import Rotation

    lenses: dict[str, dict[str, Any]] = {}
    rows = []
    try:
        for line in _lines(cameras):
            number, model, width, height, *parameters = line.split() or [""] * 4
            if number and model not in MODELS:
                raise ValueError(f"camera {number} has the model {model}, expected one of {', '.join(MODELS)}")
            if number:
                places, lens = MODELS[model]
                values = [float(value) for value in parameters]
                fx, fy, cx, cy = (values[place] for place in places)
                K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
                distortion = (values[lens:] + [0.0] * 4)[:4]
                lenses[number] = {"width": int(width), "height": int(height), "K": K, "distortion": distortion}
        for line in filter(None, _lines(images)[::2]):  # Points follow each image, in a line that may be empty.
            _, *pose, number, name = line.split(maxsplit=9)
            quat, translation = [float(v) for v in pose[:4]], [float(v) for v in pose[4:]]
            rotation = Rotation.from_quat(quat, scalar_first=True).as_matrix().tolist()
            viewmat = [[*row, t] for row, t in zip(rotation, translation, strict=True)] + [[0, 0, 0, 1]]
            rows.append({"name": Path(name).stem, "viewmat": viewmat} | lenses[number])
    except InputError:
        raise
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise InputError(f"{cameras.parent}: expected a text model of COLMAP ({error})") from error
    return _checked(cameras, rows)


def _lines(path: Path) -> list[str]:
    with open_regular(path, most=LARGEST) as file:
        text = file.read().decode(errors="replace")
    return [line.strip() for line in text.splitlines() if not line.startswith("#")]


def _checked(path: Path, rows: list[dict[str, Any]]) -> dict[str, Camera]:
    """The cameras of rows, as the reader of our own format takes them."""
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "cameras.json"
        try:
            own.write_text(json.dumps(rows))
            return read_cameras(own)
        except InputError as error:
            raise InputError(str(error).replace(str(own), str(path))) from error
