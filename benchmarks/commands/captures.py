"""Commands that make and check captures: synth, import, verify (of packs too), motions."""

import contextlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ash.fields import Changes
from ash.files import InputError
from benchmarks.commands.arguments import (
    DONE,
    FAILED,
    WRONG_INPUT,
    Argument,
    Count,
    File,
    Folder,
    Names,
    Positional,
    Repeated,
    Seed,
    refuse_all,
)
from benchmarks.problems import Problems

if TYPE_CHECKING:
    from synth.scene import Scene, Take


@dataclass(frozen=True, kw_only=True)
class Excerpt:
    """Which part of a motion file is taken, and how the file is read."""

    up: str = "auto"  # what is up in the file: auto, x, y, z, -x, -y, -z
    start: float = 0.0  # leave out the file's first seconds
    length: float | None = None  # take so many seconds of the file
    stride: Count = 1  # take every N-th frame: N times as fast
    joint_map: File | None = None  # JSON: our joints' names in the BVH file
    motion_fps: float | None = None  # frames per second of the file, where it has no rate or a wrong one
    rest_frame: int | None = None  # BVH: the frame in which the person stands straight, if the rest pose is none

    @property
    def take(self) -> "Take":
        """The same as part of a scene."""
        from synth.motion.importing import read_joint_map
        from synth.scene import Take

        joints = read_joint_map(self.joint_map) if self.joint_map else ()
        return Take(
            up=self.up,
            start=self.start,
            length=self.length,
            stride=self.stride,
            joints=joints,
            fps=self.motion_fps,
            rest_frame=self.rest_frame,
        )


@dataclass(frozen=True, kw_only=True)
class SynthCommand:
    """Render the ground truth of a scene into a capture folder.

    Every field of the scene is a flag (--rig.cameras 44 --outfit.swing 0.8); `synth SCENE --help` lists them.

    A motion file replaces the scene's own training (or test) motion: BVH, or AMASS-style .npz with poses, trans and
    mocap_framerate. It is retargeted to our skeleton, its path centred on the origin, its first frames at the scene's
    rate taken. A rig file is a cameras.json as captures have it, or the bare list of its cameras: name, width, height,
    K, viewmat, and k1 k2 p1 p2 as "distortion" where a lens has one; metres, y up, and the cameras must see the origin.
    """

    scene: Positional[str]  # its name
    size: str = "quick"  # of the capture: ci, factor, quick, long, table or paper
    out: Folder | None = None  # default: data/SCENE-SIZE-SEED
    seed: Seed = 0  # root seed of the scene
    subject: Seed = 0  # who it is: body, skin, hair, clothes and prints follow from the number
    motion: File | None = None  # train on this motion (BVH or AMASS .npz)
    test_motion: File | None = None  # test on this motion
    excerpt: Excerpt = Excerpt()
    rig_file: Annotated[Path | None, Argument(name="rig", metavar="FILE")] = None  # see the scene by its cameras
    workers: Count | None = None  # processes; default: all cores
    executor: str = "local"  # or dask://HOST:PORT, for a cluster
    shard: Annotated[str | None, Argument(metavar="i/n")] = None  # every n-th frame only, from the i-th; for job arrays

    changes: Changes = ()  # of the scene

    def settings(self) -> "Scene":
        """The scene, before flags change it."""
        from benchmarks.suites.scenes import scene_of
        from synth.presets import with_rig

        plain = scene_of(self.scene, size=self.size, seed=self.seed, subject=self.subject)
        return plain if self.rig_file is None else with_rig(plain, self.rig_file)

    def __call__(self) -> int:
        """Render what is missing of it."""
        from ash.capture.manifest import read_manifest
        from benchmarks.provenance import cores
        from benchmarks.suites.engine import make_executor, read_shard
        from benchmarks.suites.scenes import draw_scene

        scene, name = self._described()
        folder = self.out or Path("data") / name
        workers, shard, local = self.workers or cores(), read_shard(self.shard or "1/1"), self.executor == "local"
        with contextlib.nullcontext() if local else make_executor(self.executor, workers=workers) as executor:
            draw_scene(self.scene, scene, folder, title=name, workers=workers, executor=executor, shard=shard)
        if not read_manifest(folder).complete:
            message = "this shard is done; the capture is finished by the shard that comes last"
            print(f"{folder}: {message}", file=sys.stderr)
        print(folder)
        return DONE

    def _described(self) -> tuple["Scene", str]:
        """The scene that is asked for, and its name among captures."""
        from ash.fields import apply_overrides
        from benchmarks.suites.scenes import scene_of
        from benchmarks.suites.suites import capture_name, varied_name

        changes = dict(self.changes)
        scene = apply_overrides(self.settings(), changes, of=self.scene)
        if changes and "name" not in changes:
            scene = replace(scene, name=varied_name(self.scene, tuple(changes.items())))
        scene = self._moved(scene)
        name = capture_name(self.scene, self.size, self.seed, self.subject)
        plain = scene == scene_of(self.scene, size=self.size, seed=self.seed, subject=self.subject)
        return scene, name if plain else f"{name}-{scene.identity[:8]}"

    def _moved(self, scene: "Scene") -> "Scene":
        """The scene driven by the user's motions, if there are any."""
        if self.motion is None and self.test_motion is None:
            return scene
        from ash.capture.novelty import novelty_deg
        from synth.capture import make_body
        from synth.motion.clips import make_motion
        from synth.motion.importing import read_motion_file
        from synth.motion.strip import describe
        from synth.presets import with_motion

        skeleton = make_body(scene).skeleton
        for path, clips in ((self.motion, scene.train), (self.test_motion, scene.test)):
            if path is not None:
                most = sum(clip.frames for clip in clips)
                read = read_motion_file(path, skeleton, fps=scene.fps, most=most, take=self.excerpt.take)
                print(describe(read), file=sys.stderr)
        moved = with_motion(scene, skeleton, train=self.motion, test=self.test_motion, take=self.excerpt.take)
        motion = make_motion(skeleton, moved.clips, fps=moved.fps, seed=0)
        count = sum(clip.frames for clip in moved.train)
        each = novelty_deg(motion, train=range(count), test=range(count, len(motion.dofs)))
        far = sum(each) / len(each)
        print(f"test poses lie {far:.1f} degrees from the nearest training pose (mean over joints)", file=sys.stderr)
        return moved


