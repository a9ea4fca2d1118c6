"""The truth for a motion that nobody captured: the person of a capture, driven by a motion file."""

from dataclasses import replace
from pathlib import Path

from ash.capture.manifest import Manifest
from ash.capture.typed import from_json
from ash.files import InputError
from synth.person.body import Body
from synth.presets import with_motion
from synth.scene import Clip, Scene

OLD_RIG = {"part": "cameras_per_frame"}  # fields by their names in manifests


def recorded_scene(manifest: Manifest, folder: Path) -> Scene:
    """The scene that a capture's manifest describes.

    Raises:
        InputError: the capture is not one of ours, or was made by a version whose scenes were others.
    """
    try:
        parameters = dict(manifest.parameters)
        if isinstance(rig := parameters.get("rig"), dict) and rig.get("shutter") == 0:
            rig = {key: value for key, value in rig.items() if key != "shutter"}
            parameters["rig"] = {OLD_RIG.get(key, key): value for key, value in rig.items()}
        scene: Scene = from_json(Scene, parameters)
    except ValueError as error:
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
