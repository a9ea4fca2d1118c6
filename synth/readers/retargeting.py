"""The truth for a motion that nobody captured: the person of a capture, driven by a motion file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from ash.capture.manifest import Manifest
from ash.files import InputError
from synth.person.body import Body
from synth.presets import with_motion
from synth.scene import Clip, Light, Outfit, Rig, Scanner, Scene, Take


def scene_of(manifest: Manifest, folder: Path) -> Scene:
    """The scene that a capture's manifest describes.

    Raises:
        InputError: the capture is not one of ours, or was made by a version whose scenes were others.
    """
    try:
        given = manifest.parameters
        scene = Scene(
            **given
            | {
                "outfit": Outfit(**given["outfit"]),
                "light": Light(**given["light"]),
                "scanner": Scanner(**given["scanner"]),
                "rig": Rig(**given["rig"] | {"distortion": tuple(given["rig"]["distortion"])}),
                "train": tuple(_clip(clip) for clip in given["train"]),
                "test": tuple(_clip(clip) for clip in given["test"]),
                "near": tuple(_clip(clip) for clip in given.get("near", ())),
                "far": tuple(_clip(clip) for clip in given.get("far", ())),
            }
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder}: its manifest describes no scene of this version ({error})") from error
    if scene.identity != manifest.identity:
        raise InputError(f"{folder}: its manifest describes another scene than it names; render the capture again")
    return scene


def retargeted(scene: Scene, body: Body, motion: Path, *, frames: int) -> Scene:
    """The same person in the same clothes, light and rig, who does in the test what the motion file says.

    Training is a moment of standing: nothing is learned from this capture. Cameras stand where they stood and are
    aimed anew, so that the person stays in the picture.
    """
    plain = replace(scene, train=(Clip(generator="stand", frames=2),), test=(Clip(generator="stand", frames=frames),))
    return with_motion(replace(plain, novel_view_stride=2), body.skeleton, train=None, test=motion)


def _clip(parameters: dict[str, Any]) -> Clip:
    # Where a user's file lay is not known any more, and it is not needed: the clip is not solved again.
    take = dict(parameters.get("take", {}))
    take["joints"] = tuple((str(ours), str(theirs)) for ours, theirs in take.get("joints", ()))
    return Clip(**parameters | {"shift": tuple(parameters["shift"]), "take": Take(**take)})