@dataclass(frozen=True, kw_only=True)
class ImportCommand:
    """Make a capture without truth from footage: images, masks, cameras, skeleton, motion and a skinned template.

    docs/import.md says which files lie where. What does not fit is named, a line each, and then no capture is made. The
    posed template is compared with the masks of every camera. Metrics that need truth are n/a on such a capture.
    """

    footage: Positional[Path]  # the folder
    out: Folder  # of the capture, new or empty
    name: str = ""  # of the scene in tables; default: the name of --out
    subject: Seed = 0  # who it is; captures of one --name and several subjects are people of one scene
    cameras: File | None = None  # our cameras.json, nerfstudio's, 3DGS's or COLMAP's cameras.txt; default: FOOTAGE's
    test_cameras: Names = ()  # held out; default: a quarter, 1 to 8
    test_frames: Annotated[str | None, Argument(metavar="A:B")] = None  # B not included; default: the last sequence
    least_iou: float = 0.3  # of the template and the masks of each camera; below, nothing is made

    def __call__(self) -> int:
        """Check the whole, then write it."""
        from benchmarks.importing.footage import import_footage
        from benchmarks.importing.overlap import overlap_table

        try:
            capture, overlaps = import_footage(
                self.footage,
                self.out,
                name=self.name,
                subject=self.subject,
                cameras=self.cameras,
                test_cameras=self.test_cameras,
                test_frames=_first_and_last(self.test_frames),
                least_iou=self.least_iou,
            )
        except Problems as problems:
            return refuse_all(problems)
        print(overlap_table(overlaps))
        for name, split in capture.splits.items():
            print(f"{name}: {len(split.cameras)} cameras, {len(split.frames)} frames, {split.count} images")
        print(f"{self.out}: {len(capture.manifest.files)} files with their hashes; no truth")
        return DONE


def _first_and_last(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    first, _, last = text.partition(":")
    if not (first.isdecimal() and last.isdecimal()):
        raise InputError(f"--test-frames: expected A:B, two frame numbers, got {text!r}")
    return int(first), int(last)


@dataclass(frozen=True, kw_only=True)
class VerifyCommand:
    """Hash every file of a capture again; of a pack, hash its files and score its pictures again.

    Exit code 1: a score of a pack differs, or could not be checked because its capture is not at hand.
    """

    source: Positional[Path]  # a capture's folder, or a pack
    capture: Repeated[tuple[Path, ...]] = ()  # of a pack: a capture to score on; may be repeated; default: data/NAME

    def __call__(self) -> int:
        """Name every problem."""
        from ash.capture.manifest import read_manifest, verify_capture

        if not self.source.is_dir():
            return self._pack()
        if self.capture:
            raise InputError("--capture: goes with a pack, expected a file")
        manifest = read_manifest(self.source)
        problems = verify_capture(self.source)
        if not manifest.complete:
            problems.append("the capture is unfinished")
        for problem in problems:
            print(f"{self.source}: {problem}", file=sys.stderr)
        if problems:
            return WRONG_INPUT
        print(f"{self.source}: {len(manifest.files)} files, all as the manifest says")
        return DONE

    def _pack(self) -> int:
        from ash.capture.manifest import read_manifest
        from ash.files import one_line
        from benchmarks.cell.metrics import PROTOCOL
        from benchmarks.suites.archive import unpacked
        from benchmarks.suites.verification import TRUST, verify_pack

        for folder in self.capture:
            read_manifest(folder)
        with unpacked(self.source) as folder:
            checks, files = verify_pack(folder, self.capture)
        print(f"{self.source}: {files} files, names, sizes and SHA-256 as pack.json says, protocol {PROTOCOL}")
        for check in checks:
            print(one_line(f"{check.cell.config.title}: {check.text}"))
        print("\n".join(TRUST))
        return FAILED if {check.kind for check in checks} & {"differs", "unchecked"} else DONE


@dataclass(frozen=True, kw_only=True)
class MotionsCommand:
    """Draw what a motion file becomes on our skeleton, in seconds: nothing is rendered."""

    file: Positional[Path]  # BVH or AMASS .npz
    out: Annotated[Path | None, Argument(metavar="PNG")] = None  # default: FILE's name with .png, here
    fps: float = 12.0  # frames per second
    excerpt: Excerpt = Excerpt()

    def __call__(self) -> int:
        """Draw it, and refuse a person who stands on the head."""
        from synth.motion.importing import read_motion_file, require_upright
        from synth.motion.strip import describe, draw_strip, write_strip
        from synth.person.mannequin import heads
        from synth.skeleton import make_skeleton

        skeleton = make_skeleton(heads())
        imported = read_motion_file(self.file, skeleton, fps=self.fps, take=self.excerpt.take)
        out = self.out or Path(f"{self.file.stem}.png")
        write_strip(out, draw_strip(skeleton, imported.motion))
        print(describe(imported), file=sys.stderr)
        print(out)
        require_upright(imported)
        return DONE
