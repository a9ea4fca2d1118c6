"""The verbs of the door that make, check and convert captures: synth, verify, undistort, export, sheets."""

import argparse
import contextlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ash.files import InputError

MOTION_NOTE = """\
a motion file replaces the scene's own training (or test) motion: BVH, or AMASS-style .npz with poses, trans and
mocap_framerate. It is retargeted to our skeleton, its path centred on the origin, its first frames at the scene's rate
taken. A rig file is a cameras.json as captures have it: name, width, height, K, viewmat, and k1 k2 p1 p2 as
"distortion" where a lens has one; metres, y up, and the cameras must see the origin."""


Reader = Callable[[str], int]


def add_verbs(add: Callable[..., argparse.ArgumentParser], *, natural: Reader, positive: Reader) -> None:
    """Add the verbs to the door's parser; `add(function, name, about)` makes one, the readers check whole numbers."""
    verb = add(synth, "synth", "render the ground truth of a scene into a capture folder")
    verb.formatter_class = argparse.RawDescriptionHelpFormatter
    verb.epilog = MOTION_NOTE
    verb.add_argument("scene", metavar="SCENE")
    verb.add_argument("--size", default="quick", help="size of the capture (default: %(default)s)")
    verb.add_argument("--out", type=Path, metavar="DIR", help="default: data/SCENE-SIZE-SEED")
    verb.add_argument("--seed", type=natural, default=0, help="root seed of the scene (default: %(default)s)")
    verb.add_argument("--motion", type=Path, metavar="FILE", help="train on this motion (BVH or AMASS .npz)")
    verb.add_argument("--test-motion", type=Path, metavar="FILE", help="test on this motion")
    verb.add_argument("--rig", type=Path, metavar="FILE", help="see the scene by the cameras of this cameras.json")
    verb.add_argument("--shutter", type=float, default=0.0, metavar="SHARE", help="open for this share of a frame")
    verb.add_argument("--workers", type=positive, metavar="N", help="processes (default: all cores)")
    verb.add_argument("--executor", default="local", help="local (default), or dask://HOST:PORT for a cluster")
    verb.add_argument("--shard", metavar="i/n", help="render only every n-th frame, from the i-th; for job arrays")
    verb = add(verify, "verify", "hash every file of a capture again")
    verb.add_argument("folder", type=Path, metavar="DIR")
    verb = add(undistort, "undistort", "resample a capture whose lenses distort for pinhole cameras")
    verb.add_argument("folder", type=Path, metavar="DIR")
    verb.add_argument("--out", type=Path, metavar="DIR", required=True)
    verb = add(export, "export", "write a capture in another format: ash (the release's), nerfstudio, colmap, glb")
    verb.add_argument("folder", type=Path, metavar="DIR")
    verb.add_argument("--format", required=True, metavar="FORMAT", dest="form")
    verb.add_argument("--out", type=Path, metavar="DIR", help="default: DIR-FORMAT")
    verb = add(sheets, "sheets", "draw a contact sheet of all scenes and a turntable")
    verb.add_argument("--out", type=Path, metavar="DIR", default=Path("reports/scenes"), help="default: %(default)s")
    verb.add_argument("--scene", action="append", metavar="SCENE", help="only this scene (may be repeated)")


def synth(arguments: argparse.Namespace) -> int:
    """Render a capture."""
    from benchmarks.engine import make_executor
    from benchmarks.progress import Progress
    from benchmarks.provenance import cores
    from synth.capture import is_finished, make_capture
    from synth.presets import estimate

    scene, name = _scene(arguments)
    folder = arguments.out or Path("data") / name
    workers = arguments.workers or cores()
    progress = Progress(f"images of {name}", 0, expected_s=0.0, workers=workers)
    if not is_finished(scene, folder):
        progress.say(f"{name}: {estimate(scene).text}; first body, motion, clothes and texture (up to two minutes)")
    local = arguments.executor == "local"
    with contextlib.nullcontext() if local else make_executor(arguments.executor, workers=workers) as executor:
        make_capture(
            scene, folder, workers=workers, progress=progress.advance, executor=executor, shard=_shard(arguments.shard)
        )
    progress.close()
    if not is_finished(scene, folder):
        print(f"{folder}: this shard is done; the capture is finished by the shard that comes last", file=sys.stderr)
    print(folder)
    return 0


def _scene(arguments: argparse.Namespace) -> tuple[Any, str]:
    """The scene that is asked for, and its name among captures."""
    from dataclasses import replace

    from synth.capture import make_body
    from synth.motion import make_motion, pose_novelty
    from synth.presets import scene, with_motion, with_rig

    wanted = plain = scene(arguments.scene, size=arguments.size, seed=arguments.seed)
    if arguments.rig:
        wanted = with_rig(wanted, arguments.rig)
    wanted = replace(wanted, rig=replace(wanted.rig, shutter=arguments.shutter))
    if arguments.motion or arguments.test_motion:
        skeleton = make_body(wanted).skeleton
        wanted = with_motion(wanted, skeleton, train=arguments.motion, test=arguments.test_motion)
        motion = make_motion(skeleton, wanted.train + wanted.test, fps=wanted.fps, seed=0)
        count = sum(clip.frames for clip in wanted.train)
        novelty = pose_novelty(motion, train=tuple(range(count)), test=tuple(range(count, len(motion.dofs))))
        print(f"test poses lie {novelty:.1f} degrees from the nearest training pose (rms over joints)", file=sys.stderr)
    name = f"{arguments.scene}-{arguments.size}-{arguments.seed}"
    return wanted, name if wanted == plain else f"{name}-{wanted.identity[:8]}"


def _shard(text: str | None) -> tuple[int, int]:
    from benchmarks.engine import shard_of

    if text is None:
        return 1, 1
    shard_of([], text)
    index, count = (int(part) for part in text.split("/"))
    return index, count


def verify(arguments: argparse.Namespace) -> int:
    """Hash every file of a capture again."""
    from ash.dataset import read_manifest, verify_capture

    manifest = read_manifest(arguments.folder)
    problems = verify_capture(arguments.folder)
    if not manifest["complete"]:
        problems.append("the capture is unfinished")
    for problem in problems:
        print(f"{arguments.folder}: {problem}", file=sys.stderr)
    if problems:
        return 2
    print(f"{arguments.folder}: {len(manifest['files'])} files, all as the manifest says")
    return 0


def undistort(arguments: argparse.Namespace) -> int:
    """Resample a capture for pinhole cameras."""
    from synth.undistorting import undistort as resample

    print(resample(arguments.folder, arguments.out))
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write a capture in another format."""
    from ash.dataset import load_capture
    from synth.export import export as write

    folder = arguments.out or arguments.folder.with_name(f"{arguments.folder.name}-{arguments.form}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected an empty folder")
    print(write(load_capture(arguments.folder), folder, form=arguments.form))
    return 0


def sheets(arguments: argparse.Namespace) -> int:
    """Draw contact sheets."""
    from synth.sheets import SHOWN, draw_sheets

    for path in draw_sheets(arguments.out, tuple(arguments.scene or SHOWN)):
        print(path)
    return 0
