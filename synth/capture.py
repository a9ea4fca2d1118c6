"""From a scene to a capture on disk: deterministic, resumable per image, the manifest last."""

import multiprocessing
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.connection import wait as wait_for_end
from pathlib import Path
from typing import Any

import numpy as np

from ash.dataset import (
    SCHEMA,
    Camera,
    Split,
    image_path,
    pixels_path,
    read_cameras,
    read_manifest,
    surface_path,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.files import InputError, read_arrays, read_image, sha256_of, write_arrays, write_image, write_json
from synth import cloth, texture
from synth.body import Body, Surface
from synth.mannequin import mannequin
from synth.motion import make_motion
from synth.presets import require_space
from synth.render import Renderer, Studio, probe
from synth.rig import held_out, make_cameras
from synth.rig import names as camera_names
from synth.scene import Scene, stream

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """One image to make."""

    camera: str
    frame: int


def make_capture(
    scene: Scene, folder: Path, *, workers: int = 1, progress: Progress | None = None, executor: Executor | None = None
) -> Path:
    """Render a scene into `folder` and return it. What is there already is kept; a finished capture returns at once.

    `progress(done, total)` is told about images. With an `executor`, frames are rendered through it (its workers must
    see the same folder); without one, through `workers` processes.

    Raises:
        InputError: the folder holds another scene, cannot be written, or its disk is too small.
    """
    folder = Path(folder)
    if is_finished(scene, folder):
        return folder
    _begin(scene, folder)
    renderer = probe()
    if not renderer.libllvm:
        print(renderer.note, file=sys.stderr)
    describe(scene, folder)
    views = wanted_views(scene)
    missing = [view for view in views if not image_path(folder, view.camera, view.frame).is_file()]
    done = len(views) - len(missing)
    if progress:
        progress(done, len(views))
    tasks = _by_frame(missing)
    if tasks:
        own = None if executor else _pool(min(workers, len(tasks)))
        try:
            for count in _run(executor or own, scene, folder, renderer, tasks):
                done += count
                if progress:
                    progress(done, len(views))
        except BaseException:
            if own:  # Files are whole or absent, so nobody needs to wait for the frames that are under way.
                for process in list(own._processes.values()):
                    process.terminate()
            raise
        finally:
            if own:
                own.shutdown(wait=True, cancel_futures=True)
    finish(scene, folder, renderer)
    return folder


def is_finished(scene: Scene, folder: Path) -> bool:
    """Whether `folder` holds this scene, complete, every file in its place; `verify_capture` checks the contents."""
    if not (folder / "manifest.json").is_file():
        return False
    manifest = read_manifest(folder)
    if manifest.get("identity") != scene.identity:
        raise InputError(
            f"{folder}: holds the scene {manifest['scene']} with other parameters, expected an empty folder"
        )
    return bool(manifest["complete"]) and all((folder / name).is_file() for name in manifest["files"])


def _begin(scene: Scene, folder: Path) -> None:
    """Claim the folder: sweep what a killed run left half-written, and write a manifest that says unfinished."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "manifest.json").is_file() and any(folder.iterdir()):
            raise InputError(f"{folder}: expected an empty folder or a capture")
        for path in folder.rglob(".*.*"):
            path.unlink()
        require_space(scene, folder)
        write_json(folder / "manifest.json", _manifest(scene, files={}, complete=False, made_with={}))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error


def _manifest(scene: Scene, *, files: dict[str, str], complete: bool, made_with: dict[str, str]) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "scene": scene.name,
        "size": scene.size,
        "seed": scene.seed,
        "identity": scene.identity,
        "parameters": scene.parameters,
        "splits": {
            name: {"cameras": list(split.cameras), "frames": list(split.frames)}
            for name, split in splits(scene).items()
        },
        "made_with": made_with,
        "files": files,
        "complete": complete,
    }


def splits(scene: Scene) -> dict[str, Split]:
    """Training views; held-out cameras on some training frames; held-out cameras on the test motion."""
    names = camera_names(scene.rig)
    apart = tuple(names[k] for k in held_out(scene.rig))
    training = sum(clip.frames for clip in scene.train)
    return {
        "train": Split(cameras=tuple(name for name in names if name not in apart), frames=tuple(range(training))),
        "novel_view": Split(
            cameras=apart, frames=tuple(range(scene.novel_view_stride // 2, training, scene.novel_view_stride))
        ),
        "novel_pose": Split(cameras=apart, frames=tuple(range(training, scene.frames))),
    }


def wanted_views(scene: Scene) -> list[View]:
    """Every image of the capture, frame by frame."""
    pairs = {pair for split in splits(scene).values() for pair in split.views}
    return [View(camera=camera, frame=frame) for camera, frame in sorted(pairs, key=lambda pair: (pair[1], pair[0]))]


def make_body(scene: Scene) -> Body:
    """The scene's clothed body."""
    if scene.body == "mannequin":
        return mannequin(skirt=scene.outfit.skirt)
    from synth.dressing import anny_body

    return anny_body(skirt=scene.outfit.skirt)


def describe(scene: Scene, folder: Path) -> None:
    """Write everything but images: motion, surface of every frame, template, cameras, texture. Kept where complete."""
    last = folder / "cameras.json"
    if last.is_file():
        return
    body = make_body(scene)
    motion = make_motion(body.skeleton, scene.train + scene.test, fps=scene.fps, seed=stream(scene, "motion"))
    surface = cloth.true_surface(body, motion, scene.outfit, seed=stream(scene, "folds"))
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_motion(folder / "motion.npz", motion)
    offset = cloth.scan_error(body, scene.outfit, seed=stream(scene, "scan"))
    write_template(folder / "template.npz", body.template(offset))
    write_arrays(folder / "truth" / "template.npz", vertices=surface[:, body.kept])
    # The picture is made of float32 vertices, so these are the exact ones.
    stored = surface.astype(np.float32)
    for frame, vertices in enumerate(stored):
        write_arrays(surface_path(folder, frame), vertices=vertices)
    rest = body.surface
    write_arrays(
        folder / "truth" / "surface.npz",
        rest=rest.vertices,
        faces=rest.faces.astype(np.int32),
        uvs=rest.uvs,
        uv_faces=rest.uv_faces.astype(np.int32),
        part=rest.part.astype(np.int32),
    )
    image = texture.paint(body, size=scene.texture, seed=stream(scene, "texture"))
    write_image(folder / "truth" / "texture.png", image)
    write_cameras(last, make_cameras(scene.rig, stored.reshape(-1, 3).astype(np.float64)))


def _by_frame(views: list[View]) -> list[list[View]]:
    frames: dict[int, list[View]] = {}
    for view in views:
        frames.setdefault(view.frame, []).append(view)
    return list(frames.values())


def _pool(workers: int) -> ProcessPoolExecutor:
    # A fresh process, not a fork: neither Mitsuba's threads nor an EGL driver's LLVM may be inherited.
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start_worker)


