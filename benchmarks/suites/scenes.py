"""Every scene by its name, those of the generator and `splats`, and how each becomes a capture."""

from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import numpy as np

from ash.fields import Changes, apply_overrides, suggest
from ash.files import InputError
from benchmarks.cell.registry import current_fields
from benchmarks.suites.progress import Progress
from synth.camera.rig import held_out, place
from synth.presets import SCENES, scene, skinned
from synth.scene import Rig, Scene

ONE_SIDED = 200.0  # degrees
SPLATS = "splats"  # The first factor scene, drawn by `benchmarks.suites.splats`.


def scene_names() -> tuple[str, ...]:
    """All scenes that there are."""
    return (*SCENES, SPLATS)


def scene_of(of: str, *, size: str, seed: int = 0, subject: int = 0, name: str = "", changes: Changes = ()) -> Scene:
    """A scene by name, with changed fields; `name` is what it is called then.

    Raises:
        InputError: no such scene, size or field, or a value that the scene refuses.
    """
    if of not in scene_names():
        raise InputError(f"unknown scene {of!r}, {suggest(of, scene_names())}")
    if of == SPLATS:  # The poses and cameras of `skinned`; what it looks like is the splatter's.
        plain = replace(skinned(size=size, seed=seed), body="mannequin")
    else:
        plain = scene(of, size=size, seed=seed)
    plain = replace(plain, subject=subject, name=name or of)
    return apply_overrides(plain, current_fields(plain, changes), of=of)


def identity_of(of: str, wanted: Scene) -> str:
    """What the manifest of a capture of the scene says it is."""
    if of == SPLATS:
        from benchmarks.suites import splats

        return splats.identity(wanted)
    return wanted.identity


def one_sided(rig: Rig) -> str:
    """What is said where the test cameras of a dome leave more than `ONE_SIDED` degrees around the person unseen."""
    if rig.kind != "dome" or rig.held_out < 3:
        return ""
    cameras = place(rig)[held_out(rig)]
    azimuths = np.sort(np.degrees(np.arctan2(cameras[:, 0], cameras[:, 2])))
    gap = np.diff(azimuths, append=azimuths[0] + 360).max()
    if gap < ONE_SIDED:
        return ""
    return f"no test camera in {gap:.0f} of 360 degrees around the person; 24 cameras with 4 held out see all sides"


def draw_scene(
    of: str,
    wanted: Scene,
    folder: Path,
    *,
    title: str,
    workers: int,
    executor: Executor | None = None,
    shard: tuple[int, int] = (1, 1),
) -> None:
    """Render into `folder` what is missing of the capture of a scene that is a variant of `of`.

    `executor`, `shard`: as of `synth.capture.make_capture`.

    Raises:
        InputError: processes that render were killed from outside, in each of two attempts.
    """
    if of == SPLATS:
        from benchmarks.suites import splats

        splats.draw_capture(wanted, folder)
        return
    from synth.capture import make_capture as render
    from synth.cost import estimate

    progress = Progress(f"images of {title}", 0, expected_s=0.0, workers=workers)
    if not (folder / "cameras.json").exists():  # Written last before the images.
        cost = estimate(wanted).text
        progress.say(f"{title}: {cost}; first body, motion, clothes and texture (up to two minutes)")
        if note := one_sided(wanted.rig):
            progress.say(f"{title}: {note}")
    for attempt in (1, 2):  # The kernel kills when memory runs out; what was drawn is kept.
        try:
            render(wanted, folder, workers=workers, progress=progress.advance, executor=executor, shard=shard)
            break
        except BrokenProcessPool:
            if attempt == 2:
                raise InputError(
                    f"{folder}: processes that render were killed from outside in each of 2 attempts; the kernel does"
                    " that when memory runs out, and fewer --workers need less"
                ) from None
            progress.say(f"{title}: a process that renders was killed from outside, tried again")
    progress.close()
