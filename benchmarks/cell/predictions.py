"""Pictures that somebody brings, rendered elsewhere: checked as hostile input, stored in a cell, scored like any other.

    DIR/images/SPLIT/CAM/FRAME.png   a picture of each scored view, of the camera's size; nothing else below images/
    DIR/info.json                    `schema.Brought`, each key optional; may be absent

Pictures are RGBA, straight or premultiplied as info.json says, or RGB on black. What the method saw is not known.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from PIL import Image

from ash.capture.dataset import Camera, Capture
from ash.capture.typed import from_json
from ash.files import LIMITS, InputError, hash_of, hash_sources, open_regular, read_image, read_json, write_image
from benchmarks.cell import metrics
from benchmarks.cell.evaluation import evaluated_views, quality_summary, scored_views
from benchmarks.cell.schema import Brought, Cell, CellResult, Summary, prediction_path
from benchmarks.problems import Problems

LARGEST_INFO = 1 << 16  # bytes
LARGEST_NUMBER, LONGEST_TEXT = 1e12, 200  # of info.json
MOST_FILES = 1000  # below images/ besides those that are expected; more are not listed


@dataclass(frozen=True, kw_only=True, slots=True)
class Predictions:
    """A checked folder: a picture of every scored view. `digest`: SHA-256 of pixels, information and scoring code."""

    folder: Path
    brought: Brought
    digest: str


def open_predictions(folder: Path, capture: Capture, *, info: Path | None = None) -> Predictions:
    """Read and check every picture of a folder; `info`: a file in place of the folder's info.json.

    Raises:
        InputError: info.json is wrong.
        Problems: a picture is missing, too much, of another size, or damaged.
    """
    brought = read_info(info or folder / "info.json", may_be_absent=info is None)
    views = evaluated_views(capture)
    names = {prediction_path(Path(), view).as_posix(): view for view in views}
    there = _files(folder, most=len(names) + MOST_FILES)
    lines = [f"{folder / name}: missing" for name in names if name not in there]
    lines += [f"{folder / name}: {there[name] or 'not expected'}" for name in there if there[name] or name not in names]
    digest, bands = sha256(), set()
    for name, view in names.items():
        if there.get(name) == "":
            try:
                pixels = _read_picture(folder / name, capture.cameras[view.camera])
                _require_intact(folder / name)
            except InputError as error:
                lines.append(str(error))
                continue
            bands.add(pixels.shape[2])
            digest.update(f"{name} {pixels.shape}\n".encode() + pixels.tobytes())
    if len(bands) > 1:
        lines.append(f"{folder}: some pictures have alpha and some have none, expected all or none")
    if lines:
        raise Problems(lines)
    if bands == {3}:
        brought = replace(brought, alpha="none")
    code = hash_of([digest.hexdigest(), repr(brought), hash_sources(Path(__file__).parent)])[:16]
    return Predictions(folder=folder, brought=brought, digest=code)


def read_info(path: Path, *, may_be_absent: bool = False) -> Brought:
    """What the authors of pictures say about them.

    Raises:
        InputError: an unknown key, a number that is negative or too large, or a text that is too long.
    """
    if may_be_absent and not os.path.lexists(path):
        return Brought()
    if may_be_absent and path.is_symlink():  # Beside the pictures, and so not to be trusted.
        raise InputError(f"{path}: expected a regular file")
    content = read_json(path, most=LARGEST_INFO)
    try:
        brought: Brought = from_json(Brought, content)
        for name in Brought.__dataclass_fields__:
            value = getattr(brought, name)
            if isinstance(value, int | float) and not 0 <= value <= LARGEST_NUMBER:
                raise ValueError(f"{name}: expected 0 to {LARGEST_NUMBER:g}, got {value:g}")
            if isinstance(value, str) and (len(value) > LONGEST_TEXT or not value.isprintable()):
                raise ValueError(f"{name}: expected at most {LONGEST_TEXT} printable characters")
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return brought


def score_predictions(cell: Cell, capture: Capture, predictions: Predictions) -> CellResult:
    """Store checked pictures in the cell, colour on black, and score them; the result is not written yet.

    Raises:
        InputError: a picture was damaged since it was checked.
    """
    views = evaluated_views(capture)
    for view in views:
        pixels = _read_picture(prediction_path(predictions.folder, view), capture.cameras[view.camera])
        write_image(prediction_path(cell.folder, view), _on_black(pixels, predictions.brought))
    scored = scored_views(cell, capture, views, alpha=predictions.brought.alpha != "none")
    done = Summary(split="speed", region="", metric="failed", value=0.0)  # No other cost: none was measured.
    return CellResult(
        config=cell.config,
        status="done",
        summary=(*quality_summary(cell, capture, scored), done),
        views=tuple(scored),
        brought=predictions.brought,
    )


def _on_black(pixels: np.ndarray, brought: Brought) -> np.ndarray:
    if brought.alpha == "none":
        return np.concatenate([pixels[..., :3], np.full_like(pixels[..., :1], 255)], axis=-1)
    return metrics.on_black(pixels) if brought.alpha == "straight" else pixels


def _read_picture(path: Path, camera: Camera) -> np.ndarray:
    """uint8 RGBA or RGB of the camera's size, as the file has it."""
    try:
        return read_image(path, shape=(camera.height, camera.width, 4))
    except InputError as error:
        try:
            return read_image(path, shape=(camera.height, camera.width, 3))
        except InputError:
            raise error from None


def _require_intact(path: Path) -> None:
    """Refuse a PNG with a wrong check sum or without its end: pixels may be read from one, other than were written."""
    try:
        with open_regular(path, most=16 * LIMITS["image pixels"]) as file, Image.open(file, formats=["PNG"]) as image:
            image.verify()
    except InputError:
        raise
    except Exception as error:  # Pillow meets damage with a dozen kinds of errors.
        raise InputError(f"{path}: damaged ({error})") from error


def _files(folder: Path, *, most: int) -> dict[str, str]:
    """What lies below images/, by its path from the folder: empty text for a regular file, else what is wrong.

    Links are not followed, so that nothing outside the folder is read.
    """
    if not folder.is_dir() or (folder / "images").is_symlink() or not (folder / "images").is_dir():
        raise InputError(f"{folder}: expected a folder that holds the folder images, as README.md of test-views says")
    files: dict[str, str] = {}
    for entry in _walk(folder / "images"):
        if len(files) == most:
            raise InputError(f"{folder}: more than {most} files below images/")
        regular = entry.is_file(follow_symlinks=False)
        files[Path(entry.path).relative_to(folder).as_posix()] = "" if regular else "expected a regular file"
    return files


def _walk(folder: Path, depth: int = 0) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder that is no folder, and folders deeper than pictures lie."""
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            if entry.is_dir(follow_symlinks=False) and depth < 2:
                yield from _walk(Path(entry.path), depth + 1)
            else:
                yield entry
