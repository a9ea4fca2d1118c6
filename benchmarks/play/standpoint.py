"""Where one browser stands: its own camera, the capture's to look through, and their frustums to click on."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera, Capture
from benchmarks.play.cameras import apart, fov_of, middle_of, resized, starting_place
from benchmarks.play.state import FREE, Eye
from benchmarks.play.viewer import Viewer

SETTLE_SECONDS = 0.6  # after a jump, in which the browser may still report where it was
SAME_M, SAME_TURN = 0.01, 0.01  # metres and radians, as far as a browser's numbers say
NARROW = 0.75  # width by height
FRUSTUM_M, LINE_M = 0.12, 0.006  # a frustum's size, and how thick its lines are
BLOCKS_M = 0.6  # of a frustum: nearer, it would hide the person
TRAINING, HELD_OUT = (47, 111, 222), (221, 107, 32)  # frustums


class Standpoint:
    """Moves a browser's camera, and hears where it went."""

    def __init__(self, viewer: Viewer, capture: Capture, told: Callable[[str], None]) -> None:
        """`told` hears the camera's name when the viewer chose it by turning or by a click."""
        self.viewer, self.capture, self.told = viewer, capture, told
        self.client = viewer.client
        self._jumped: tuple[float, np.ndarray] | None = None
        self._frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._frustums_wanted = False
        self.client.camera.on_update(self._moved)
        first = eye_of(self.client.camera)  # What it told before anybody listened; it may never say it again.
        viewer.change(lambda state: replace(state, eye=state.eye or first))
        if first is not None and first.width < NARROW * first.height:
            self._step_back(first)

    def _step_back(self, eye: Eye) -> None:
        """On a narrow screen the person's arms stay in the picture."""
        middle = middle_of(self.capture)
        with self.client.atomic():  # From where it shall start: what it told may be from before it was sent there.
            start = starting_place(self.capture)
            self.client.camera.position = middle + (start - middle) * NARROW * eye.height / eye.width
            self.client.camera.look_at = middle

    def jump(self, name: str) -> None:
        """Look through one of the capture's cameras, follow the spiral, or look around freely from here."""
        own, eye = self.capture.cameras.get(name), self.viewer.state.eye
        if own is not None and eye is not None:
            self._place_browser(resized(own, width=eye.width, height=eye.height))
        self.viewer.change(lambda state: replace(state, camera=name))
        self.show_frustums(self._frustums_wanted)

    def show_frustums(self, wanted: bool) -> None:
        """Draw the capture's cameras, but for the one that is looked through; or none."""
        self._frustums_wanted = wanted
        for handle in self._frustums.values():
            handle.remove()
        chosen = self.viewer.state.camera
        own = self.capture.cameras.items() if wanted else ()
        self._frustums = {name: self._frustum(name, camera) for name, camera in own if name != chosen}
        self._clear_view()

    def _clear_view(self) -> None:
        """Hide the frustums that stand before the viewer's face."""
        eye = self.viewer.state.eye
        for name, handle in self._frustums.items():
            far = eye is None or np.linalg.norm(self.capture.cameras[name].position - eye.position) > BLOCKS_M
            if handle.visible != far:
                handle.visible = bool(far)

    def _frustum(self, name: str, camera: Camera) -> viser.CameraFrustumHandle:
        handle = self.client.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=fov_of(camera),
            aspect=camera.width / camera.height,
            scale=FRUSTUM_M,
            thickness=LINE_M,
            variant="filled",  # Lines alone are hard to hit.
            color=TRAINING if name in self.capture.splits["train"].cameras else HELD_OUT,
            wxyz=Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat(scalar_first=True),
            position=camera.position,
        )
        handle.on_click(lambda _: self._clicked(name))
        return handle

    def _clicked(self, name: str) -> None:
        self.told(name)
        self.jump(name)

    def _place_browser(self, camera: Camera) -> None:
        """Put the browser's own camera there, so that turning goes on from it."""
        rotation = camera.viewmat[:3, :3]
        depth = float(rotation[2] @ (middle_of(self.capture) - camera.position))
        self._jumped = time.perf_counter(), camera.viewmat
        with self.client.atomic():
            self.client.camera.fov = fov_of(camera)
            self.client.camera.up_direction = (0.0, 1.0, 0.0)
            self.client.camera.position = camera.position
            self.client.camera.look_at = camera.position + max(depth, 0.1) * rotation[2]

    async def _moved(self, camera: viser.CameraHandle) -> None:
        """The browser says where its camera is."""
        eye = eye_of(camera)
        if eye is None:
            return
        if self._is_where_it_jumped(eye):
            self.viewer.change(lambda state: replace(state, eye=eye))
            self._clear_view()
            return
        before = self.viewer.state.eye
        stays = before is None or np.array_equal(eye.viewmat, before.viewmat)  # Only the window's size changed.
        self.viewer.change(lambda state: replace(state, eye=eye, camera=state.camera if stays else FREE))
        self.told(self.viewer.state.camera)
        self._clear_view()

    def _is_where_it_jumped(self, eye: Eye) -> bool:
        if self._jumped is None or self.viewer.state.camera not in self.capture.cameras:
            return False
        when, viewmat = self._jumped
        if time.perf_counter() - when < SETTLE_SECONDS:
            return True
        moved, turned = apart(viewmat, eye.viewmat)
        return moved < SAME_M and turned < SAME_TURN


def eye_of(camera: viser.CameraHandle) -> Eye | None:
    """What a browser's camera sees; None for numbers that no camera has."""
    if camera.image_width < 16 or camera.image_height < 16 or not 0.01 < camera.fov < 3.0:
        return None
    if not (np.isfinite(camera.position).all() and np.isfinite(camera.wxyz).all() and np.linalg.norm(camera.wxyz) > 0):
        return None
    rotation = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ camera.position
    return Eye(
        viewmat=viewmat,
        fov=float(camera.fov),
        width=min(int(camera.image_width), 8192),
        height=min(int(camera.image_height), 8192),
    )
