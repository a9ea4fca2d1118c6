"""A trained method on held-out views and motion: drawn, stored, scored, its cost measured."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Capture, pixels_path, surface_path
from ash.capture.formats import read_surface_mesh_truth, read_template_truth
from ash.capture.novelty import novelty_deg
from ash.files import open_regular, read_arrays, write_image
from ash.protocol import TrainingOutcome
from benchmarks.cell import metrics
from benchmarks.cell.metrics import IMAGE_SPLITS, LPIPS_SCORES, NOVELTY, VIEW_SCORES, weights_file
from benchmarks.cell.sandbox import TEST_VIEWS, WORK
from benchmarks.cell.schema import (
    Cell,
    CellResult,
    CurvePoint,
    MethodFailed,
    Snapshot,
    Summary,
    Timing,
    TrainingTime,
    View,
    ViewScore,
    prediction_path,
    stored_prediction,
)
from benchmarks.cell.worker import MethodClient, MethodInfo, Timed, frame_times_ms

TRAIN_VIEWS = 12
VIEW_FRAMES = 12
POSE_FRAMES = {"near_pose": 24, "novel_pose": 700, "far_pose": 24}
WARM_UP_FRAMES = 3
TIMED_FRAMES = 15
GEOMETRY_FRAMES = 4
MOST_SNAPSHOTS = 100
LEAST_AGREEMENT_DB = 20.0  # Of a timed picture with the scored one: a display may sample outlines otherwise.
GEOMETRY_POINTS = 4096  # Gaussians whose distance to the surface is measured, evenly taken; the mean wants no more.

MAX_POINTS = 200
SETTLED_DB = 0.3

LARGEST_LOG, LONGEST_LINE, MOST_LINES = 1 << 28, 1 << 16, 1_000_000
LARGEST_VALUE = 1e12


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedFrames:
    """What an avatar says about its geometry: per frame, template vertices and centres of Gaussians, metres."""

    vertices: dict[int, np.ndarray]
    means: dict[int, np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodOutputs:
    """What a trained method left besides its stored pictures, when its process ended."""

    views: tuple[View, ...]
    timing: Timing
    geometry: PosedFrames | None
    described: MethodInfo
    peak_mb: float
    snapshots: tuple[Snapshot, ...]
    isolated: bool
    prepared: TrainingTime  # since the avatar was made, before the first picture


def draw_all(cell: Cell, capture: Capture, client: MethodClient) -> MethodOutputs:
    """Let the method draw every view that is scored, and measure it; nothing is compared with truth yet.

    Frames are timed first, when none of them was ever drawn: a method that keeps its pictures gains nothing.
    """
    views = evaluated_views(capture)
    client.load_test_views(cell.folder.resolve() / TEST_VIEWS, capture)
    described, prepared = client.describe(), client.spent()
    timing, shown = _timing(capture, client, playback(views))
    for view in views:
        write_image(
            prediction_path(cell.folder, view), metrics.quantise(client.draw(view, capture.cameras[view.camera]))
        )
    agreement_db = min(agreement(image, stored_prediction(cell, capture, view)) for view, image in shown)
    if agreement_db < LEAST_AGREEMENT_DB:
        measured = f"{agreement_db:.1f} dB, expected {LEAST_AGREEMENT_DB:.0f} or more"
        raise MethodFailed("crashed", f"a timed picture differs from the one that was scored by {measured}")
    return MethodOutputs(
        views=views,
        timing=replace(timing, agreement_db=agreement_db),
        geometry=_pose_geometry(client, described, views),
        described=described,
        peak_mb=client.peak_memory_mb(),
        snapshots=_snapshots(cell, capture, client, views),
        isolated=client.isolated,
        prepared=prepared,
    )


def time_frames(cell: Cell, capture: Capture, client: MethodClient) -> Timing:
    """The times alone that `draw_all` measures."""
    client.load_test_views(cell.folder.resolve() / TEST_VIEWS, capture)
    return _timing(capture, client, playback(evaluated_views(capture)))[0]


def score_outputs(
    cell: Cell, capture: Capture, drawn: MethodOutputs, spent: TrainingTime, training: TrainingOutcome | None = None
) -> CellResult:
    """Score the stored pictures, when the method's process is gone.

    `training`: how training ended, where the avatar was loaded and does not know.
    """
    training = drawn.described.training or training
    scored = scored_views(cell, capture, drawn.views)
    curve = read_curve(cell.folder / "log.jsonl")
    summary = (
        quality_summary(cell, capture, scored)
        + _geometry_summary(capture, drawn.geometry, drawn.views)
        + _cost_summary(drawn, spent, logged_s=max((point.seconds for point in curve), default=0.0))
        + _training_summary(training, curve)
    )
    return CellResult(
        config=cell.config,
        status="done",
        summary=summary,
        views=tuple(scored),
        timing=drawn.timing,
        curve=curve,
        training=training,
        snapshots=drawn.snapshots,
        drawn_on=cell.config.device,
        isolated=drawn.isolated,
    )


def _snapshots(cell: Cell, capture: Capture, client: MethodClient, views: tuple[View, ...]) -> tuple[Snapshot, ...]:
    """What the avatar would have scored had training ended earlier, of a method that left its weights of then."""
    snapshots = []
    for path in sorted((cell.folder / WORK / "snapshots").glob("*.safetensors"))[:MOST_SNAPSHOTS]:
        if not path.stem.isdecimal() or len(path.stem) > 9:
            continue
        client.load(f"snapshots/{path.name}")
        drawn = [metrics.quantise(client.draw(view, capture.cameras[view.camera])) for view in views]
        for split in IMAGE_SPLITS:
            scores = [_psnr(capture, v, image) for v, image in zip(views, drawn, strict=True) if v.split == split]
            if scores:
                snapshots.append(Snapshot(seconds=float(path.stem), split=split, psnr=float(np.mean(scores))))
    return tuple(snapshots)


def _psnr(capture: Capture, view: View, prediction: np.ndarray) -> float:
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    mask = metrics.foreground(truth)
    return metrics.psnr(prediction[..., :3], truth[..., :3], mask if mask.any() else None)


def _timing(capture: Capture, client: MethodClient, views: list[View]) -> tuple[Timing, list[tuple[View, np.ndarray]]]:
    """The method's own milliseconds, which ours outside must bear out, and the pictures that were timed.

    No picture is timed that was asked for before; where a capture has fewer views than are wanted, fewer are timed.
    """
    drawn_by = client.open_display()
    frames: list[Timed] = []
    references, pictures = [], []
    asked: set[tuple[str, int]] = set()
    for view in [*views[-WARM_UP_FRAMES:], *views]:
        before = replace(view, frame=max(0, view.frame - 1))  # As in playback: the history of a frame is known.
        if (view.camera, view.frame) in asked:
            continue
        asked |= {(view.camera, view.frame), (view.camera, before.frame)}
        if before != view:
            client.time(before)
        frames.append(client.time(view))
        pictures.append((view, metrics.quantise(client.draw(view, capture.cameras[view.camera], "shown"))))
        references.append(reference_workload_ms())
        if len(frames) == WARM_UP_FRAMES + TIMED_FRAMES:
            break
    warm_up = min(WARM_UP_FRAMES, len(frames) - 1)
    timed = frames[warm_up:]
    stages: dict[str, tuple[float, ...]] = {
        name: tuple(frame.stage_ms[name] for frame in timed if name in frame.stage_ms)
        for name in sorted({name for frame in timed for name in frame.stage_ms})
    }
    timing = Timing(
        frame_ms=frame_times_ms(timed),
        stage_ms=stages,
        reference_ms=tuple(references[warm_up:]),
        drawn_by=drawn_by,
    )
    return timing, pictures


def agreement(shown: np.ndarray, scored: np.ndarray) -> float:
    """PSNR, dB, between two pictures of the same view, uint8 RGBA on black, where either shows something."""
    region = metrics.foreground(shown) | metrics.foreground(scored)
    return metrics.psnr(shown[..., :3], scored[..., :3], region if region.any() else None)


def scored_views(cell: Cell, capture: Capture, views: Sequence[View], *, alpha: bool = True) -> list[ViewScore]:
    """Every stored picture against the truth, with how far its pose lies from the nearest that training shows.

    `alpha`: whether the pictures have any; without, only colours of the whole frame are scored.
    """
    frames = sorted({view.frame for view in views})
    far = novelty_deg(capture.motion, train=capture.splits["train"].frames, test=frames)
    novelty = dict(zip(frames, far, strict=True))
    scored = [_score(cell, capture, view, stored_prediction(cell, capture, view)) for view in views]
    if not alpha:
        scored = [replace(each, scores=_of_whole_frame(each.scores)) for each in scored]
    return [replace(each, scores=each.scores | {NOVELTY: novelty[each.frame]}) for each in scored]


def _of_whole_frame(scores: dict[tuple[str, str], float]) -> dict[tuple[str, str], float]:
    return {name: value for name, value in scores.items() if name[0] == "full" and name != ("full", "iou")}


def _score(cell: Cell, capture: Capture, view: View, prediction: np.ndarray) -> ViewScore:
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    scores = metrics.score_view(prediction, truth)
    scores |= lpips_scores(prediction, truth, cell.config.device)
    noise = pixels_path(capture.folder, view.camera, view.frame)
    if noise.exists():
        variance = read_arrays(noise, expected=("noise",))["noise"]
        scores["foreground", "noise_ceiling"] = metrics.noise_ceiling(variance, metrics.foreground(truth))
    digest = sha256(prediction.tobytes()).hexdigest()
    return ViewScore(split=view.split, camera=view.camera, frame=view.frame, prediction=digest, scores=scores)


def lpips_scores(prediction: np.ndarray, truth: np.ndarray, device: str) -> dict[tuple[str, str], float]:
    """LPIPS x 1000 of uint8 RGBA images on black, by `LPIPS_SCORES`; without what could not be measured."""
    perceptual = _perceptual(device)
    if perceptual is None:
        return {}
    frames = prediction[..., :3], truth[..., :3]
    pairs = {"full": frames, "release_crop": metrics.release_crop(*frames, metrics.foreground(truth))}
    values = {region: perceptual(*pair) for region, pair in pairs.items() if pair is not None}
    return {(region, "lpips"): value for region, value in values.items() if value is not None}


@cache
def _perceptual(device: str) -> Callable[[np.ndarray, np.ndarray], float | None] | None:
    """LPIPS, where its weights are there."""
    path = weights_file()
    if path is None:
        return None
    from benchmarks.cell.lpips import Lpips

    return Lpips(path, device)


def quality_summary(cell: Cell, capture: Capture, scored: list[ViewScore]) -> tuple[Summary, ...]:
    """What follows from the stored pictures: means over images, the gap to training views, flicker."""
    means = image_summary(scored)
    with_alpha = all(("foreground", "psnr") in view.scores for view in scored)
    return means + _gap_summary(means) + (_flicker_summary(cell, capture, scored) if with_alpha else ())


def image_summary(scored: list[ViewScore]) -> tuple[Summary, ...]:
    """Means over the images of each split."""
    rows = []
    for split in IMAGE_SPLITS:
        views = [view for view in scored if view.split == split]
        for region, metric in (*VIEW_SCORES, *LPIPS_SCORES, ("foreground", "noise_ceiling"), NOVELTY):
            values = [view.scores[region, metric] for view in views if (region, metric) in view.scores]
            if values:
                rows.append(Summary(split=split, region=region, metric=metric, value=float(np.mean(values))))
    return tuple(rows)


def _gap_summary(rows: tuple[Summary, ...]) -> tuple[Summary, ...]:
    """By how much training views are better than the views of each other split: the generalisation gap."""
    means = {row.split: row.value for row in rows if (row.region, row.metric) == ("foreground", "psnr")}
    return tuple(
        Summary(split=split, region="foreground", metric="gap", value=means["train_view"] - value)
        for split, value in means.items()
        if split != "train_view" and "train_view" in means
    )


def _training_summary(training: TrainingOutcome | None, curve: tuple[CurvePoint, ...]) -> tuple[Summary, ...]:
    """How training ended; the seconds to the plateau where there is one."""
    if training is None:
        return ()
    reached, settled = training.ended_by == "plateau", seconds_to_settle(curve)
    rows = {"steps": float(training.steps), "plateau": float(reached)}
    seen = {"train_cameras": training.cameras, "train_frames": training.frames}
    rows |= {name: float(count) for name, count in seen.items() if count}
    if reached and settled is not None:
        rows["settled_s"] = settled
    return tuple(Summary(split="speed", region="", metric=name, value=value) for name, value in rows.items())


def _flicker_summary(cell: Cell, capture: Capture, scored: list[ViewScore]) -> tuple[Summary, ...]:
    """Flicker on held-out motion: per split, the mean over pairs of scored frames that follow each other."""
    rows = []
    for split in POSE_FRAMES:
        runs = _runs(capture, sorted((view.camera, view.frame) for view in scored if view.split == split))
        values = [_flicker(cell, capture, split, run) for run in runs if len(run) > 1]
        if values:
            mean = np.average(values, weights=[len(run) - 1 for run in runs if len(run) > 1])
            rows.append(Summary(split=split, region="foreground", metric="flicker", value=float(mean)))
    return tuple(rows)


def _runs(capture: Capture, views: list[tuple[str, int]]) -> list[list[tuple[str, int]]]:
    """Views of one camera whose frames follow each other in one sequence; `views`: camera and frame, sorted."""
    runs: list[list[tuple[str, int]]] = []
    for camera, frame in views:
        sequence = capture.motion.sequence
        if runs and runs[-1][-1] == (camera, frame - 1) and sequence[frame] == sequence[frame - 1]:
            runs[-1].append((camera, frame))
        else:
            runs.append([(camera, frame)])
    return runs


def _flicker(cell: Cell, capture: Capture, split: str, run: list[tuple[str, int]]) -> float:
    """`metrics.flicker` over a run of views."""
    predicted = [stored_prediction(cell, capture, View(split=split, camera=c, frame=f)) for c, f in run]
    return metrics.flicker(predicted, [metrics.on_black(capture.image(camera, frame)) for camera, frame in run])


def _pose_geometry(client: MethodClient, described: MethodInfo, views: tuple[View, ...]) -> PosedFrames | None:
    """Template and Gaussians in the evaluated frames, of methods that show their geometry."""
    if not described.geometry:
        return None
    frames = sorted({view.frame for view in views})
    few = {frame for split in IMAGE_SPLITS for frame in _few(_frames_of(views, split))}
    return PosedFrames(
        vertices={frame: client.geometry("vertices", frame) for frame in frames},
        means={frame: client.geometry("means", frame) for frame in few} if described.gaussians else {},
    )


def _geometry_summary(capture: Capture, posed: PosedFrames | None, views: tuple[View, ...]) -> tuple[Summary, ...]:
    """Template and Gaussians against the true surface."""
    if posed is None or not (capture.folder / "truth" / "template.npz").exists():
        return ()
    rows = []
    template_truth = read_template_truth(capture)
    for split in IMAGE_SPLITS:
        frames = _frames_of(views, split)
        error = metrics.template_error_mm([posed.vertices[frame] for frame in frames], template_truth[frames])
        if error is not None:  # A template of its own (a bare body, say) has no vertices that could be compared.
            rows.append(Summary(split=split, region="", metric="template_mm", value=error))
        distances = [_surface_distance(capture, posed.means[frame], frame) for frame in _few(frames) if posed.means]
        known = [distance for distance in distances if distance is not None]
        if known:
            rows.append(Summary(split=split, region="", metric="surface_mm", value=float(np.mean(known))))
    return tuple(rows)


def _frames_of(views: tuple[View, ...], split: str) -> list[int]:
    return sorted({view.frame for view in views if view.split == split})


def _few(frames: list[int]) -> list[int]:
    return frames[:: max(1, len(frames) // GEOMETRY_FRAMES)]


def _surface_distance(capture: Capture, means: np.ndarray, frame: int) -> float | None:
    if not surface_path(capture.folder, frame).exists() or not len(means):
        return None
    vertices, faces = read_surface_mesh_truth(capture, frame)
    some = np.asarray(means, np.float64)[:: -(-len(means) // GEOMETRY_POINTS)]
    return metrics.surface_distance_mm(some, vertices, faces)


def training_costs(spent: TrainingTime, *, logged_s: float) -> dict[tuple[str, str], float]:
    """Seconds of training: those of the attempt that came through, or by the method's log where this is longer.

    The log goes on where an interrupted attempt stopped, and so has the seconds of all attempts.
    """
    costs = {("speed", "train_s"): max(spent.wall_s, logged_s)}
    if spent.cpu_s is not None:
        was_interrupted = logged_s > spent.wall_s
        costs["speed", "train_wall_s"] = costs["speed", "train_s"]
        costs["speed", "train_cpu_s"] = logged_s if was_interrupted else spent.cpu_s
    return costs


def _cost_summary(drawn: MethodOutputs, spent: TrainingTime, *, logged_s: float) -> tuple[Summary, ...]:
    """What training and drawing cost."""
    timing, described = drawn.timing, drawn.described
    costs = {
        ("speed", "frame_ms"): float(np.median(timing.frame_ms)),
        **{("speed", f"{name}_ms"): float(np.median(values)) for name, values in timing.stage_ms.items()},
        **training_costs(spent, logged_s=logged_s),
        ("speed", "failed"): 0.0,
        ("memory", "params"): float(described.params),
        ("memory", "gaussians"): float(described.gaussians),
        ("memory", "peak_rss_mb"): drawn.peak_mb,
    }
    if described.template_s is not None:  # What learning the template took; `train_s` is without it.
        costs["speed", "template_s"] = described.template_s
    return tuple(
        Summary(split=split, region="", metric=metric, value=value) for (split, metric), value in costs.items()
    )


def evaluated_views(capture: Capture) -> tuple[View, ...]:
    """The images that are scored, in a fixed order.

    - train_view: 12 training images, spread evenly over all.
    - novel_view: held-out cameras in at most 12 training frames, spread evenly.
    - near_pose, novel_pose, far_pose: held-out cameras in at most 24, 700 and 24 frames, spread evenly over all clips;
      700 are every tenth of the paper's test frames.
    """
    pairs: dict[str, list[tuple[str, int]]] = {split: [] for split in IMAGE_SPLITS}
    train = capture.splits["train"].views
    pairs["train_view"] = [train[i] for i in spread(len(train), TRAIN_VIEWS)]
    if "novel_view" in capture.splits:
        split = capture.splits["novel_view"]
        frames = [split.frames[i] for i in spread(len(split.frames), VIEW_FRAMES)]
        pairs["novel_view"] = [(camera, frame) for camera in split.cameras for frame in frames]
    for name, most in POSE_FRAMES.items():
        if name in capture.splits:
            split = capture.splits[name]
            frames = [split.frames[i] for i in spread(len(split.frames), most)]
            pairs[name] = [(camera, frame) for camera in split.cameras for frame in frames]
    return tuple(View(split=s, camera=camera, frame=frame) for s in IMAGE_SPLITS for camera, frame in pairs[s])


def playback(views: tuple[View, ...]) -> list[View]:
    """The views in the order in which they are timed: first motion that is not training's, as near to it as there is.

    A method that does less in poses far from training's, because it trusts what it learned less there, is timed where
    it does all. Camera by camera, frames follow each other.
    """
    order = ("near_pose", "novel_pose", "far_pose", "novel_view", "train_view")
    return sorted(views, key=lambda view: order.index(view.split))


def spread(count: int, at_most: int) -> list[int]:
    """At most `at_most` different indices below `count`, evenly spread, ends included."""
    return sorted({round(x) for x in np.linspace(0, count - 1, min(count, at_most))})


def reference_workload_ms() -> float:
    """Milliseconds of a fixed mixture of arithmetic and memory traffic (a product and a sort), a few ms on one core."""
    grid = np.sin(np.arange(192 * 192, dtype=np.float32)).reshape(192, 192)
    start = time.perf_counter()
    product = grid
    for _ in range(8):
        product = np.tanh(product @ grid)
        np.sort(product, axis=None)
    return (time.perf_counter() - start) * 1e3


def read_curve(path: Path) -> tuple[CurvePoint, ...]:
    """Points of `log.jsonl` that carry `seconds` and a `loss` or `train_psnr`, in order of time, thinned to some 200.

    Lines of other kinds, and the half line that an interrupted process leaves, are passed over.
    """
    if not path.exists():
        return ()
    with open_regular(path, most=LARGEST_LOG) as file:
        lines = iter(lambda: file.readline(LONGEST_LINE), b"")
        points = [point for line in islice(lines, MOST_LINES) if (point := _point(line)) is not None]
    points.sort(key=lambda point: point.seconds)
    return tuple(points[i] for i in _thin(points))


def seconds_to_settle(curve: tuple[CurvePoint, ...]) -> float | None:
    """Seconds after which every score of the reserved views lies within 0.3 dB of the last; None without scores."""
    scored = [(point.seconds, point.psnr) for point in curve if point.psnr is not None]
    below = [i for i, (_, psnr) in enumerate(scored) if psnr < scored[-1][1] - SETTLED_DB]
    return scored[below[-1] + 1 if below else 0][0] if scored else None


def _point(line: bytes) -> CurvePoint | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict):
        return None
    seconds, loss, psnr = (_finite(row.get(name)) for name in ("seconds", "loss", "train_psnr"))
    if seconds is None or (loss is None and psnr is None):
        return None
    return CurvePoint(seconds=seconds, loss=loss, psnr=psnr)


def _finite(value: Any) -> float | None:
    known = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST_VALUE
    return float(value) if known else None


def _thin(points: list[CurvePoint]) -> list[int]:
    """Every point with a score, the last, and as many of the others as there is room for."""
    step = max(1, math.ceil(len(points) / MAX_POINTS))
    scored = [i for i, point in enumerate(points) if point.psnr is not None]
    return sorted({*range(0, len(points), step), *scored[-MAX_POINTS:], *([len(points) - 1] if points else [])})
