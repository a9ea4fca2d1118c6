"""One cell, in a process of its own: train, render, score, time; `python -m benchmarks.run FOLDER`.

Exit codes: 0 a result was written (also that of a method that failed), 2 wrong input or no room to write (on stderr),
130 interrupted, without a result.
"""

import argparse
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import cast

import numpy as np

from ash.dataset import Capture, load_capture, pixels_path, read_template_truth, surface_path
from ash.files import InputError, read_arrays, read_image, write_image
from ash.protocol import Avatar, LearnsTemplate, PosedGeometry, StageClock
from benchmarks import metrics, provenance
from benchmarks.cells import (
    Cell,
    CellConfig,
    CellResult,
    Provenance,
    Summary,
    Timing,
    ViewScore,
    failed_result,
    read_cell,
    read_result,
    write_result,
)
from benchmarks.curves import read_curve
from benchmarks.errors import disk_problem
from benchmarks.experiments import ORACLES, find_method
from benchmarks.metrics import IMAGE_SPLITS, VIEW_SCORES
from benchmarks.sealing import seen_by_method, watched
from benchmarks.timing import peak_memory_mb, time_frames
from benchmarks.views import View, evaluated_views, playback
from benchmarks.weights import weights_file

CHECKPOINT = "model.safetensors"
TEMPLATES = "templates"  # Beside the captures: learned once, shared by methods and runs.
GEOMETRY_FRAMES = 4
GEOMETRY_POINTS = 4096  # Gaussians whose distance to the surface is measured, evenly taken; the mean wants no more.


def main(argv: list[str] | None = None) -> int:
    """Run the cell whose folder is given, unless it is finished."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--follow-parent", action="store_true", help="end when standard input ends")
    arguments = parser.parse_args(argv)
    if arguments.follow_parent:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        run_cell(read_cell(arguments.folder))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except OSError as error:
        print(disk_problem(error) or _reraise(error), file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(f"interrupted {interruption}", file=sys.stderr)
        return 130
    return 0


def run_cell(cell: Cell) -> CellResult:
    """Train and evaluate a cell and write its result; whatever the method does wrong is a result too.

    Raises:
        InputError: the capture or the method's name is at fault, not the method.
        OSError: the cell's folder cannot be written.
    """
    finished = read_result(cell.folder)
    if finished is not None:
        return finished
    start = time.perf_counter()
    capture = _capture_of(cell)
    method = find_method(cell.config.method)
    try:
        result = _train_and_evaluate(cell, capture, method.load())
    except (InputError, OSError):
        raise
    except FloatingPointError as error:
        result = failed_result(cell.config, "diverged", str(error))
    except MemoryError as error:
        result = failed_result(cell.config, "out of memory", str(error) or "the process could not allocate memory")
    except Exception as error:
        traceback.print_exc()
        result = failed_result(cell.config, "crashed", f"{type(error).__name__}: {error}")
    result = replace(result, provenance=_provenance(time.perf_counter() - start))
    write_result(cell.folder, result)
    return result


def evaluate_cell(cell: Cell) -> CellResult:
    """Load a cell's checkpoint, render and score again, and write the result anew; training is not repeated."""
    before = _finished(cell)
    capture = _capture_of(cell)
    train_s = before.value("speed", "", "train_s") or 0.0
    with load_avatar(cell, capture) as (avatar, seen):
        result = replace(_evaluate(cell, capture, seen, avatar, train_s), provenance=before.provenance)
    write_result(cell.folder, result)
    return result


def is_trained(cell: Cell) -> bool:
    """Whether there is an avatar to load."""
    return (cell.folder / CHECKPOINT).exists()


@contextmanager
def load_avatar(cell: Cell, capture: Capture) -> Iterator[tuple[Avatar, Capture]]:
    """A cell's trained avatar and the capture as it sees it; both hold as long as the body runs."""
    factory = find_method(cell.config.method).load()
    with _seen(cell, capture) as seen:
        with watched(capture, seen):
            avatar = _make(cell.config, seen, factory)
            avatar.load(cell.folder / CHECKPOINT)
        yield avatar, seen


def rescore_cell(cell: Cell) -> CellResult:
    """Recompute every quality from the stored predictions and write the result anew; costs stay as measured."""
    before = _finished(cell)
    capture = _capture_of(cell)
    views = [View(split=view.split, camera=view.camera, frame=view.frame) for view in before.views]
    scored = [_score(cell, capture, view, stored_prediction(cell, capture, view)) for view in views]
    for old, new in zip(before.views, scored, strict=True):
        if old.prediction != new.prediction:
            name = prediction_path(cell.folder, View(split=new.split, camera=new.camera, frame=new.frame))
            raise InputError(f"{name}: altered since it was scored (SHA-256 differs from result.json)")
    recomputed = _image_summary(scored) + _flicker_summary(cell, capture, scored)
    names = {(row.split, row.region, row.metric) for row in recomputed}
    kept = tuple(row for row in before.summary if (row.split, row.region, row.metric) not in names)
    result = replace(before, views=tuple(scored), summary=recomputed + kept)
    write_result(cell.folder, result)
    return result


