"""Side-by-side pictures: truth, the methods, and where they are wrong."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ash.dataset import Capture
from ash.files import InputError
from benchmarks import metrics
from benchmarks.causes import REGION_COLOURS, worst_frames
from benchmarks.cells import Cell, CellResult, ViewScore
from benchmarks.names import look_of
from benchmarks.run import stored_prediction
from benchmarks.views import View

PAPER = 236  # Grey behind the subject: dark hair and light cloth both stand out on it.
MARGIN = 0.06
FLIP_WHITE = 0.7  # The error at which the error map's colours end.


@dataclass(frozen=True, kw_only=True, slots=True)
class Tile:
    """One picture: uint8 `[h, w, 3]`."""

    caption: str
    score: str
    pixels: np.ndarray

    @property
    def uri(self) -> str:
        """The picture as a data URI, so that a page needs no other file."""
        return "data:image/png;base64," + base64.b64encode(png(self.pixels)).decode()


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    """One held-out view: truth and methods above, their FLIP error below the methods."""

    title: str
    images: tuple[Tile, ...]
    errors: tuple[Tile, ...]

    @property
    def width(self) -> int:
        """Pixels of a tile."""
        return int(self.images[0].pixels.shape[1])


def choose_views(result: CellResult, split: str, count: int = 2) -> list[ViewScore]:
    """Views that say the most about a split: the typical one (median foreground PSNR), and another camera's worst."""
    views = sorted((view for view in result.views if view.split == split), key=lambda v: v.scores["foreground", "psnr"])
    if not views:
        return []
    chosen = [views[len(views) // 2]]
    others = sorted(views, key=lambda view: view.camera == chosen[0].camera)  # Stable: worst first within each half.
    return chosen + others[: count - 1] if len(views) > 1 else chosen


def compare(capture: Capture, cells: Sequence[Cell], results: Sequence[CellResult], view: ViewScore) -> Comparison:
    """The comparison of several methods on one view, cropped to the subject."""
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    predictions = [
        stored_prediction(cell, capture, View(split=view.split, camera=view.camera, frame=view.frame)) for cell in cells
    ]
    crop = _crop([truth, *predictions])
    ceiling = view.scores.get(("foreground", "noise_ceiling"))
    noise = "" if ceiling is None else f"noise ceiling {ceiling:.1f} dB"
    images = [Tile(caption="Truth", score=noise, pixels=on_paper(truth[crop]))]
    errors = []
    for cell, result, prediction in zip(cells, results, predictions, strict=True):
        scores = next(
            v.scores for v in result.views if (v.split, v.camera, v.frame) == (view.split, view.camera, view.frame)
        )
        title = look_of(cell.config.method).title
        psnr, flip = scores["foreground", "psnr"], scores["foreground", "flip"]
        images.append(Tile(caption=title, score=f"{psnr:.1f} dB", pixels=on_paper(prediction[crop])))
        error = metrics.flip_map(prediction[..., :3], truth[..., :3])[crop]
        errors.append(Tile(caption="FLIP error", score=f"{flip:.3f}", pixels=_heat(error)))
    split = {"novel_view": "Held-out view", "novel_pose": "Held-out motion"}.get(view.split, view.split)
    return Comparison(
        title=f"{split}: camera {view.camera}, frame {view.frame}", images=tuple(images), errors=tuple(errors)
    )


def contact_sheet(comparisons: Sequence[Comparison], *, scale: int = 2) -> np.ndarray:
    """All comparisons in one picture with captions, for Markdown and README: uint8 `[h, w, 3]`."""
    font = ImageFont.load_default(size=13)
    gap, caption = 10, 34
    rows = [row for c in comparisons for row in (c.images, c.errors) if row]
    columns = max(len(c.images) for c in comparisons)
    cell_width = max(max(tile.pixels.shape[1] for tile in row) for row in rows) * scale + gap
    heights = [max(tile.pixels.shape[0] for tile in row) * scale + caption + gap for row in rows]
    sheet = Image.new("RGB", (columns * cell_width + gap, sum(heights) + gap), (255, 255, 255))
    pen, top = ImageDraw.Draw(sheet), gap
    for row, height in zip(rows, heights, strict=True):
        first = (
            columns - len(row) if len(row) < columns else 0
        )  # Errors stand below their methods, not below the truth.
        for index, tile in enumerate(row):
            left = gap + (first + index) * cell_width
            big = Image.fromarray(tile.pixels)
            sheet.paste(
                big.resize((big.width * scale, big.height * scale), Image.Resampling.NEAREST), (left, top + caption)
            )
            pen.text((left, top), tile.caption, fill=(20, 25, 35), font=font)
            pen.text((left, top + 16), tile.score, fill=(95, 105, 120), font=font)
        top += height
    return np.asarray(sheet)


def png(pixels: np.ndarray) -> bytes:
    """A picture as PNG bytes."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def comparisons_of(capture: Capture, cells: Sequence[Cell], results: Sequence[CellResult]) -> list[Comparison]:
    """Two held-out views and two held-out poses, chosen by the first method's scores."""
    if not cells:
        return []
    views = [view for split in ("novel_view", "novel_pose") for view in choose_views(results[0], split)]
    return [compare(capture, cells, results, view) for view in views]


def gallery(capture: Capture, cell: Cell, result: CellResult) -> list[Comparison]:
    """A method's worst frames of the held-out motion: truth, prediction, FLIP error, and what explains it."""
    found = []
    for cause in worst_frames(capture, cell, result):
        view, truth, prediction = cause.view, cause.truth, cause.predicted
        crop = _crop([truth, prediction])
        error = metrics.flip_map(prediction[..., :3], truth[..., :3])[crop]
        title = look_of(cell.config.method).title
        images = (
            Tile(caption="Truth", score="", pixels=on_paper(truth[crop])),
            Tile(caption=title, score=f"{view.scores['foreground', 'psnr']:.1f} dB", pixels=on_paper(prediction[crop])),
            Tile(caption="FLIP error", score=f"{view.scores['foreground', 'flip']:.3f}", pixels=_heat(error)),
            Tile(caption="Regions", score="", pixels=_paint(cause.map[crop])),
        )
        where = f"{title}, camera {view.camera}, frame {view.frame}"
        found.append(Comparison(title=f"{where}. {cause.explanation}", images=images, errors=()))
    return found


def missing_pictures(folder: Path, error: InputError) -> str:
    """What to say where the capture or a prediction is gone: numbers do not depend on it, so the report goes on."""
    return f"No pictures: {error}. The numbers come from {folder} and do not need it."


def _crop(images: Sequence[np.ndarray]) -> tuple[slice, slice]:
    """The rows and columns that any image covers, with a margin."""
    covered = np.any([image[..., 3] > 8 for image in images], axis=0)
    extent = max(covered.any(axis).sum() for axis in (0, 1))
    return metrics.occupied(covered, max(3, round(MARGIN * extent))) or (slice(None), slice(None))


def on_paper(on_black: np.ndarray) -> np.ndarray:
    """A prediction or truth on black, uint8 RGBA, over the paper's grey: uint8 `[h, w, 3]`."""
    alpha = on_black[..., 3:].astype(float) / 255
    return np.clip(np.rint(on_black[..., :3] + PAPER * (1 - alpha)), 0, 255).astype(np.uint8)


def _heat(error: np.ndarray) -> np.ndarray:
    """FLIP error as colours from black (none) over purple and orange to light yellow (FLIP_WHITE and more)."""
    from matplotlib import colormaps

    colours = colormaps["magma"](np.clip(error / FLIP_WHITE, 0, 1))[..., :3]
    return np.rint(np.asarray(colours) * 255).astype(np.uint8)


def _paint(regions: np.ndarray) -> np.ndarray:
    """Regions `[h, w]` in their colours, background as paper."""
    colours = np.array([*(tuple(bytes.fromhex(colour[1:])) for colour in REGION_COLOURS), (PAPER,) * 3], np.uint8)
    return colours[regions]
