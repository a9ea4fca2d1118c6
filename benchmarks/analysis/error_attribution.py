"""Error attribution: which truth channel explains the squared error of a prediction.

Every pixel that truth or prediction covers belongs to exactly one region, the first that applies: silhouette, occlusion
edge, surface that no training view shows, surface at a grazing angle, the rest. A region explains a frame if it
holds the largest share of the squared error among those where errors are denser than on average.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from ash.capture.dataset import Capture, pixels_path
from ash.capture.formats import load_capture
from ash.capture.novelty import novelty_deg
from ash.files import read_arrays
from benchmarks.cell import metrics
from benchmarks.cell.schema import Cell, CellResult, ViewScore, stored_prediction
from synth.truth.pixels import depth, normals, pixel_truth, points, surface_truth

REGION_COLOURS = ("#2f6fde", "#dd6b20", "#c2415c", "#b8860b", "#c9ced6")
REGIONS = ("silhouette", "occlusion edge", "not visible in training", "grazing view", "interior")
EDGE_PX = 2  # half of an edge's width
STEP_M = 0.04  # a jump in depth that is an edge
GRAZING_COSINE = 0.35
DENSER = 1.2  # error share over pixel share from which on a region may explain a frame
NOVEL_QUARTILE = 0.75
VISIBILITY_FRAMES = 10  # training frames; a triangle hidden in all of them counts as not visible


@dataclass(frozen=True, kw_only=True, slots=True)
class ErrorAttribution:
    """A bad frame and its regions."""

    view: ViewScore
    explanation: str  # one line for a reader
    map: np.ndarray  # [h, w] index into REGIONS, -1: background
    truth: np.ndarray  # [h, w, 4] uint8 on black
    predicted: np.ndarray  # [h, w, 4] uint8 on black


def worst_frames(
    capture: Capture, cell: Cell, result: CellResult, *, split: str = "novel_pose", count: int = 3
) -> tuple[ErrorAttribution, ...]:
    """The causes of a method's worst frames by foreground PSNR, each from another frame; none without pixel truth."""
    if not (capture.folder / "truth" / "surface.npz").exists():
        return ()
    views = sorted((v for v in result.views if v.split == split), key=psnr_of)
    views = [view for view in views if pixels_path(capture.folder, view.camera, view.frame).exists()]
    worst_of_frame: dict[int, ViewScore] = {}
    for view in views:
        worst_of_frame.setdefault(view.frame, view)
    frames = sorted(worst_of_frame)
    if not frames:
        return ()
    visible = _visible_triangles(capture.folder, capture.identity)
    degrees = np.array(novelty_deg(capture.motion, train=capture.splits["train"].frames, test=frames))
    worst = []
    for view in list(worst_of_frame.values())[:count]:
        truth = metrics.on_black(capture.image(view.camera, view.frame))
        predicted = stored_prediction(cell, capture, view)
        masks = metrics.foreground(truth), metrics.foreground(predicted)
        regions = region_map(capture, view.camera, view.frame, *masks, visible)
        error = ((truth[..., :3].astype(float) - predicted[..., :3]) ** 2).sum(-1)
        novelty = degrees[frames.index(view.frame)]
        text = explanation(regions, error, novelty, (degrees < novelty).sum() / max(1, len(frames) - 1))
        worst.append(ErrorAttribution(view=view, explanation=text, map=regions, truth=truth, predicted=predicted))
    return tuple(worst)


def explanation(regions: np.ndarray, error: np.ndarray, novelty_deg: float, rank: float) -> str:
    """The region that explains a frame, by the map of regions and the squared error, `[h, w]`.

    `novelty_deg`: distance of the pose to the nearest training pose, mean over joints; `rank`: 0 for the most ordinary
    pose of the split, 1 for the most novel.
    """
    inside = regions >= 0
    pixels, errors = (
        np.bincount(regions[inside], weights=weights, minlength=len(REGIONS)) for weights in (None, error[inside])
    )
    pixels, errors = pixels / max(1, pixels.sum()), errors / max(1e-12, errors.sum())
    candidates = errors > DENSER * pixels
    candidates[REGIONS.index("interior")] = True
    main = int(np.argmax(np.where(candidates, errors, -1.0)))
    text = (
        f"{REGIONS[main]}: {100 * errors[main]:.0f} % of the squared error on {100 * pixels[main]:.0f} % of the pixels"
    )
    text += f"; pose {novelty_deg:.0f} degrees from the nearest training pose"
    return text + (", among the most novel quarter" if rank >= NOVEL_QUARTILE else "")


def region_map(
    capture: Capture, camera: str, frame: int, truth: np.ndarray, predicted: np.ndarray, visible: np.ndarray
) -> np.ndarray:
    """Region of every pixel `[h, w]` from both masks `[h, w]`; `visible` `[f]`: triangles that training shows."""
    pixels = pixel_truth(capture, camera, frame)
    around = np.ones((2 * EDGE_PX + 1,) * 2, bool)
    band = binary_dilation(truth, around) & ~binary_erosion(truth, around)
    hit = pixels.covered
    to_eye = capture.cameras[camera].position - points(capture, pixels)
    to_eye /= np.maximum(np.linalg.norm(to_eye, axis=-1, keepdims=True), 1e-12)
    cosine = (normals(capture, pixels) * to_eye).sum(-1)
    conditions = (
        band | (truth != predicted),
        hit & binary_dilation(_depth_steps(depth(capture, pixels), hit), around),
        hit & ~visible[np.maximum(pixels.triangle, 0)],
        hit & (cosine < GRAZING_COSINE),
    )
    regions = np.select(conditions, range(len(conditions)), default=len(conditions))
    return np.where(truth | predicted, regions, -1)


def _depth_steps(far: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Where depth `[h, w]` bends by more than a step from a pixel to the next: slanted surfaces do not, edges do."""
    steps = np.zeros(far.shape, bool)
    for axis in (0, 1):
        bends = np.abs(np.diff(far, 2, axis=axis)) > STEP_M
        inner = binary_erosion(hit, np.ones((3, 1) if axis == 0 else (1, 3), bool))
        middle = (slice(1, -1), slice(None)) if axis == 0 else (slice(None), slice(1, -1))
        steps[middle] |= bends & inner[middle]
    return steps


def psnr_of(view: ViewScore) -> float:
    """An image's foreground PSNR in dB."""
    return view.scores["foreground", "psnr"]


@lru_cache(maxsize=1)
def _visible_triangles(folder: Path, identity: str) -> np.ndarray:
    """Which triangles `[f]` any training view shows, in frames spread over the training motion, and their neighbours.

    Triangles may be smaller than pixels: between two that are hit lies one that is not, and counts as visible too. This
    takes seconds, and is the same for every method; `identity` tells captures in one place apart.
    """
    capture = load_capture(folder)
    faces = surface_truth(capture).faces
    visible = np.zeros(len(faces), bool)
    train = capture.splits["train"]
    # As many images whether all cameras saw a frame or a part of them: their frames lie the closer together.
    for camera, frame in train.views[:: max(1, train.count // (VISIBILITY_FRAMES * len(train.cameras)))]:
        triangle = read_arrays(pixels_path(capture.folder, camera, frame), expected=("triangle",))["triangle"]
        visible[triangle[triangle >= 0]] = True
    corners = np.zeros(faces.max() + 1, bool)
    corners[faces[visible]] = True
    return corners[faces].any(axis=1)
