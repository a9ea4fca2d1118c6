"""Error attribution: which truth channel explains the squared error of a prediction.

Every pixel that truth or prediction covers belongs to exactly one region, the first that applies: silhouette, occlusion
edge, surface that no training view shows, surface at a grazing angle, the rest. A region explains a frame if it
holds the largest share of the squared error among those where errors are denser than on average.
"""

from collections.abc import Sequence
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
class Share:
    """A region's share of the pixels and of the squared error, 0..1."""

    region: str
    pixels: float
    error: float


@dataclass(frozen=True, kw_only=True, slots=True)
class ErrorAttribution:
    """A bad frame: its regions, the pose's distance to the nearest training pose, and where that ranks in its split."""

    view: ViewScore
    shares: tuple[Share, ...]
    novelty_deg: float  # mean over joints
    novelty_rank: float  # 0: the most ordinary pose of the split, 1: the most novel
    map: np.ndarray  # [h, w] index into REGIONS, -1: background
    truth: np.ndarray  # [h, w, 4] uint8 on black
    predicted: np.ndarray  # [h, w, 4] uint8 on black

    @property
    def explanation(self) -> str:
        """One line for a reader."""
        dense = [s for s in self.shares if s.pixels > 0 and s.error / s.pixels > DENSER and s.region != "interior"]
        inside = next(s for s in self.shares if s.region == "interior")
        main = max(dense, key=lambda s: s.error, default=inside)
        if inside.error > main.error:
            main = inside
        text = (
            f"{main.region}: {100 * main.error:.0f} % of the squared error on {100 * main.pixels:.0f} % of the pixels"
        )
        novel = f"; pose {self.novelty_deg:.0f} degrees from the nearest training pose"
        return text + novel + (", among the most novel quarter" if self.novelty_rank >= NOVEL_QUARTILE else "")


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
    chosen = list(worst_of_frame.values())[:count]
    if not chosen:
        return ()
    visible_triangles = _visible_triangles(capture.folder, capture.identity)
    train = capture.splits["train"].frames
    frames = sorted({view.frame for view in views})
    novelty = dict(zip(frames, novelty_deg(capture.motion, train=train, test=frames), strict=True))
    ranks = {frame: _rank(list(novelty.values()), novelty[frame]) for frame in frames}
    return tuple(
        _attribution(
            capture, cell, view, visible_triangles, novelty_deg=novelty[view.frame], novelty_rank=ranks[view.frame]
        )
        for view in chosen
    )


def _attribution(
    capture: Capture,
    cell: Cell,
    view: ViewScore,
    visible_triangles: np.ndarray,
    *,
    novelty_deg: float,
    novelty_rank: float,
) -> ErrorAttribution:
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    predicted = stored_prediction(cell, capture, view)
    masks = metrics.foreground(truth), metrics.foreground(predicted)
    regions = region_map(capture, view.camera, view.frame, *masks, visible_triangles)
    error = ((truth[..., :3].astype(float) - predicted[..., :3]) ** 2).sum(-1)
    return ErrorAttribution(
        view=view,
        shares=shares(regions, error),
        novelty_deg=novelty_deg,
        novelty_rank=novelty_rank,
        map=regions,
        truth=truth,
        predicted=predicted,
    )


def shares(regions: np.ndarray, error: np.ndarray) -> tuple[Share, ...]:
    """What each region holds of the pixels and of the error, both `[h, w]`, in the order of `REGIONS`."""
    inside = regions >= 0
    pixels, total = max(1, int(inside.sum())), max(float(error[inside].sum()), 1e-12)
    return tuple(
        Share(region=name, pixels=(regions == index).sum() / pixels, error=float(error[regions == index].sum()) / total)
        for index, name in enumerate(REGIONS)
    )


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


def _rank(values: Sequence[float], value: float) -> float:
    return sum(other < value for other in values) / max(1, len(values) - 1)
