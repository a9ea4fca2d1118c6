"""One trial of a method for `ash-bench check-method`, in a process of its own, which `benchmarks.cell.sandbox` starts.

Its folder holds `trial.json` (what to do); `outcome.json` is left there. Nothing is scored: pictures are hashed and
compared by `benchmarks.studies.conformance`. What an outcome says of arrays and bad poses is told by the process in
which the method runs: a check for authors, no defence.
"""

import hashlib
import os
import pickle
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from ash.capture.dataset import Camera, Capture, Pose
from ash.capture.formats import load_capture, read_cameras, read_motion
from ash.capture.manifest import verify_capture
from ash.capture.typed import from_json
from ash.files import InputError, read_json, write_json
from ash.protocol import Avatar, StageClock
from benchmarks.cell.registry import find_method, located
from benchmarks.cell.sandbox import (
    InputModifiedError,
    TruthAccessError,
    add_method_paths,
    peak_memory_mb,
    watched_folders,
)

SLACK = 1e-3  # By how much values may leave 0..1, and the alpha that counts as none: rounding, not light.


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """What one process is to do: train with a seed, or load the weights of another trial."""

    target: str  # the factory, `package.module:function`
    oracle: bool
    capture: str  # the folder of the capture, which only oracles see
    input: str  # the folder of what the method sees
    test_views: str  # the folder with the cameras and the motion that are drawn
    views: tuple[tuple[str, int], ...]  # camera and frame of each picture
    preset: str
    seed: int
    weights: str = ""  # load these in place of training
    thorough: bool = False  # also train again in the same folder, and ask for bad poses


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What one process saw. Empty strings mean that nothing was wrong."""

    pictures: tuple[str, ...] = ()  # SHA-256 of each float32 image
    protocol: str = ""
    images: str = ""
    weights: str = ""
    bad_poses: str = ""
    held_out: str = ""
    input: str = ""
    again: tuple[str, ...] | None = None  # pictures after a second fit in the same folder
    seedless: bool = False
    seconds: float = 0.0
    peak_mb: float = 0.0


def main(arguments: list[str]) -> int:
    """Do the trial whose folder is given."""
    folder = Path(arguments[0])
    os.chdir(folder)
    add_method_paths()
    try:
        trial: Trial = from_json(Trial, read_json(folder / "trial.json"))
        outcome = perform(trial, folder)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except Exception as error:
        traceback.print_exc()
        print(located(error, trial.target), file=sys.stderr)  # The last line is what the user reads first.
        return 1
    write_json(folder / "outcome.json", asdict(outcome))
    return 0


def read_outcome(folder: Path) -> Outcome | None:
    """What a trial left, or None where it did not come to its end.

    Raises:
        InputError: it is something else; the method's process can write there too.
    """
    path = folder / "outcome.json"
    if not path.exists():
        return None
    try:
        outcome: Outcome = from_json(Outcome, read_json(path))
        return outcome
    except ValueError as error:
        raise InputError(f"{path}: expected what a trial leaves ({error})") from error


def perform(trial: Trial, folder: Path) -> Outcome:
    """Build, train or load, draw, and look at what changed."""
    seen = load_capture(Path(trial.input))
    cameras = read_cameras(Path(trial.test_views) / "cameras.json")
    motion = read_motion(Path(trial.test_views) / "motion.npz", joints=len(seen.skeleton.names))
    drawn = replace(seen, cameras=cameras, motion=motion)
    factory = find_method(trial.target).load()
    start = time.perf_counter()
    outcome = Outcome()
    try:
        closed = [] if trial.oracle else [trial.capture]
        with watched_folders(closed, seen.folder), _untouched(seen):
            outcome = _performed(trial, folder, drawn, seen, factory)
    except InputModifiedError as error:
        outcome = replace(outcome, input=str(error))
    except TruthAccessError as error:
        outcome = replace(outcome, held_out=str(error))
    if not outcome.input and (problems := verify_capture(seen.folder)):
        outcome = replace(outcome, input=f"a file of the capture: {problems[0]}")
    return replace(outcome, seconds=time.perf_counter() - start, peak_mb=peak_memory_mb(os.getpid()))


def few_views(capture: Capture) -> list[tuple[str, int]]:
    """Camera and frame of the first image of each split, and of the last of the test motion."""
    return [*(split.views[0] for split in capture.splits.values()), list(capture.splits.values())[-1].views[-1]]


def _performed(trial: Trial, folder: Path, capture: Capture, seen: Capture, factory: Any) -> Outcome:
    views = list(trial.views)
    avatar = factory(seen, seed=trial.seed, preset=trial.preset)
    if not isinstance(avatar, Avatar):
        functions = [name for name in vars(Avatar) if not name.startswith("_") and callable(getattr(Avatar, name))]
        missing = [name for name in functions if not callable(getattr(avatar, name, None))]
        return Outcome(protocol=f"{type(avatar).__name__} lacks {', '.join(missing)} of ash.protocol.Avatar")
    weights = ""
    if trial.weights:
        avatar.load(Path(trial.weights))
    else:
        (folder / "fit").mkdir(parents=True, exist_ok=True)
        avatar.fit(seen, folder=folder / "fit")
        avatar.save(folder / "model.safetensors")
        weights = _weights_problem(folder / "model.safetensors")
    images, problem = draw(avatar, capture, views)
    again, bad_poses = None, ""
    if trial.thorough:
        bad_poses = bad_pose_problem(avatar, capture, views[-1])
        resumed = factory(seen, seed=trial.seed, preset=trial.preset)
        resumed.fit(seen, folder=folder / "fit")
        again = tuple(_hash(image) for image in draw(resumed, capture, views)[0])
    return Outcome(
        pictures=tuple(_hash(image) for image in images),
        protocol=_count_problem(avatar),
        images=problem,
        weights=weights,
        bad_poses=bad_poses,
        again=again,
        seedless=bool(getattr(avatar, "seedless", False)),
    )


def draw(avatar: Avatar, capture: Capture, views: list[tuple[str, int]]) -> tuple[list[np.ndarray], str]:
    """The images of some views, and what is wrong with the first that is not as the protocol says."""
    images, problem = [], ""
    with _untouched(capture):
        for name, frame in views:
            camera = capture.cameras[name]
            image = avatar.render(Pose(capture.motion, frame), camera, clock=StageClock())
            problem = problem or _image_problem(image, camera)
            images.append(np.asarray(image))
    return images, problem


def bad_pose_problem(avatar: Avatar, capture: Capture, view: tuple[str, int]) -> str:
    """Ask for poses that do not exist; each must be refused by a ValueError that says why."""
    motion, camera, here = capture.motion, capture.cameras[view[0]], view[1]
    holes = motion.dofs.copy()
    holes[here] = np.nan
    cases = {
        "a pose of NaN": Pose(replace(motion, dofs=holes), here),
        "a pose with a number too few": Pose(replace(motion, dofs=motion.dofs[:, :-1].copy()), here),
        "a frame beyond the motion's end": Pose(motion, len(motion.dofs)),
    }
    for name, bad in cases.items():
        try:
            avatar.render(bad, camera, clock=StageClock())
        except TruthAccessError:
            raise
        except ValueError as error:
            if not str(error):
                return f"{name} was refused without a word"
        except Exception as error:
            return f"{name}: expected a ValueError that says why, got {type(error).__name__}: {error}"
        else:
            return f"{name} was drawn, expected a ValueError that says why"
    return ""


@contextmanager
def _untouched(capture: Capture) -> Iterator[None]:
    """Refuse a body that changes anything of a capture in memory."""
    before = _fingerprint(capture)
    yield
    after = _fingerprint(capture)
    if changed := [name for name in before | after if before.get(name) != after.get(name)]:
        raise InputModifiedError(f"the method changed what it was given: {', '.join(changed)}")


def _fingerprint(capture: Capture) -> dict[str, bytes]:
    names = ("motion", "skeleton", "template", "splits", "manifest")
    parts = {name: getattr(capture, name) for name in names}
    parts |= {f"camera {name}": camera for name, camera in capture.cameras.items()}
    return {name: pickle.dumps(part) for name, part in parts.items()}


def _image_problem(image: Any, camera: Camera) -> str:
    expected = (camera.height, camera.width, 4)
    if not isinstance(image, np.ndarray) or image.shape != expected or image.dtype != np.float32:
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        return f"expected float32 {expected}, got {got}"
    if not np.isfinite(image).all():
        return f"{int((~np.isfinite(image)).sum())} values are NaN or infinite"
    if image.min() < -SLACK or image.max() > 1 + SLACK:
        return f"values run from {image.min():.3f} to {image.max():.3f}, expected 0 to 1"
    if image[image[..., 3] < SLACK, :3].max(initial=0.0) > 10 * SLACK:  # Overbright colours may exceed a partial alpha.
        return "there is colour where alpha is zero, expected colour premultiplied by alpha"
    return ""


def _weights_problem(path: Path) -> str:
    try:
        with safetensors.safe_open(path, framework="np"):
            return ""
    except (OSError, safetensors.SafetensorError) as error:
        return f"save wrote no safetensors file ({error})"


def _count_problem(avatar: Avatar) -> str:
    for name in ("parameter_count", "gaussian_count"):
        count = getattr(avatar, name)()
        if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 0:
            return f"{name} gave {count!r}, expected a whole number"
    return ""


def _hash(image: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()
