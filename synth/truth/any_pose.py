"""The truth of a capture's person in any pose, seen by any camera: rendered when it is asked for."""

from dataclasses import replace

import numpy as np

from ash.capture.dataset import Camera, Capture, Pose
from ash.capture.formats import read_surface_truth
from ash.files import InputError
from synth.camera.render import probe
from synth.capture import make_body
from synth.cloth import surface as cloth
from synth.rendering import studio_of
from synth.scene import Scene, stream
from synth.truth.retargeting import recorded_scene

HISTORY = 24  # frames before the pose, through which clothes are carried: they depend on where they came from


class PoseTruth:
    """Renders the person of a capture. Heavy: it belongs into a process of its own."""

    def __init__(self, capture: Capture) -> None:
        """Find a renderer.

        Raises:
            InputError: the capture is not of this version's scenes, has no truth, or nothing here renders.
        """
        self.capture, self.scene = capture, recorded_scene(capture.manifest, capture.folder)
        if not (capture.folder / "truth" / "surface.npz").is_file():
            raise InputError(f"{capture.folder}: has no truth to render")
        self.renderer = probe()

    def picture(self, pose: Pose, camera: Camera, *, captured: bool) -> np.ndarray:
        """RGBA uint8 `[h, w, 4]`, straight alpha: exactly the capture's image where frame and camera are its own.

        `captured`: the frame is one of the capture's, whose surface is known; else the person is posed and dressed
        anew, from `HISTORY` frames of the motion.
        """
        surface = read_surface_truth(self.capture.folder, pose.frame) if captured else dressed(self.scene, pose)
        studio = studio_of(self.scene, self.capture.folder, self.renderer)
        seed = stream(self.scene, "pixels", camera.name, pose.frame)
        return studio.render(surface, [camera], samples=self.scene.samples, seeds=[seed])[0].rgba


def dressed(scene: Scene, pose: Pose) -> np.ndarray:
    """The true surface in a frame of a motion that the scene never saw, `[s, 3]` float32 metres."""
    first = int(pose.window(HISTORY)[-1])
    clip = replace(
        pose.motion,
        dofs=pose.motion.dofs[first : pose.frame + 1],
        sequence=pose.motion.sequence[first : pose.frame + 1],
    )
    if len(clip.dofs) == 1:  # Cloth that swings needs a before.
        clip = replace(clip, dofs=clip.dofs.repeat(2, axis=0), sequence=clip.sequence.repeat(2))
    surface = cloth.true_surface(make_body(scene), clip, scene.outfit, seed=stream(scene, "folds"))
    return surface[-1].astype(np.float32)
