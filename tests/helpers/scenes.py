"""A tiny scene, and its capture rendered once for all tests."""

import atexit
import shutil
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from synth import presets
from synth.capture import make_capture
from synth.scene import Clip, Rig, Scene


def small_scene(**changes) -> Scene:
    """A mannequin at 64 x 64: four cameras, three frames to train and two to test."""
    base = replace(
        presets.scene("mannequin", size="ci"),
        rig=Rig(cameras=4, held_out=1, width=64, height=64),
        train=(Clip(generator="walk", frames=3),),
        test=(Clip(generator="dance", frames=2),),
        samples=4,
        texture=256,
        novel_view_stride=2,
    )
    return replace(base, **changes)


@lru_cache(maxsize=1)
def small_capture() -> Path:
    """The folder of the small scene's capture, removed when the tests end. Tests that change it work on a copy."""
    folder = Path(tempfile.mkdtemp(prefix="ash-bench-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return make_capture(small_scene(), folder / "small")
