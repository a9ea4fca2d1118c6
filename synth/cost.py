"""What a capture will cost before it is made: images, hours, bytes."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ash.files import InputError
from synth.scene import Scene
from synth.views import splits

VERTICES = {"anny": 28_043, "mannequin": 9_140}  # of the surface, dressed with a skirt
LEAST_MEMORY = 10**9  # of the renderer, the body and its texture


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """What a capture will cost, from figures measured on two cores of a 2019 server."""

    images: int
    core_seconds: float
    bytes: int  # on disk
    memory: int  # bytes, at its largest: while the longest clip is draped

    @property
    def text(self) -> str:
        """One line for the user."""
        hours = self.core_seconds / 3600
        time = f"{hours:.1f} core-hours" if hours >= 1 else f"{self.core_seconds / 60:.1f} core-minutes"
        room = f"{self.bytes / 1e9:.2f} GB on disk, {self.memory / 1e9:.1f} GB of memory"
        return f"{self.images} images, about {time}, {room}"


def estimate(scene: Scene) -> Estimate:
    """Images, core seconds and bytes of a capture before it is made."""
    training = sum(clip.frames for clip in scene.train)
    images = sum(split.count for split in splits(scene).values())
    pixels = scene.rig.width * scene.rig.height
    longer = 1.4 if scene.depth > 2 or scene.light.gloss else 1.0  # than direct light on diffuse cloth takes
    per_image = 0.07 + 1.6e-7 * pixels * scene.samples * longer
    fixed = (40.0 if scene.body == "anny" else 6.0) + 0.25 * scene.frames + 0.5 * training * (scene.scanner.rms_mm > 0)
    size = int(images * pixels * 1.1 + scene.frames * 1.2e6 + 3 * scene.texture**2)
    # Of the template, which has a quarter of the vertices, all frames twice; of the surface the longest clip, thrice.
    longest = max(clip.frames for clip in scene.clips)  # of a run
    memory = LEAST_MEMORY + VERTICES[scene.body] * (12 * scene.frames + 80 * longest)
    return Estimate(images=images, core_seconds=fixed + images * per_image, bytes=size, memory=memory)


def require_space(captures: Sequence[tuple[Scene, Path]], disk: Path) -> None:
    """Refuse captures that the disk cannot hold. What an earlier run wrote into their folders counts as there already.

    `disk`: a folder on it, or one that is still to be made.
    """
    needed = 0
    for scene, folder in captures:
        there = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        needed += max(0, estimate(scene).bytes - there)
    free = shutil.disk_usage(next(place for place in (disk, *disk.absolute().parents) if place.exists())).free
    if needed > free:
        what = "the capture needs" if len(captures) == 1 else f"{len(captures)} captures need"
        raise InputError(f"{disk}: {what} {size_text(needed)} more and the disk has {size_text(free)} free")


def size_text(count: int) -> str:
    """Bytes for a reader: 1.2 GB, 34.5 MB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
