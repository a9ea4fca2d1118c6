"""Commands that show a trained avatar, or write it or a capture for other programs: play, export."""

import contextlib
import sys
import threading
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from ash.capture.dataset import Pose
from ash.files import InputError, write_atomic
from benchmarks.commands.arguments import DONE, Argument, Count, File, Names, Natural, Positional, Repeated
from benchmarks.commands.devices import CPU, DeviceName, chosen_device

if TYPE_CHECKING:
    from benchmarks.play.avatars import AvatarSet
    from benchmarks.play.motions import MotionClip

Stretch = Annotated[str | None, Argument(metavar="A:B")]


@dataclass(frozen=True, kw_only=True)
class PlayCommand:
    """Play a run's avatars in the browser, beside the truth."""

    run: Positional[Path]  # a run's folder or a cell's
    motion: Repeated[tuple[str, ...]] = ()  # besides the capture's: walk, dance, a BVH or AMASS file; repeatable
    methods: Names = ()  # only these; default: all of the run
    scene: str | None = None  # of a run with several; default: its first
    device: DeviceName = CPU  # where avatars draw that have a choice: cpu, cuda, cuda:1, or auto
    host: str = "127.0.0.1"  # address to listen on
    port: Natural = 0  # default: a free one
    clients: Count = 8  # browsers at a time
    allow_origin: Repeated[tuple[str, ...]] = ()  # where a forwarded port is seen: http://localhost:9000
    trust: bool = False  # load methods that are not ours too: their code runs here, without isolation
    expose: bool = False  # let --host be open to other machines; nothing is encrypted

    def __call__(self) -> int:
        """Serve until Ctrl-C."""
        from benchmarks.play.auth import AuthOptions, require_safe
        from benchmarks.play.player import playing

        options = AuthOptions(
            host=self.host,
            port=self.port,
            clients=self.clients,
            allow_origins=self.allow_origin,
            expose=self.expose,
        )
        require_safe(options)
        with playing(
            self.run,
            motions=self.motion,
            scene=self.scene,
            methods=self.methods,
            options=options,
            device=chosen_device(self.device),
            trust=self.trust,
        ) as player:
            print(f"{player.url}\nopen this address in a browser; Ctrl-C ends the player", flush=True)
            if self.expose:
                print(f"{self.host} is open to other machines, and nothing is encrypted", file=sys.stderr)
            with contextlib.suppress(KeyboardInterrupt):  # How it is meant to end.
                threading.Event().wait()
        return DONE


