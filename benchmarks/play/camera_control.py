"""A browser's camera: its own, the capture's to look through, and their frustums to click on."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera, Capture
from benchmarks.play.cameras import FREE, Viewpoint, distance_between, fov_of, middle_of, resized, start_position
from benchmarks.play.viewer import Viewer

SETTLE_SECONDS = 0.6  # after a jump, in which the browser may still report its old camera
SAME_M, SAME_RAD = 0.01, 0.01  # errors of a browser's numbers
NARROW = 0.75  # width by height
FRUSTUM_M, LINE_M = 0.12, 0.006  # a frustum's size, and the width of its lines
NEAREST_FRUSTUM_M = 0.6  # nearer, it would hide the person
TRAINING, HELD_OUT = (47, 111, 222), (221, 107, 32)  # colours of frustums


class CameraControl:
    """Moves a browser's camera, and follows it."""

    def __init__(self, viewer: Viewer, capture: Capture, on_choice: Callable[[str], None]) -> None:
        """`on_choice` gets the camera's name when the viewer chose it by turning or by a click."""
        self._viewer, self._capture, self._on_choice = viewer, capture, on_choice
        self._client = viewer.client
        self._jumped: tuple[float, np.ndarray] | None = None
        self.frustums: dict[str, viser.CameraFrustumHandle] = {}
        self._with_frustums = False
        self._client.camera.on_update(self._moved)
        first = viewpoint_of(self._client.camera)  # Sent before anybody listened; it may never be sent again.
        viewer.change(lambda state: replace(state, viewpoint=state.viewpoint or first))
        if (
            first is not None and first.width < NARROW * first.height
        ):  # On a narrow screen the arms stay in the picture.
            middle, start = middle_of(capture), start_position(capture)
            with self._client.atomic():
                self._client.camera.position = middle + (start - middle) * NARROW * first.height / first.width
                self._client.camera.look_at = middle

    def jump(self, name: str) -> None:
        """Look through one of the capture's cameras, follow the spiral, or look around freely from here."""
        own, window = self._capture.cameras.get(name), self._viewer.state.viewpoint
        if own is not None and window is not None:
            self._place_browser(resized(own, width=window.width, height=window.height))
        self._viewer.change(lambda state: replace(state, camera=name))
        self.show_frustums(self._with_frustums)

    def show_frustums(self, wanted: bool) -> None:
        """Draw the capture's cameras, but for the one that is looked through; or none."""
        self._with_frustums = wanted
        for handle in self.frustums.values():
            handle.remove()
        chosen, cameras = self._viewer.state.camera, self._capture.cameras if wanted else {}
        self.frustums = {name: self._frustum(name, camera) for name, camera in cameras.items() if name != chosen}
        self._hide_near_frustums()

    def _hide_near_frustums(self) -> None:
        here = self._viewer.state.viewpoint
        for name, handle in self.frustums.items():
            position = self._capture.cameras[name].position
            far = here is None or bool(np.linalg.norm(position - here.position) > NEAREST_FRUSTUM_M)
            if handle.visible != far:
                handle.visible = far

    def _frustum(self, name: str, camera: Camera) -> viser.CameraFrustumHandle:
        handle = self._client.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=fov_of(camera),
            aspect=camera.width / camera.height,
            scale=FRUSTUM_M,
            thickness=LINE_M,
            variant="filled",  # Lines alone are hard to hit.
            color=TRAINING if name in self._capture.splits["train"].cameras else HELD_OUT,
            wxyz=Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat(scalar_first=True),
            position=camera.position,
        )

        @handle.on_click
        def _(_: object) -> None:
            self._on_choice(name)
            self.jump(name)

        return handle

    def _place_browser(self, camera: Camera) -> None:
        """Put the browser's own camera there, so that turning goes on from it."""
        forward = camera.viewmat[2, :3]
        depth = max(float(forward @ (middle_of(self._capture) - camera.position)), 0.1)
        self._jumped = time.perf_counter(), camera.viewmat
        with self._client.atomic():
            self._client.camera.fov = fov_of(camera)
            self._client.camera.up_direction = (0.0, 1.0, 0.0)
            self._client.camera.position = camera.position
            self._client.camera.look_at = camera.position + depth * forward

    async def _moved(self, camera: viser.CameraHandle) -> None:
        """The browser has sent its camera."""
        now, before = viewpoint_of(camera), self._viewer.state.viewpoint
        if now is None:
            return
        resized_only = before is None or np.array_equal(now.viewmat, before.viewmat)
        stays = self._is_where_it_jumped(now) or resized_only
        state = self._viewer.change(lambda s: replace(s, viewpoint=now, camera=s.camera if stays else FREE))
        self._on_choice(state.camera)
        self._hide_near_frustums()

    def _is_where_it_jumped(self, now: Viewpoint) -> bool:
        if self._jumped is None or self._viewer.state.camera not in self._capture.cameras:
            return False
        when, viewmat = self._jumped
        moved, turned = distance_between(viewmat, now.viewmat)
        return time.perf_counter() - when < SETTLE_SECONDS or (moved < SAME_M and turned < SAME_RAD)


def viewpoint_of(camera: viser.CameraHandle) -> Viewpoint | None:
    """The view of a browser's camera; None for numbers that no camera has."""
    if camera.image_width < 16 or camera.image_height < 16 or not 0.01 < camera.fov < 3.0:
        return None
    if not (np.isfinite(camera.position).all() and np.isfinite(camera.wxyz).all() and np.linalg.norm(camera.wxyz) > 0):
        return None
    rotation = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ camera.position
    width, height = min(int(camera.image_width), 8192), min(int(camera.image_height), 8192)
    return Viewpoint(viewmat=viewmat, fov=float(camera.fov), width=width, height=height)
