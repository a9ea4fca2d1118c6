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
from functools import lru_cache, partial
from multiprocessing.connection import wait as wait_for_end
from pathlib import Path
from typing import Any

import numpy as np

from ash.capture.dataset import Motion, image_path, scan_path, surface_path
from ash.capture.formats import (
    read_motion,
    read_skeleton,
    write_cameras,
    write_motion,
    write_skeleton,
    write_template,
)
from ash.capture.manifest import Manifest, hash_files, is_capture, read_manifest
from ash.capture.novelty import novelty_deg
from ash.files import InputError, write_arrays, write_image
from synth.camera.render import Renderer, probe
from synth.camera.rig import hull_of, make_cameras
from synth.cloth import surface
from synth.cloth.checks import Penetrations, penetrations, stretch
from synth.cost import require_space
from synth.motion.clips import make_motion
from synth.person import texture
from synth.person.bare import bare_template
from synth.person.body import Body
from synth.person.cast import subject
from synth.person.mannequin import mannequin
from synth.rendering import render_backgrounds, render_views
from synth.scene import Scene, stream
from synth.source_hash import code_version, source_version
from synth.views import WantedView, by_frame, is_scanned, splits, wanted_views

Progress = Callable[[int, int], None]


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
    _begin(scene, folder, renderer, alone=shard[1] == 1)
    views = wanted_views(scene)
    own = None if executor else _pool(max(1, min(workers, scene.frames)))
    try:
        describe(scene, folder, executor or own)
        share = [view for frame in by_frame(views)[shard[0] - 1 :: shard[1]] for view in frame]
        missing = missing_views(scene, folder, share)
        tasks = by_frame(missing)
        done = len(share) - len(missing)
        if progress:
            progress(done, len(share))
        for count in _run(executor or own, scene, folder, renderer, tasks):
            done += count
            if progress:
                progress(done, len(share))
        if not missing_views(scene, folder, views):
            assert executor or own
            (executor or own).submit(render_backgrounds, scene, folder, renderer).result()  # type: ignore[union-attr]
    except BaseException:
        if own:  # Files are whole or absent, so nobody needs to wait for the frames that are under way.
            for process in list((own._processes or {}).values()):
                process.terminate()
        raise
    finally:
        if own:
            own.shutdown(wait=True, cancel_futures=True)
    if not missing_views(scene, folder, views):
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