def prediction_path(folder: Path, view: View) -> Path:
    """Where the prediction of a view lies."""
    return folder / "images" / view.split / view.camera / f"{view.frame:06d}.png"


def stored_prediction(cell: Cell, capture: Capture, view: View) -> np.ndarray:
    """The prediction of a view as it was scored, uint8 RGBA on black."""
    camera = capture.cameras[view.camera]
    return read_image(prediction_path(cell.folder, view), shape=(camera.height, camera.width, 4))


def _train_and_evaluate(cell: Cell, capture: Capture, factory: Callable[..., Avatar]) -> CellResult:
    with _seen(cell, capture) as seen:
        with watched(capture, seen):
            avatar = _make(cell.config, seen, factory)
            start = time.perf_counter()
            avatar.fit(seen, folder=cell.folder)
            train_s = time.perf_counter() - start
            avatar.save(cell.folder / CHECKPOINT)
        return _evaluate(cell, capture, seen, avatar, train_s)


def _evaluate(cell: Cell, capture: Capture, seen: Capture, avatar: Avatar, train_s: float) -> CellResult:
    """The method draws everything first, while it is watched; truth is read afterwards."""
    views = evaluated_views(capture)
    with watched(capture, seen):
        for view in views:
            _draw(cell, capture, avatar, view)
        timing = time_frames(avatar, capture, playback(views))
        geometry = _pose_geometry(capture, avatar, views)
    scored = [_score(cell, capture, view, stored_prediction(cell, capture, view)) for view in views]
    curve = read_curve(cell.folder / "log.jsonl")
    summary = (
        _image_summary(scored)
        + _flicker_summary(cell, capture, scored)
        + _geometry_summary(capture, geometry, views)
        + _cost_summary(avatar, timing, max([train_s, *(point.seconds for point in curve)]))
        + _template_cost(avatar)
    )
    return CellResult(
        config=cell.config, status="done", summary=summary, views=tuple(scored), timing=timing, curve=curve
    )


def _draw(cell: Cell, capture: Capture, avatar: Avatar, view: View) -> None:
    """Render a view and store it."""
    camera = capture.cameras[view.camera]
    prediction = metrics.quantise(avatar.render(capture.motion, view.frame, camera, clock=StageClock()))
    if prediction.shape != (camera.height, camera.width, 4):
        raise ValueError(f"expected an image {(camera.height, camera.width, 4)}, got {prediction.shape}")
    write_image(prediction_path(cell.folder, view), prediction)


def _make(config: CellConfig, capture: Capture, factory: Callable[..., Avatar]) -> Avatar:
    return factory(capture, seed=config.seed, preset=config.preset)


def _seen(cell: Cell, capture: Capture) -> AbstractContextManager[Capture]:
    """What a method may see: the training part; oracles, which stand for a bound and no method, see the truth."""
    store = cell.capture_folder.parent / TEMPLATES
    return seen_by_method(capture, cell.folder / "input", oracle=cell.config.method in ORACLES, store=store)


def _capture_of(cell: Cell) -> Capture:
    capture = load_capture(cell.capture_folder)
    if capture.identity != cell.config.capture:
        raise InputError(
            f"{cell.capture_folder}: expected the capture {cell.config.capture[:12]}, got {capture.identity[:12]}"
        )
    return capture


def _finished(cell: Cell) -> CellResult:
    result = read_result(cell.folder)
    if result is None or result.status != "done":
        raise InputError(
            f"{cell.folder}: expected a finished cell, got {result.status if result else 'no result.json'}"
        )
    return result


def _score(cell: Cell, capture: Capture, view: View, prediction: np.ndarray) -> ViewScore:
    truth = metrics.on_black(capture.image(view.camera, view.frame))
    scores = metrics.score_view(prediction, truth)
    perceptual = _perceptual()
    if perceptual is not None:
        scores["full", "lpips"] = perceptual(prediction[..., :3], truth[..., :3])
    noise = pixels_path(capture.folder, view.camera, view.frame)
    if noise.exists():
        variance = read_arrays(noise, expected=("noise",))["noise"]
        scores["foreground", "noise_ceiling"] = metrics.noise_ceiling(variance, metrics.foreground(truth))
    digest = sha256(prediction.tobytes()).hexdigest()
    return ViewScore(split=view.split, camera=view.camera, frame=view.frame, prediction=digest, scores=scores)


