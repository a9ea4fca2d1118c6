"""Commands that show a trained avatar or take it along: play, video, export-avatar, share."""

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ash.capture.dataset import Pose
from ash.files import InputError, write_atomic
from benchmarks.commands.arguments import DONE, Count, CountIfAny, File, Names, Natural, Trust
from benchmarks.commands.devices import CPU, DeviceName, chosen_device

Stretch = Annotated[str | None, arg(metavar="A:B")]


@dataclass(frozen=True, kw_only=True)
class PlayCommand:
    """Play a run's avatars in the browser, beside the truth."""

    run: Positional[Path]  # a run's folder or a cell's
    motion: UseAppendAction[tuple[str, ...]] = ()  # besides the capture's: walk, dance, a BVH or AMASS file; repeatable
    methods: Names = ()  # only these; default: all of the run
    scene: str | None = None  # of a run with several; default: its first
    device: DeviceName = CPU  # where avatars draw that have a choice: cpu, cuda, cuda:1, or auto
    host: str = "127.0.0.1"  # address to listen on
    port: Natural = 0  # default: a free one
    clients: Count = 8  # browsers at a time
    allow_origin: UseAppendAction[tuple[str, ...]] = ()  # where a forwarded port is seen: http://localhost:9000
    trust: Trust = False  # load methods that are not ours too: their code runs here, without isolation
    expose: FlagCreatePairsOff[bool] = False  # let --host be open to other machines; nothing is encrypted

    def __call__(self) -> int:
        """Serve until Ctrl-C."""
        from benchmarks.play.doors import DoorOptions, require_safe
        from benchmarks.play.player import playing, wait_for_interrupt

        doors = DoorOptions(
            host=self.host,
            port=self.port,
            clients=self.clients,
            allow_origins=self.allow_origin,
            expose=self.expose,
        )
        require_safe(doors)
        with playing(
            self.run,
            motions=self.motion,
            scene=self.scene,
            methods=self.methods,
            doors=doors,
            device=chosen_device(self.device),
            trust=self.trust,
        ) as player:
            print(f"{player.url}\nopen this address in a browser; Ctrl-C ends the player", flush=True)
            if self.expose:
                print(f"{self.host} is open to other machines, and nothing is encrypted", file=sys.stderr)
            with contextlib.suppress(KeyboardInterrupt):  # How it is meant to end.
                wait_for_interrupt()
        return DONE


@dataclass(frozen=True, kw_only=True)
class VideoCommand:
    """Film a run's avatars: a motion from a camera, a spiral or a rig, beside the truth."""

    run: Positional[Path]  # a run's folder or a cell's
    out: File  # ends with .mp4 or .webp
    motion: str = "test"  # test, train, walk, dance and so on, or a BVH or AMASS file
    frames: Stretch = None  # of the motion, from 0, B not included; default: all
    camera: str = "spiral"  # spiral, rig, or a camera of the capture
    methods: Names = ()  # only these; default: all of the run
    scene: str | None = None  # of a run with several; default: its first
    truth: FlagCreatePairsOff[bool] = False  # the truth beside them; rendered where it never was
    height: Count = 256  # of a picture, pixels
    fps: CountIfAny = None  # frames per second; default: the motion's
    trust: Trust = False  # load methods that are not ours too: their code runs here, without isolation

    def __call__(self) -> int:
        """Film it."""
        from benchmarks.play.actors import open_cast
        from benchmarks.play.film import Script, cameras_of, shoot, write_film
        from benchmarks.play.motions import act_named, frames_in

        if self.out.suffix not in (".mp4", ".webp"):
            raise InputError(f"{self.out}: expected a film that ends with .mp4 or .webp")
        with open_cast(self.run, scene=self.scene, methods=self.methods, trust=self.trust) as cast:
            act = act_named(cast.capture, self.motion)
            rate = float(self.fps or act.motion.fps)
            script = Script(
                act=act,
                frames=frames_in(act, self.frames),
                camera=self.camera,
                height=self.height,
                fps=rate,
                truth=self.truth,
            )
            cameras_of(cast.capture, script, 0)  # An unknown camera is refused before avatars are loaded.
            shot = write_film(self.out, shoot(cast, script, lambda text: print(text, file=sys.stderr)), fps=rate)
        print(f"{self.out}: {shot} frames, {self.out.stat().st_size / 1e6:.1f} MB")
        return DONE


@dataclass(frozen=True, kw_only=True)
class ExportAvatarCommand:
    """Write an avatar's Gaussians, mesh or skeleton for other programs."""

    cell: Positional[Path]  # a cell's folder, or a run's with one avatar
    form: Annotated[str, arg(name="format", metavar="F")]  # ply, splat, spz, gltf, glb or bvh
    out: File  # a folder, where --frames means several
    motion: str = "test"  # test, train, walk, dance and so on, or a BVH or AMASS file
    frames: Stretch = None  # of the motion, from 0, B not included; default: 0, of a skeleton all
    trust: Trust = False  # load methods that are not ours too: their code runs here, without isolation

    def __call__(self) -> int:
        """Write one frame into a file, or several into a folder; of a skeleton, the motion."""
        from dataclasses import replace

        from benchmarks.export.bvh import bvh_bytes
        from benchmarks.export.formats import SKELETON, frame_bytes, suffix_of
        from benchmarks.play.actors import open_cast
        from benchmarks.play.motions import act_named, frames_in

        suffix = suffix_of(self.form)
        with open_cast(self.cell, trust=self.trust) as cast:
            actor, act = cast.only(), act_named(cast.capture, self.motion)
            if self.form == SKELETON:
                chosen = list(frames_in(act, self.frames))
                played = replace(act.motion, dofs=act.motion.dofs[chosen], sequence=act.motion.sequence[chosen])
                write_atomic(self.out, bvh_bytes(cast.capture.skeleton, played))
                print(self.out)
                return DONE
            chosen = list(frames_in(act, self.frames or "0"))
            for index, frame in enumerate(chosen):
                path = self.out if len(chosen) == 1 else self.out / f"{index:06d}{suffix}"
                write_atomic(
                    path, frame_bytes(actor.avatar, Pose(act.motion, frame), form=self.form, title=actor.title)
                )
        print(self.out)
        return DONE


@dataclass(frozen=True, kw_only=True)
class ShareCommand:
    """Write one page that plays a clip of an avatar without a server."""

    cell: Positional[Path]  # a cell's folder, or a run's with one avatar
    out: File  # ends with .html
    motion: str = "test"  # test, train, walk, dance and so on, or a BVH or AMASS file
    frames: Stretch = None  # of the motion, from 0, B not included; default: all
    trust: Trust = False  # load methods that are not ours too: their code runs here, without isolation

    def __call__(self) -> int:
        """Write the page."""
        from benchmarks.play.actors import open_cast
        from benchmarks.play.motions import act_named, frames_in
        from benchmarks.play.share import clip_of, share_page

        if self.out.suffix != ".html":
            raise InputError(f"{self.out}: expected a page that ends with .html")
        with open_cast(self.cell, trust=self.trust) as cast:
            act = act_named(cast.capture, self.motion)
            clip = clip_of(cast, act, frames_in(act, self.frames))
        write_atomic(self.out, share_page(clip))
        print(f"{self.out}: {len(clip.frames)} frames, {self.out.stat().st_size / 1e6:.1f} MB")
        return DONE