def _begin(scene: Scene, folder: Path, renderer: Renderer, *, alone: bool) -> None:
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
        require_space([(scene, folder)], folder)
        _require_same_renderer(folder, renderer)
        replace(_manifest(scene), complete=False, made_with={"variant": renderer.variant}).write(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error


def _require_same_renderer(folder: Path, renderer: Renderer) -> None:
    """A capture is drawn by one of Mitsuba's variants: their noise differs, and its manifest names one."""
    begun = read_manifest(folder).made_with.get("variant", renderer.variant) if is_capture(folder) else renderer.variant
    if begun != renderer.variant:
        raise InputError(f"{folder}: was begun with {begun}, this machine has {renderer.variant}; remove the folder")


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


def _is_made(scene: Scene, folder: Path, view: WantedView) -> bool:
    """Whether the image of a view is there, and the scan of its frame."""
    scanned = not is_scanned(scene, view.frame) or scan_path(folder, view.frame).is_file()
    return scanned and image_path(folder, view.camera, view.frame).is_file()


def missing_views(scene: Scene, folder: Path, views: list[WantedView]) -> list[WantedView]:
    """Those whose image, or whose frame's scan, is not there yet."""
    return [view for view in views if not _is_made(scene, folder, view)]


def make_body(scene: Scene) -> Body:
    """The scene's clothed body. A mannequin is built alike for every subject."""
    if scene.body == "mannequin":
        return mannequin(skirt=scene.outfit.skirt)
    from synth.person.dressing import anny_body

    return anny_body(skirt=scene.outfit.skirt, number=scene.subject)


def describe(scene: Scene, folder: Path, executor: Executor | None = None) -> None:
    """Write everything but images: motion, surface of every frame, template, cameras, texture. Kept where complete.

    The `executor` paints the texture and moves the cloth, clip by clip: no clip knows of another.
    """
    last = folder / "cameras.json"
    if last.is_file():
        return
    body = make_body(scene)
    painted = executor.submit(paint, scene, folder) if executor else None
    motion = make_motion(body.skeleton, scene.clips, fps=scene.fps, seed=stream(scene, "motion"))
    clips = [np.flatnonzero(motion.sequence == index) for index in np.unique(motion.sequence)]
    draped = list((executor.map if executor else map)(partial(drape, scene, folder, motion), clips))
    write_skeleton(folder / "skeleton.json", body.skeleton)
    write_motion(folder / "motion.npz", motion)
    offset = surface.scan_error(body, scene.outfit, seed=stream(scene, "scan"))
    write_template(folder / "template.npz", body.template(offset))
    write_template(folder / "body.npz", bare_template(scene))
    write_arrays(folder / "truth" / "template.npz", vertices=np.concatenate([clip.template for clip in draped]))
    write_arrays(
        folder / "truth" / "clothes.npz",
        penetrating=np.concatenate([clip.poking.share for clip in draped]),
        penetration_mm=1000 * np.concatenate([clip.poking.deepest for clip in draped]),
        stretch=np.concatenate([clip.stretch for clip in draped]),
    )
    rest = body.surface
    write_arrays(
        folder / "truth" / "surface.npz",
        rest=rest.vertices,
        faces=rest.faces.astype(np.int32),
        uvs=rest.uvs,
        uv_faces=rest.uv_faces.astype(np.int32),
        part=rest.part.astype(np.int32),
    )
    cameras = make_cameras(scene.rig, np.concatenate([clip.corners for clip in draped]))
    painted.result() if painted else paint(scene, folder)
    write_cameras(last, cameras)


@dataclass(frozen=True, kw_only=True, slots=True)
class Draped:
    """What is kept in memory of a clip whose surfaces are on the disk."""

    template: np.ndarray  # [t, v, 3] metres, where the template's vertices are
    poking: Penetrations
    stretch: np.ndarray  # [t], see `synth.cloth.checks.stretch`
    corners: np.ndarray  # [c, 3] metres, of the hull of all that is seen


def drape(scene: Scene, folder: Path, motion: Motion, clip: np.ndarray) -> Draped:
    """Write the surface of every frame of a clip, given the clip's frames in the whole motion, and measure it."""
    body, part = _body(scene), replace(motion, dofs=motion.dofs[clip], sequence=motion.sequence[clip])
    moved = surface.true_surface(body, part, scene.outfit, seed=stream(scene, "folds"))
    corners = []
    for frame, vertices in zip(clip, moved, strict=True):
        # The picture is made of float32 vertices, so these are the exact ones.
        stored = vertices.astype(np.float32)
        write_arrays(surface_path(folder, int(frame)), vertices=stored)
        corners.append(hull_of(stored.astype(np.float64)))
    return Draped(
        template=moved[:, body.template_to_surface],
        poking=penetrations(body, moved),
        stretch=stretch(body, moved, "skirt" if scene.outfit.skirt else "shirt"),
        corners=hull_of(np.concatenate(corners)),
    )


@lru_cache(maxsize=1)
def _body(scene: Scene) -> Body:
    return make_body(scene)


def paint(scene: Scene, folder: Path) -> None:
    """Write the texture."""
    seed, person = stream(scene, "texture"), subject(scene.subject)
    person = person.loose if scene.outfit.skirt else person
    image = texture.paint(_body(scene), size=scene.texture, seed=seed, subject=person)
    write_image(folder / "truth" / "texture.png", image)


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
    novelty = np.mean(novelty_deg(motion, train=parts["train"].frames, test=parts["novel_pose"].frames))
    manifest = replace(_manifest(scene), made_with=made_with, pose_novelty_deg=round(float(novelty), 3))
    replace(manifest, files=hash_files(folder)).write(folder)
