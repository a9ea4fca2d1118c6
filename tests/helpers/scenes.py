"""A tiny scene; `small_capture` of `helpers.sharing` is its capture."""

from dataclasses import replace

from synth import presets
from synth.scene import Clip, Rig, Scene


def small_scene(**changes) -> Scene:
    """A mannequin at 64 x 64: four cameras, three frames to train and two to test."""
    base = replace(
        presets.scene("mannequin", size="ci"),
        rig=Rig(cameras=4, held_out=1, width=64, height=64),
        train=(Clip(generator="walk", frames=3),),
        test=(Clip(generator="dance", frames=2),),
        near=(),
        far=(),
        samples=4,
        texture=256,
        novel_view_stride=2,
    )
    return replace(base, **changes)
