"""The pictures of a report: every method beside the truth, frame by frame, and each method's worst frames.

Pictures of the page live in an `Album`, each once, compressed; the page decodes those that are looked at. What goes
into Markdown is a sheet: one PNG.
"""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Capture
from benchmarks.analysis.error_attribution import REGION_COLOURS, psnr_of, worst_frames
from benchmarks.analysis.results import RANKED_SPLITS
from benchmarks.analysis.style import SPLIT_NAMES, prominence, style_of
from benchmarks.cell import metrics
from benchmarks.cell.evaluation import spread
from benchmarks.cell.schema import Cell, CellResult, View, ViewScore, stored_prediction
from benchmarks.report.content import Strip
from benchmarks.suites.runs import Run

PAPER = 236  # grey behind the subject: dark hair and light cloth are both visible
MARGIN = 0.06
AT_MOST_ON_SHEETS = 5  # rows beside the truth
FLIP_WHITE = 0.7  # The error at which the error map's colours end.
TRACKS = ("novel_pose", "novel_view", "far_pose", "near_pose")  # splits in the order of the page
QUALITY = 88  # of WebP; what is scored are the stored PNGs.


@dataclass(frozen=True, kw_only=True, slots=True)
class Shown:
    """A cell whose pictures are shown, and what came out of it."""

    cell: Cell
    result: CellResult

    @property
    def title(self) -> str:
        """The method, for readers."""
        return style_of(self.cell.config.method).title


@dataclass(slots=True)
class Album:
    """Compressed pictures, as text that a page can hold."""

    pictures: list[str] = field(default_factory=list)
    size: int = 0  # bytes of all

    def add(self, pixels: np.ndarray) -> int:
        """Keep a picture, uint8 `[h, w, 3]`; returns its place."""
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, format="WEBP", quality=QUALITY, method=4)
        text = base64.b64encode(buffer.getvalue()).decode()
        self.size += len(text)
        self.pictures.append(text)
        return len(self.pictures) - 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Frame:
    """One picture with its caption: uint8 `[h, w, 3]`."""

    caption: str
    score: str
    pixels: np.ndarray


@dataclass(frozen=True, kw_only=True, slots=True)
class Frames:
    """A row of pictures of one size, and the row below it, which begins under the second."""

    title: str
    images: tuple[Frame, ...]
    errors: tuple[Frame, ...] = ()

    def strip(self, album: Album) -> Strip:
        """The row for the page."""
        tiles = tuple((frame.caption, frame.score, album.add(frame.pixels)) for frame in self.images)
        return Strip(title=self.title, tiles=tiles, width=self.images[0].pixels.shape[1])


def first_cells(run: Run, results: Sequence[CellResult]) -> list[dict[str, Shown]]:
    """The first cell by method that has one of the results, for each truth: a capture may have been rendered twice.

    Where some cells have pictures and others, from a published report, have none: those that have.
    """
    done = {result.config.key: result for result in results}
    finished = [cell for cell in run.cells if cell.config.key in done]
    cells: dict[tuple[str, int, str], dict[str, Shown]] = {}
    for cell in [cell for cell in finished if _has_pictures(cell)] or finished:
        config = cell.config
        by_method = cells.setdefault((config.place, config.subject, config.truth), {})
        by_method.setdefault(config.method, Shown(cell=cell, result=done[config.key]))
    return [*cells.values()]


def on_sheet(shown: Sequence[Shown]) -> list[Shown]:
    """Whose pictures are shown: a user's rows, which may have the names of ours, our main ones, then our others."""
    return sorted(shown, key=lambda each: prominence(each.cell.config.method))[:AT_MOST_ON_SHEETS]


def _has_pictures(cell: Cell) -> bool:
    """Whether what was drawn lies beside the numbers."""
    return (cell.folder / "images").is_dir()