def _start_worker() -> None:
    """Leave Ctrl-C to the parent, and end when the parent ends, however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch(sentinel: int) -> None:
            wait_for_end([sentinel])
            os._exit(1)

        threading.Thread(target=watch, args=(parent.sentinel,), daemon=True).start()


def _run(executor: Executor | None, scene: Scene, folder: Path, renderer: Renderer, tasks: list[list[View]]) -> Any:
    """Submit tasks and yield how many images each finished one made. Few are in flight, so that stopping is quick."""
    if executor is None:
        raise ValueError("an executor is needed")
    waiting = list(reversed(tasks))
    running: set[Future[int]] = set()
    while waiting or running:
        while waiting and len(running) < 8:
            running.add(executor.submit(render_views, scene, folder, renderer, waiting.pop()))
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            yield future.result()


_STUDIOS: dict[tuple[str, str], Studio] = {}  # One per process and capture: it is costly to build and never changes.


def _studio(scene: Scene, folder: Path, renderer: Renderer) -> Studio:
    key = (scene.identity, str(folder))
    if key not in _STUDIOS:
        _STUDIOS.clear()
        arrays = read_arrays(folder / "truth" / "surface.npz", expected=("rest", "faces", "uvs", "uv_faces", "part"))
        surface = Surface(
            vertices=arrays["rest"],
            faces=arrays["faces"].astype(np.int64),
            uvs=arrays["uvs"],
            uv_faces=arrays["uv_faces"].astype(np.int64),
            part=arrays["part"].astype(np.int64),
        )
        image = read_image(folder / "truth" / "texture.png", shape=(scene.texture, scene.texture, 3))
        _STUDIOS[key] = Studio(renderer, surface, image, scene.light, depth=scene.depth)
    return _STUDIOS[key]


def render_views(scene: Scene, folder: Path, renderer: Renderer, views: list[View]) -> int:
    """Render the views of one frame and write them; the image last, so that its presence means that all is there."""
    studio = _studio(scene, folder, renderer)
    cameras = read_cameras(folder / "cameras.json")
    studio.dress(read_arrays(surface_path(folder, views[0].frame), expected=("vertices",))["vertices"])
    for view in views:
        _write_view(scene, folder, studio, cameras[view.camera], view)
    return len(views)


def _write_view(scene: Scene, folder: Path, studio: Studio, camera: Camera, view: View) -> None:
    picture = studio.picture(camera, samples=scene.samples, seed=stream(scene, "pixels", view.camera, view.frame))
    write_arrays(
        pixels_path(folder, view.camera, view.frame),
        triangle=picture.triangle,
        barycentric=picture.barycentric.astype(np.float16),
        noise=picture.noise.astype(np.float16),
    )
    write_image(image_path(folder, view.camera, view.frame), picture.rgba)


def finish(scene: Scene, folder: Path, renderer: Renderer) -> None:
    """Hash every file and write the final manifest."""
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    files = {name: sha256_of(folder / name) for name in names if name != "manifest.json"}
    made_with = {
        "numpy": np.__version__,
        "python": platform.python_version(),
        "mitsuba": renderer.mitsuba,
        "variant": renderer.variant,
        "machine": platform.machine(),
    }
    write_json(folder / "manifest.json", _manifest(scene, files=files, complete=True, made_with=made_with))