@cache
def _perceptual() -> Callable[[np.ndarray, np.ndarray], float] | None:
    """LPIPS, where the user gave its weights."""
    path = weights_file()
    if path is None:
        return None
    from benchmarks.lpips import Lpips

    return Lpips(path)


def _image_summary(scored: list[ViewScore]) -> tuple[Summary, ...]:
    """Means over the images of each split."""
    rows = []
    for split in IMAGE_SPLITS:
        views = [view for view in scored if view.split == split]
        for region, metric in (*VIEW_SCORES, ("full", "lpips"), ("foreground", "noise_ceiling")):
            values = [view.scores[region, metric] for view in views if (region, metric) in view.scores]
            if values:
                rows.append(Summary(split=split, region=region, metric=metric, value=float(np.mean(values))))
    return tuple(rows)


def _flicker_summary(cell: Cell, capture: Capture, scored: list[ViewScore]) -> tuple[Summary, ...]:
    """Flicker over the test motion: the only split whose scored frames follow each other."""
    views = [view for view in scored if view.split == "novel_pose"]
    values = []
    for camera in sorted({view.camera for view in views}):
        frames = sorted(view.frame for view in views if view.camera == camera)
        predicted = [
            stored_prediction(cell, capture, View(split="novel_pose", camera=camera, frame=frame)) for frame in frames
        ]
        values.append(metrics.flicker(predicted, [metrics.on_black(capture.image(camera, frame)) for frame in frames]))
    if not values:
        return ()
    return (Summary(split="novel_pose", region="foreground", metric="flicker", value=float(np.mean(values))),)


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedFrames:
    """What an avatar says about its geometry: per frame, template vertices and centres of Gaussians, metres."""

    vertices: dict[int, np.ndarray]
    means: dict[int, np.ndarray]


def _pose_geometry(capture: Capture, avatar: Avatar, views: tuple[View, ...]) -> PosedFrames | None:
    """Template and Gaussians in the evaluated frames, of methods that show their geometry."""
    if not isinstance(avatar, PosedGeometry):
        return None
    frames = sorted({view.frame for view in views})
    few = {frame for split in IMAGE_SPLITS for frame in _few(_frames_of(views, split))}
    return PosedFrames(
        vertices={frame: avatar.template_vertices(capture.motion, frame) for frame in frames},
        means={frame: avatar.gaussian_means(capture.motion, frame) for frame in few} if avatar.gaussian_count() else {},
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
    path = surface_path(capture.folder, frame)
    if not path.exists() or not len(means):
        return None
    faces = read_arrays(capture.folder / "truth" / "surface.npz", expected=("faces",))["faces"]
    vertices = read_arrays(path, expected=("vertices",))["vertices"].astype(np.float64)
    some = np.asarray(means, np.float64)[:: -(-len(means) // GEOMETRY_POINTS)]
    return metrics.surface_distance_mm(some, vertices, faces)


def _cost_summary(avatar: Avatar, timing: Timing, train_s: float) -> tuple[Summary, ...]:
    costs = {
        ("speed", "frame_ms"): float(np.median(timing.frame_ms)),
        **{("speed", f"{name}_ms"): float(np.median(values)) for name, values in timing.stage_ms.items()},
        ("speed", "train_s"): train_s,
        ("speed", "failed"): 0.0,
        ("memory", "params"): float(avatar.parameter_count()),
        ("memory", "gaussians"): float(avatar.gaussian_count()),
        ("memory", "peak_rss_mb"): peak_memory_mb(),
    }
    return tuple(
        Summary(split=split, region="", metric=metric, value=value) for (split, metric), value in costs.items()
    )


def _template_cost(avatar: Avatar) -> tuple[Summary, ...]:
    """What learning the template took, for methods that stand on a learned one; `train_s` is without it."""
    if not isinstance(avatar, LearnsTemplate) or (seconds := avatar.template_seconds()) is None:
        return ()
    return (Summary(split="speed", region="", metric="template_s", value=seconds),)


def _provenance(wall_s: float) -> Provenance:
    return Provenance(
        commit=provenance.commit(), machine=provenance.machine(), versions=provenance.versions(), wall_s=wall_s
    )


def _end_with_parent() -> None:
    """Leave when the engine is gone, however it went: its end of our standard input closes then."""
    while os.read(0, 4096):
        pass
    os._exit(130)


def _reraise(error: OSError) -> str:
    raise error


if __name__ == "__main__":
    sys.exit(main(cast(list[str], sys.argv[1:])))