def tracks(capture: Capture, shown: Sequence[Shown], album: Album, *, max_bytes: int) -> list[dict[str, Any]]:
    """Pictures of all methods on the first camera of each split, of as many frames as `max_bytes` bytes allow.

    A track is {"title", "frames", "width", "height", "truth": places in the album by frame, "pictures": the same by
    method, "psnr": dB by method}.
    """
    views = {split: [v for v in shown[0].result.views if v.split == split] for split in TRACKS}
    views = {split: views_of_split for split, views_of_split in views.items() if views_of_split}
    return [
        _track(capture, shown, album, split, views_of_split[0].camera, max_bytes=max_bytes // len(views))
        for split, views_of_split in views.items()
    ]


def choose_views(result: CellResult, split: str, count: int = 2) -> list[ViewScore]:
    """Views that say the most about a split: the typical one (median foreground PSNR), and another camera's worst."""
    views = sorted((view for view in result.views if view.split == split), key=psnr_of)
    if not views:
        return []
    chosen = [views[len(views) // 2]]
    others = sorted(views, key=lambda view: view.camera == chosen[0].camera)  # Stable: worst first within each half.
    return chosen + others[: count - 1] if len(views) > 1 else chosen


def comparisons(capture: Capture, shown: Sequence[Shown]) -> list[Frames]:
    """Two novel views and two novel poses, chosen by the first method's scores."""
    views = [view for split in RANKED_SPLITS for view in choose_views(shown[0].result, split)]
    return [compare(capture, shown, view) for view in views]


def worst(capture: Capture, shown: Shown, *, count: int) -> list[Frames]:
    """A method's worst novel poses: truth, prediction, FLIP error and regions."""
    frames = []
    for attribution in worst_frames(capture, shown.cell, shown.result, count=count):
        view, truth, prediction = attribution.view, attribution.truth, attribution.predicted
        crop = crop_of([truth, prediction])
        flip = view.scores["foreground", "flip"]
        images = (
            Frame(caption="Truth", score="", pixels=on_paper(truth[crop])),
            Frame(caption=shown.title, score=f"{psnr_of(view):.1f} dB", pixels=on_paper(prediction[crop])),
            Frame(caption="FLIP error", score=f"{flip:.3f}", pixels=_flip(prediction, truth, crop)),
            Frame(caption="Regions", score="", pixels=_paint(attribution.map[crop])),
        )
        where = f"{shown.title}, camera {view.camera}, frame {view.frame}"
        frames.append(Frames(title=f"{where}. {attribution.explanation}", images=images))
    return frames


def sheet(rows: Sequence[Frames], *, scale: int = 2, form: Literal["WEBP", "PNG"] = "WEBP") -> bytes:
    """All rows in one picture with captions, for Markdown and README; a PNG takes three times the bytes."""
    font = ImageFont.load_default(size=13)
    gap, caption = 10, 34
    lines = [(line, len(row.images) - len(line)) for row in rows for line in (row.images, row.errors) if line]
    columns = max(len(row.images) for row in rows)
    frames = [frame for line, _ in lines for frame in line]
    texts = [text for frame in frames for text in (frame.caption, frame.score)]
    pictures, words = (frame.pixels.shape[1] * scale for frame in frames), map(font.getlength, texts)
    wide = math.ceil(max(*pictures, *words)) + gap
    heights = [max(frame.pixels.shape[0] for frame in line) * scale + caption + gap for line, _ in lines]
    paper = Image.new("RGB", (columns * wide + gap, sum(heights) + gap), (255, 255, 255))
    pen, top = ImageDraw.Draw(paper), gap
    for (line, indent), height in zip(lines, heights, strict=True):  # Errors stand below their methods.
        for index, frame in enumerate(line):
            left, big = gap + (indent + index) * wide, Image.fromarray(frame.pixels)
            size = (big.width * scale, big.height * scale)
            paper.paste(big.resize(size, Image.Resampling.NEAREST), (left, top + caption))
            pen.text((left, top), frame.caption, fill=(20, 25, 35), font=font)
            pen.text((left, top + 16), frame.score, fill=(95, 105, 120), font=font)
        top += height
    buffer = io.BytesIO()
    paper.save(buffer, format=form, quality=90)
    return buffer.getvalue()


def on_paper(on_black: np.ndarray) -> np.ndarray:
    """A prediction or truth on black, uint8 RGBA, over the paper's grey: uint8 `[h, w, 3]`."""
    alpha = on_black[..., 3:].astype(float) / 255
    return np.clip(np.rint(on_black[..., :3] + PAPER * (1 - alpha)), 0, 255).astype(np.uint8)


def _track(
    capture: Capture, shown: Sequence[Shown], album: Album, split: str, camera: str, *, max_bytes: int
) -> dict[str, Any]:
    scores = [{v.frame: psnr_of(v) for v in s.result.views if (v.split, v.camera) == (split, camera)} for s in shown]
    frames = sorted(scores[0])
    truths = {frame: metrics.on_black(capture.image(camera, frame)) for frame in frames}
    crop = crop_of(list(truths.values()))
    keys: dict[int, list[int]] = {}

    def add(frame: int) -> None:
        view = View(split=split, camera=camera, frame=frame)
        images = [truths[frame], *(stored_prediction(s.cell, capture, view) for s in shown)]
        keys[frame] = [album.add(on_paper(image[crop])) for image in images]

    before = album.size
    add(frames[0])
    fit = max(1, max_bytes // max(1, album.size - before))
    for index in spread(len(frames), min(len(frames), fit)):
        if frames[index] not in keys:
            add(frames[index])
    chosen, shape = sorted(keys), truths[frames[0]][crop].shape
    return {
        "title": f"{SPLIT_NAMES[split].words.capitalize()}, camera {camera}",
        "frames": chosen,
        "width": shape[1],
        "height": shape[0],
        "truth": [keys[frame][0] for frame in chosen],
        "pictures": [[keys[frame][1 + i] for frame in chosen] for i in range(len(shown))],
        "psnr": [[round(score[frame], 3) for frame in chosen] for score in scores],
    }


def compare(capture: Capture, shown: Sequence[Shown], view: ViewScore, *, with_errors: bool = True) -> Frames:
    """The comparison of several methods on one view, cropped to the subject, with FLIP errors below."""
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    predictions = [stored_prediction(s.cell, capture, view) for s in shown]
    crop = crop_of([truth, *predictions])
    ceiling = view.scores.get(("foreground", "noise_ceiling"))
    noise = "" if ceiling is None else f"noise ceiling {ceiling:.1f} dB"
    images, errors = [Frame(caption="Truth", score=noise, pixels=on_paper(truth[crop]))], []
    for each, prediction in zip(shown, predictions, strict=True):
        scored = score_of(each, view)
        images.append(Frame(caption=each.title, score=f"{psnr_of(scored):.1f} dB", pixels=on_paper(prediction[crop])))
        if with_errors:
            flip = scored.scores["foreground", "flip"]
            errors.append(Frame(caption="FLIP error", score=f"{flip:.3f}", pixels=_flip(prediction, truth, crop)))
    return Frames(
        title=title_of(view),
        images=tuple(images),
        errors=tuple(errors),
    )


def title_of(view: ViewScore) -> str:
    """Split, camera and frame, for readers."""
    return f"{SPLIT_NAMES[view.split].words}, camera {view.camera}, frame {view.frame}"


def score_of(shown: Shown, view: ViewScore) -> ViewScore:
    """The scores of a method on the view of another's."""
    return next(v for v in shown.result.views if (v.split, v.camera, v.frame) == (view.split, view.camera, view.frame))


def crop_of(images: Sequence[np.ndarray]) -> tuple[slice, slice]:
    """The rows and columns that any image covers, with a margin."""
    covered = np.any([image[..., 3] > 8 for image in images], axis=0)
    extent = max(covered.any(axis).sum() for axis in (0, 1))
    return metrics.occupied(covered, max(3, round(MARGIN * extent))) or (slice(None), slice(None))


def _flip(prediction: np.ndarray, truth: np.ndarray, crop: tuple[slice, slice]) -> np.ndarray:
    """FLIP error as colours from black (none) over purple and orange to light yellow (FLIP_WHITE and more)."""
    from matplotlib import colormaps

    error = metrics.flip_map(prediction[..., :3], truth[..., :3])[crop]
    colours = colormaps["magma"](np.clip(error / FLIP_WHITE, 0, 1))[..., :3]
    return np.rint(np.asarray(colours) * 255).astype(np.uint8)


def _paint(regions: np.ndarray) -> np.ndarray:
    """Regions `[h, w]` in their colours, background as paper."""
    colours = np.array([*(tuple(bytes.fromhex(colour[1:])) for colour in REGION_COLOURS), (PAPER,) * 3], np.uint8)
    return colours[regions]
