"""From a scene to a capture on disk: deterministic, resumable per image, the manifest last."""

import multiprocessing
import os
import platform
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from multiprocessing.connection import wait as wait_for_end
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Split, image_path, pixels_path, surface_path
from ash.capture.formats import (
    read_cameras,
    read_motion,
    read_skeleton,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.capture.manifest import Manifest, hash_files, is_capture, read_manifest
from ash.files import InputError, read_arrays, read_image, write_arrays, write_image
from synth.camera.render import Picture, Renderer, Studio, probe
from synth.camera.rig import held_out, make_cameras
from synth.camera.rig import names as camera_names
from synth.camera.shutter import shutter_poses
from synth.cloth import surface
from synth.cloth.checks import penetrations, stretch
from synth.code import code_version, source_version
from synth.cost import require_space
from synth.motion.clips import make_motion, pose_novelty
from synth.person import texture
from synth.person.bare import bare_template
from synth.person.body import Body, Surface
from synth.person.mannequin import mannequin
from synth.scene import Scene, stream

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class WantedView:
    """One image to make."""

    camera: str
    frame: int


def make_capture(
    scene: Scene,
    folder: Path,
    *,
    workers: int = 1,
    progress: Progress | None = None,
    executor: Executor | None = None,
    shard: tuple[int, int] = (1, 1),
) -> Path:
    """Render a scene into `folder` and return it. What is there already is kept; a finished capture returns at once.

    `progress(done, total)` is told about images. With an `executor`, frames are rendered through it (its workers must
    see the same folder); without one, through `workers` processes. Of `shard` (i, n) only every n-th frame from the
    i-th is rendered; the shard that finds all images there finishes the capture. What other code made is removed first.

    Raises:
        InputError: the folder holds another scene, cannot be written, or its disk is too small.
    """
    folder = Path(folder)
    if is_finished(scene, folder):
        return folder
    renderer = probe()
    if not renderer.libllvm:
        print(renderer.note, file=sys.stderr)
    _begin(scene, folder, alone=shard[1] == 1)
    views = wanted_views(scene)
    own = None if executor else _pool(max(1, min(workers, scene.frames)))
    try:
        describe(scene, folder, executor or own)
        share = [view for frame in _by_frame(views)[shard[0] - 1 :: shard[1]] for view in frame]
        missing = [view for view in share if not image_path(folder, view.camera, view.frame).is_file()]
        tasks = _by_frame(missing)
        done = len(share) - len(missing)
        if progress:
            progress(done, len(share))
        for count in _run(executor or own, scene, folder, renderer, tasks):
            done += count
            if progress:
                progress(done, len(share))
    except BaseException:
        if own:  # Files are whole or absent, so nobody needs to wait for the frames that are under way.
            for process in list((own._processes or {}).values()):
                process.terminate()
        raise
    finally:
        if own:
            own.shutdown(wait=True, cancel_futures=True)
    if all(image_path(folder, view.camera, view.frame).is_file() for view in views):
        finish(scene, folder, renderer)
    return folder


def is_finished(scene: Scene, folder: Path) -> bool:
    """Whether `folder` holds this scene, made by this code, complete, every file in its place.

    `verify_capture` checks the contents.
    """
    if not is_capture(folder):
        return False
    manifest = read_manifest(folder)
    if manifest.identity != scene.identity:
        raise InputError(f"{folder}: holds the scene {manifest.scene} with other parameters, expected an empty folder")
    if why_stale(scene, folder):
        return False
    return manifest.complete and all((folder / name).is_file() for name in manifest.files)


def why_stale(scene: Scene, folder: Path) -> str:
    """Why the capture in `folder` is not what this code would make of the scene; empty where it is or none is there."""
    if not is_capture(folder):
        return ""
    manifest = read_manifest(folder)
    if not manifest.identity:  # Made by hand, as tests do: nobody can make it again.
        return ""
    if manifest.identity != scene.identity:
        return f"it holds {manifest.scene} with other parameters"
    if manifest.code != code_version():
        return f"it was made by other code ({manifest.code or 'unknown'}, this is {code_version()})"
    return ""


def _begin(scene: Scene, folder: Path, *, alone: bool) -> None:
    """Claim the folder: sweep what a killed run left half-written, and write a manifest that says unfinished.

    Where other shards may be at work (not `alone`), half-written files may be theirs and stay.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not is_capture(folder) and any(folder.iterdir()):
            raise InputError(f"{folder}: expected an empty folder or a capture")
        if reason := why_stale(scene, folder):
            print(f"{folder}: {reason}; making it again", file=sys.stderr)
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in folder.rglob(".*.*") if alone else ():
            path.unlink()
        require_space(scene, folder)
        replace(_manifest(scene), complete=False).write(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error


def _manifest(scene: Scene) -> Manifest:
    """What can be said of a capture before anything of it is made."""
    return Manifest(
        scene=scene.name,
        size=scene.size,
        seed=scene.seed,
        identity=scene.identity,
        code=code_version(),
        source=source_version(),
        parameters=scene.parameters,
        splits=splits(scene),
        files={},
    )


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


def wanted_views(scene: Scene) -> list[WantedView]:
    """Every image of the capture, frame by frame."""
    pairs = {pair for split in splits(scene).values() for pair in split.views}
    return [
        WantedView(camera=camera, frame=frame) for camera, frame in sorted(pairs, key=lambda pair: (pair[1], pair[0]))
    ]


def make_body(scene: Scene) -> Body:
    """The scene's clothed body."""
    if scene.body == "mannequin":
        return mannequin(skirt=scene.outfit.skirt)
    from synth.person.dressing import anny_body

    return anny_body(skirt=scene.outfit.skirt)


def describe(scene: Scene, folder: Path, executor: Executor | None = None) -> None:
    """Write everything but images: motion, surface of every frame, template, cameras, texture. Kept where complete.

    The texture is painted by the `executor` while the cloth moves here.
    """
    last = folder / "cameras.json"
    if last.is_file():
        return
    body = make_body(scene)
    painted = executor.submit(paint, scene, folder) if executor else None
    motion = make_motion(body.skeleton, scene.train + scene.test, fps=scene.fps, seed=stream(scene, "motion"))
    moved = surface.true_surface(body, motion, scene.outfit, seed=stream(scene, "folds"))
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_motion(folder / "motion.npz", motion)
    offset = surface.scan_error(body, scene.outfit, seed=stream(scene, "scan"))
    write_template(folder / "template.npz", body.template(offset))
    write_template(folder / "body.npz", bare_template(scene))
    write_arrays(folder / "truth" / "template.npz", vertices=moved[:, body.kept])
    poking = penetrations(body, moved)
    write_arrays(
        folder / "truth" / "clothes.npz",
        penetrating=poking.share,
        penetration_mm=1000 * poking.deepest,
        stretch=stretch(body, moved, "skirt" if scene.outfit.skirt else "shirt"),
    )
    # The picture is made of float32 vertices, so these are the exact ones.
    stored = moved.astype(np.float32)
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
    cameras = make_cameras(scene.rig, stored.reshape(-1, 3).astype(np.float64))
    painted.result() if painted else paint(scene, folder)
    write_cameras(last, cameras)


def paint(scene: Scene, folder: Path) -> None:
    """Write the texture."""
    image = texture.paint(make_body(scene), size=scene.texture, seed=stream(scene, "texture"))
    write_image(folder / "truth" / "texture.png", image)


def _by_frame(views: list[WantedView]) -> list[list[WantedView]]:
    frames: dict[int, list[WantedView]] = {}
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


def _run(
    executor: Executor | None, scene: Scene, folder: Path, renderer: Renderer, tasks: list[list[WantedView]]
) -> Any:
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


def render_views(scene: Scene, folder: Path, renderer: Renderer, views: list[WantedView]) -> int:
    """Render the views of one frame and write them; the image last, so that its presence means that all is there."""
    studio = _studio(scene, folder, renderer)
    cameras = read_cameras(folder / "cameras.json")
    pose, during = _poses(scene, folder, views[0].frame)
    # With an open shutter the person moves once for all cameras; else every image is written as soon as it is there.
    for group in [[view] for view in views] if len(during) == 1 else [views]:
        pictures = studio.shoot(
            pose,
            [cameras[view.camera] for view in group],
            samples=scene.samples,
            seeds=[stream(scene, "pixels", view.camera, view.frame) for view in group],
            during=during,
        )
        for view, picture in zip(group, pictures, strict=True):
            _write_view(folder, view, picture)
    return len(views)


def _poses(scene: Scene, folder: Path, frame: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """The surface in a frame, and while the shutter is open around it."""
    first = 0
    for clip in scene.train + scene.test:
        if frame < first + clip.frames:
            break
        first += clip.frames
    # The curve between two frames is bent by the frames beside them.
    wanted = range(max(first, frame - 2), min(first + clip.frames, frame + 3)) if scene.rig.shutter else [frame]
    surfaces = [read_arrays(surface_path(folder, k), expected=("vertices",))["vertices"] for k in wanted]
    at = frame - wanted[0]
    return surfaces[at], shutter_poses(np.stack(surfaces), at, shutter=scene.rig.shutter)


def _write_view(folder: Path, view: WantedView, picture: Picture) -> None:
    write_arrays(
        pixels_path(folder, view.camera, view.frame),
        triangle=picture.triangle,
        barycentric=picture.barycentric.astype(np.float16),
        noise=picture.noise.astype(np.float16),
    )
    write_image(image_path(folder, view.camera, view.frame), picture.rgba)


def finish(scene: Scene, folder: Path, renderer: Renderer) -> None:
    """Hash every file and write the final manifest."""
    made_with = {
        "numpy": np.__version__,
        "python": platform.python_version(),
        "mitsuba": renderer.mitsuba,
        "variant": renderer.variant,
        "machine": platform.machine(),
    }
    motion = read_motion(folder / "motion.npz", joints=len(read_skeleton(folder / "skeleton.json").names))
    parts = splits(scene)
    novelty = pose_novelty(motion, train=parts["train"].frames, test=parts["novel_pose"].frames)
    manifest = replace(_manifest(scene), made_with=made_with, pose_novelty_deg=round(novelty, 3))
    replace(manifest, files=hash_files(folder)).write(folder)
