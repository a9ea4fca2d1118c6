"""Named scenes: functions of size and seed. Each factor scene adds exactly one phenomenon to `skinned`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

from ash.capture.dataset import Skeleton
from ash.files import InputError
from synth.camera.rig import rig_from_file
from synth.motion.clips import clip_from_file
from synth.motion.importing import WHOLE
from synth.scene import Clip, Light, Outfit, Rig, Scene, Take

SIZES = ("ci", "factor", "quick", "long", "table", "paper")
ROTATING = Rig(cameras=24, held_out=4, cameras_per_frame=4)
ALONE: dict[str, Any] = {"near": (), "far": ()}  # no motion beside what is asked for
NEW = ("dance", "twist", "wave", "bow", "clap")  # kinds of motion that no scene trains on
# Where people stand in `lit`, metres towards the lamp; training has four kinds of clips, so each is seen in several.
TRAINING_PLACES, HELD_OUT_PLACES = (-0.5, 0.5, 0.0, -0.25, 0.25), (-0.35, 0.35, -0.1, 0.1)
EVENING = Light(falloff=0.4, gloss=0.2)  # a lamp that lights one side of the floor, on cloth that shines a little


@dataclass(frozen=True, kw_only=True, slots=True)
class Size:
    """How much of everything. `new`, `near` and `far`: what is taken of a held-out clip, as `Clip` has it."""

    rig: Rig
    repeats: int  # rounds of the training clips
    frames: int  # per training clip
    new: dict[str, Any]
    near: dict[str, Any]
    far: dict[str, Any]
    stride: int  # of novel views
    samples: int  # per pixel; halves of n n or n (n + 1) samples fill the strata of the sampler
    texture: int
    fps: float = 12.0


def _size(name: str) -> Size:
    if name == "ci":
        rig = Rig(cameras=6, held_out=2, width=128, height=128)
        some = {"frames": 4, "history": 1, "stride": 2}
        clips: dict[str, Any] = {"frames": 4, "new": {"frames": 3}, "near": some, "far": some}
        return Size(rig=rig, repeats=1, **clips, stride=3, samples=16, texture=512)
    if name == "factor":  # Novel views lie between cameras, and pixels show what a factor adds.
        rig = replace(ROTATING, cameras_per_frame=8, width=192, height=192)
        return Size(rig=rig, repeats=2, **_few(10), stride=10, samples=50, texture=1024)
    if name == "quick":  # 104 training frames, and fewer than 550 images.
        return Size(rig=ROTATING, repeats=2, **_few(13), stride=13, samples=32, texture=2048)
    if name == "long":  # `quick` with three times the training motion.
        return Size(rig=ROTATING, repeats=8, **_few(10), stride=30, samples=32, texture=2048)
    if name == "table":
        rig = Rig(cameras=34, held_out=4, cameras_per_frame=10, width=512, height=512)
        clips = {
            "frames": 20,
            "new": {"frames": 7, "history": 3, "runs": 4, "span": 60},
            "near": {"frames": 6, "history": 3, "runs": 2, "span": 20},
            "far": {"frames": 14, "history": 4, "span": 20},
        }
        return Size(rig=rig, repeats=4, **clips, stride=20, samples=128, texture=4096)
    if name == "paper":  # 27,000 training frames and every tenth of 7,000 test frames, 25 a second.
        rig = Rig(kind="studio", cameras=120, held_out=4, width=1285, height=940, radius=4.5)
        tenth = {"history": 9, "stride": 10}
        clips = {
            "frames": 50,
            "new": tenth | {"frames": 1400},
            "near": tenth | {"frames": 50},
            "far": tenth | {"frames": 50},
        }
        return Size(rig=rig, repeats=135, **clips, stride=150, samples=60, texture=4096, fps=25.0)
    raise InputError(f"unknown size {name!r}, expected one of {', '.join(SIZES)}")


def _few(frames: int) -> dict[str, Any]:
    """Training clips of so many frames, and few images of held-out ones.

    New motion twice per clip, 4.7 s apart, which is no multiple of a beat; near motion in two frames that follow each
    other, far motion in two others, both from the middle of a motion as long as a training clip.
    """
    return {
        "frames": frames,
        "new": {"frames": 4, "history": 3, "runs": 2, "span": 60},
        "near": {"frames": 5, "history": 3, "span": frames},
        "far": {"frames": 6, "history": 2, "stride": 2, "span": frames},
    }


def _base(name: str, size: str, seed: int, *, body: str, outfit: Outfit) -> Scene:
    amount = _size(size)
    kinds, far = ("walk", "reach", "turn", "squat"), ("arms_up", "deep_squat", "jump")
    base = Scene(
        name=name,
        size=size,
        seed=seed,
        body=body,
        outfit=outfit,
        light=Light(),
        rig=amount.rig,
        train=(Clip(generator="stand", frames=amount.frames),),
        test=(Clip(generator="stand", frames=2),),
        novel_view_stride=amount.stride,
        samples=amount.samples,
        texture=amount.texture,
        fps=amount.fps,
    )
    if size == "ci":
        return _moving(base, amount, ("walk", "squat"), ("dance",), far[:1])
    return _moving(base, amount, kinds, NEW, far)


def _moving(scene: Scene, amount: Size, kinds: tuple[str, ...], new: tuple[str, ...], far: tuple[str, ...]) -> Scene:
    """The scene with rounds of these kinds to train on, another take of each to be near, others to be new or far."""
    near = tuple(dict.fromkeys(kinds))[: 1 if scene.size == "ci" else None]
    return replace(
        scene,
        train=tuple(Clip(generator=kind, frames=amount.frames) for kind in kinds * amount.repeats),
        test=tuple(Clip(generator=kind, **amount.new) for kind in new),
        near=tuple(Clip(generator=kind, **amount.near) for kind in near),
        far=tuple(Clip(generator=kind, **amount.far) for kind in far),
    )


def mannequin(*, size: str, seed: int) -> Scene:
    """A procedural humanoid in a swinging skirt: needs no body model; the scene of the tests."""
    outfit = Outfit(skirt=True, folds_mm=5.0, swing=0.2)
    return _base("mannequin", size, seed, body="mannequin", outfit=outfit)


def loose(*, size: str, seed: int) -> Scene:
    """A realistic body in loose clothes that swing, everything on: the default of the main job."""
    outfit = Outfit(skirt=True, folds_mm=4.0, slack_mm=3.0, swing=0.7, scan_mm=1.5)
    return replace(_base("loose", size, seed, body="anny", outfit=outfit), light=EVENING, depth=3)


def tight(*, size: str, seed: int) -> Scene:
    """A realistic body in tight clothes that fold a little, everything else on."""
    outfit = Outfit(folds_mm=3.0, scan_mm=1.0)
    return replace(_base("tight", size, seed, body="anny", outfit=outfit), light=EVENING, depth=3)


def skinned(*, size: str, seed: int) -> Scene:
    """Articulation only: the template with the true skinning is exact. The scene that every factor scene adds to.

    Light paths have `depth` 2: direct light, no bounce. `tight` and `loose` have one bounce.

    At size `ci` the body is the mannequin, so that all factor scenes together take minutes and need no body model.
    """
    amount = _size(size)
    base = _base("skinned", size, seed, body="mannequin" if size == "ci" else "anny", outfit=Outfit(skirt=True))
    if size == "ci":
        return _moving(base, amount, ("walk", "reach"), ("dance",), ("arms_up",))
    # Nothing that lifts the knees through a skirt that is only skinned.
    return _moving(base, amount, ("walk", "reach", "run", "reach"), NEW, 3 * ("arms_up",))


def factor_scene(name: str, *, size: str, seed: int = 0, strength: float = 1.0) -> Scene:
    """A factor scene: `skinned` with one phenomenon; at strength 0 its images are those of `skinned`, bit for bit."""
    base = replace(skinned(size=size, seed=seed), name=name)
    if name == "wrinkles":
        return replace(base, outfit=replace(base.outfit, folds_mm=7.0 * strength))
    if name == "swing":
        return replace(base, outfit=replace(base.outfit, swing=strength))
    if name == "lit":
        # The other lights dim, so that the lamp is much of what people get, and people cross the floor.
        reach = min(strength, 1.0)
        rest = 1 - 0.7 * reach
        return replace(
            base,
            light=replace(base.light, sky=rest * base.light.sky, area=rest * base.light.area, falloff=2 * strength),
            train=_across(base.train, TRAINING_PLACES, reach),
            test=_across(base.test, HELD_OUT_PLACES, reach),
            near=_across(base.near, HELD_OUT_PLACES, reach),
            far=_across(base.far, HELD_OUT_PLACES, reach),
        )
    if name == "glossy":
        return replace(base, light=replace(base.light, gloss=strength))
    if name == "turning":
        return replace(base, test=tuple(replace(clip, yaw=2.4 * strength) for clip in base.test))
    raise InputError(f"unknown factor scene {name!r}, expected one of {', '.join(FACTORS)}")


def _across(clips: tuple[Clip, ...], places: tuple[float, ...], reach: float) -> tuple[Clip, ...]:
    """The clips at these places in turn, each times `reach`."""
    return tuple(replace(clip, shift=(reach * place, 0.0)) for clip, place in zip(clips, cycle(places), strict=False))


def still(*, size: str, seed: int) -> Scene:
    """One pose: the textured body. Static Gaussians suffice. Direct light only (`depth` 2), as in all factor scenes."""
    base = skinned(size=size, seed=seed)
    train, test = (Clip(generator="stand", frames=frames) for frames in (4, 2))
    rig = replace(base.rig, cameras_per_frame=0)
    return replace(base, name="still", rig=rig, train=(train,), test=(test,), **ALONE, novel_view_stride=2)


FACTORS = ("wrinkles", "swing", "lit", "glossy", "turning")
SCENES: dict[str, Callable[..., Scene]] = {
    "mannequin": mannequin,
    "still": still,
    "skinned": skinned,
    **{name: partial(factor_scene, name) for name in FACTORS},
    "tight": tight,
    "loose": loose,
}


def scene(name: str, *, size: str, seed: int = 0, subject: int = 0) -> Scene:
    """The named scene of a subject at a size (one of `SIZES`).

    Raises:
        InputError: an unknown name or size; the message lists the known ones.
    """
    if name not in SCENES:
        raise InputError(f"unknown scene {name!r}, expected one of {', '.join(sorted(SCENES))}")
    if not 0 <= seed < 2**31:
        raise InputError(f"seed {seed}, expected 0 to 2^31 - 1")
    return replace(SCENES[name](size=size, seed=seed), subject=subject)


def with_motion(
    scene: Scene, skeleton: Skeleton, *, train: Path | None, test: Path | None, take: Take = WHOLE
) -> Scene:
    """The scene driven by a user's BVH or AMASS files, for as many frames as the scene has; the rest stays.

    What is near or far of its own motion says nothing of another's, and is left out.
    """

    def driven(clips: tuple[Clip, ...], path: Path | None) -> tuple[Clip, ...]:
        most = sum(len(clip.shown) for clip in clips)
        return clips if path is None else (clip_from_file(path, skeleton, fps=scene.fps, most=most, take=take),)

    return replace(scene, train=driven(scene.train, train), test=driven(scene.test, test), **ALONE)


def with_rig(scene: Scene, path: Path) -> Scene:
    """The scene seen by a user's `cameras.json`: every fourth camera is held out, at least one and at most eight."""
    return replace(scene, rig=rig_from_file(path))