@dataclass(frozen=True, kw_only=True)
class ExportCommand:
    """Write a capture or a trained avatar for other programs.

    Captures: ash (the release's files), nerfstudio, colmap, plain (images, cameras and poses of the training part),
    test-views (what is scored: cameras and poses, no images), undistorted (a capture of pinhole cameras).

    Avatars: ply, spz, gltf (one frame, or several in a folder; ends with .glb or .gltf), bvh (the skeleton in motion),
    mp4 (or .webp: a video, avatars and truth side by side), html (one page that plays a clip without a server).
    """

    source: Positional[Path]  # the folder of a capture, a cell or a run
    form: Annotated[str, Argument(name="format", metavar="FORMAT")]  # one of those above
    out: File | None = None  # default: SOURCE-FORMAT beside a capture, SOURCE.SUFFIX here of an avatar
    split: str | None = None  # nerfstudio, colmap: train (default), novel_view, near_pose, novel_pose or far_pose
    frame: int | None = None  # nerfstudio, colmap: only this frame of the split
    motion: str = "test"  # avatars: test, train, walk, dance and so on, or a BVH or AMASS file
    frames: Stretch = None  # avatars: of the motion, B not included; default: all, of ply, spz and gltf the first
    methods: Names = ()  # avatars: only these of a run
    scene: str | None = None  # avatars: of a run with several; default: its first
    trust: bool = False  # avatars: load methods that are not ours too: their code runs here, without isolation
    camera: str = "spiral"  # mp4: spiral, rig, or a camera of the capture
    truth: bool = False  # mp4: the truth beside them; rendered where it never was
    height: Count = 256  # mp4: of a picture, pixels
    fps: Count | None = None  # mp4: frames per second; default: the motion's

    def __call__(self) -> int:
        """Write it."""
        from ash.capture.manifest import is_capture
        from benchmarks.aliases import OLD_FORMATS
        from benchmarks.export.formats import FORMATS as OF_AVATARS
        from benchmarks.export.formats import suffix_of
        from synth.export.formats import FORMATS as OF_CAPTURES

        capture = is_capture(self.source)
        if not capture and not any((self.source / name).exists() for name in ("run.json", "config.json", "cells")):
            raise InputError(f"{self.source}: expected the folder of a capture, a run or a cell")
        if not capture and self.form in OLD_FORMATS:
            return replace(self, form=OLD_FORMATS[self.form])()
        allowed, kind = (OF_CAPTURES, "a capture") if capture else (OF_AVATARS, "a trained avatar")
        if self.form not in allowed:
            expected = f"expected one of {', '.join(allowed)} for {kind}"
            raise InputError(f"format: {expected} ({self.source}), got {self.form!r}")
        self._require_options_of_format()
        if capture:
            return self._export_capture(self.out or self.source.with_name(f"{self.source.name}-{self.form}"))
        return self._export_avatar(suffix_of(self.form, self.out or Path()))

    def _require_options_of_format(self) -> None:
        """An option that the format does not know is refused, and not ignored."""
        from benchmarks.export.formats import FORMATS as OF_AVATARS

        avatars, video = tuple(OF_AVATARS), ("mp4",)
        formats: dict[str, tuple[str, ...]] = dict.fromkeys(("split", "frame"), ("nerfstudio", "colmap"))
        formats |= dict.fromkeys(("motion", "frames", "methods", "scene", "trust"), avatars)
        formats |= dict.fromkeys(("camera", "truth", "height", "fps"), video)
        for option in fields(self):
            forms = formats.get(option.name, (self.form,))
            if self.form not in forms and getattr(self, option.name) != option.default:
                raise InputError(f"--{option.name}: goes with the format {', '.join(forms)}, got {self.form}")

    def _export_capture(self, folder: Path) -> int:
        from ash.capture.formats import load_capture
        from benchmarks.cell.evaluation import evaluated_views
        from synth.export.formats import export

        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: expected an empty folder")
        capture = load_capture(self.source)
        views = [(view.split, view.camera, view.frame) for view in evaluated_views(capture)]
        print(export(capture, folder, form=self.form, split=self.split, frame=self.frame, views=views))
        if (folder / "ABOUT.txt").exists():
            print((folder / "ABOUT.txt").read_text(), end="", file=sys.stderr)
        return DONE

    def _export_avatar(self, suffix: str) -> int:
        from benchmarks.export.formats import FRAMES
        from benchmarks.play.avatars import open_avatars
        from benchmarks.play.motions import frames_in, motion_clip

        with open_avatars(self.source, scene=self.scene, methods=self.methods, trust=self.trust) as avatars:
            clip = motion_clip(avatars.capture, self.motion)
            frames = frames_in(clip, self.frames or ("0" if self.form in FRAMES else None))
            out = self.out or Path(self.source.resolve().name)
            if self.form in FRAMES and len(frames) > 1:
                out = out if self.out else Path(f"{out}-{self.form}")
                if out.suffix:
                    raise InputError(f"{out}: expected a folder for {len(frames)} frames, got a name with a suffix")
                for frame in frames:  # Named by its number in the capture or in the motion's file.
                    self._write(avatars, clip, (frame,), out / f"{frame:06d}{suffix}")
                print(f"{out}: {len(frames)} files")
                return DONE
            out = out if out.suffix else out.with_name(f"{out.name}{suffix}")
            self._write(avatars, clip, frames, out)
        print(f"{out}: {len(frames)} frame{'s' if len(frames) > 1 else ''}, {out.stat().st_size / 1e6:.1f} MB")
        return DONE

    def _write(self, avatars: "AvatarSet", clip: "MotionClip", frames: tuple[int, ...], out: Path) -> None:
        """One file; of the formats of one frame it shows the first."""
        from benchmarks.export.bvh import bvh_bytes
        from benchmarks.export.formats import frame_bytes
        from benchmarks.play.share import shared_page
        from benchmarks.play.video import VideoSpec, render_video, write_video

        if self.form == "mp4":
            spec = VideoSpec(clip=clip, frames=frames, camera=self.camera, height=self.height, truth=self.truth)
            pictures = render_video(avatars, spec, lambda text: print(text, file=sys.stderr))
            write_video(out, pictures, fps=float(self.fps or clip.motion.fps))
            return
        if self.form == "bvh":
            motion, chosen = clip.motion, list(frames)
            played = replace(motion, dofs=motion.dofs[chosen], sequence=motion.sequence[chosen])
            content = bvh_bytes(avatars.capture.skeleton, played)
        elif self.form == "html":
            content = shared_page(avatars.only(), clip, frames)
        else:
            loaded = avatars.only()
            pose = Pose(clip.motion, frames[0])
            content = frame_bytes(loaded.avatar, pose, suffix=out.suffix, title=loaded.title)
        write_atomic(out, content)
