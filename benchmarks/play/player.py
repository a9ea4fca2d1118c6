"""`ash-bench play`: the avatars of a run in the browser, beside the truth."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import viser

from ash.files import InputError
from benchmarks.play.auth import AuthOptions, close_server, open_server
from benchmarks.play.avatars import AvatarSet, open_avatars
from benchmarks.play.cameras import START, camera_distance, first_camera, fov_of, middle_of, resized
from benchmarks.play.motions import first_clip, motion_clips
from benchmarks.play.page import LABEL, Page
from benchmarks.play.rendering import ViewRenderer, ViewState
from benchmarks.play.truth import TruthCache, TruthPicture, TruthRenderer
from benchmarks.play.viewer import DrawingThread, Viewer
from benchmarks.provenance import cores

TRUTH_PIXELS = 384 * 384  # of a rendered truth: some seconds on two cores


class PlayServer:
    """Everything that runs while people watch."""

    def __init__(self, avatars: AvatarSet, motions: Sequence[str], options: AuthOptions) -> None:
        self.avatars, self.clips = avatars, motion_clips(avatars.capture, motions)
        self.truths, self._truth_renderer = TruthCache(avatars.capture), TruthRenderer(avatars.capture.folder)
        self.renderer = ViewRenderer(avatars, self.clips, self.truths)
        self._first = ViewState(left=avatars.titles[0], clip=first_clip(self.clips, motions))
        self.pages: dict[int, Page] = {}
        self._lock = threading.Lock()
        self.server, self.url, self.auth = open_server(options, label=LABEL)
        start, middle = self.server.initial_camera, middle_of(avatars.capture)
        start.position, start.look_at = middle + camera_distance(avatars.capture) * np.array(START), middle
        start.up, start.fov = np.array([0.0, 1.0, 0.0]), fov_of(first_camera(avatars.capture))
        self.server.scene.set_up_direction("+y")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.drawing = DrawingThread(self.renderer)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        """End all threads and processes."""
        close_server(self.server)
        self.drawing.stop()
        self._truth_renderer.close()

    def _connected(self, client: viser.ClientHandle) -> None:
        viewer = Viewer(client, self.clips, self._first, self.drawing.wake)
        page = Page(viewer, self.renderer, self._render_truth)
        with self._lock:
            self.pages[client.client_id] = page
        self.drawing.viewers.append(viewer)
        self.drawing.wake()

    def _disconnected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self.pages.pop(client.client_id, None)
        if page is not None and page.viewer in self.drawing.viewers:
            self.drawing.viewers.remove(page.viewer)

    def _render_truth(self, viewer: Viewer) -> str:
        """Begin to path-trace what a viewer sees."""
        state, page = viewer.state, self.pages.get(viewer.client.client_id)
        if state.viewpoint is None or page is None:
            return ""
        if self._truth_renderer.is_busy:
            return "Another truth is being rendered; try again in a moment."
        seen = self.renderer.camera(state)
        window = state.viewpoint
        shrink = min(1.0, (TRUTH_PIXELS / (window.width * window.height)) ** 0.5)
        camera = resized(seen, width=round(shrink * window.width), height=round(shrink * window.height))
        clip, pose = self.clips[state.clip], self.renderer.pose(state.clip, state.step)

        def render() -> None:
            start = time.perf_counter()
            try:
                picture = self._truth_renderer.render(pose, camera, captured=clip.captured)
            except InputError as error:
                page.say_of_truth(str(error))
                return
            self.truths.put(clip, pose.frame, TruthPicture(camera=camera, on_black=picture))
            page.say_of_truth(f"Truth rendered in {time.perf_counter() - start:.0f} s.")
            viewer.change(replace)  # Drawn again, for the truth is known now.

        threading.Thread(target=render, daemon=True, name="truth").start()
        return "Truth: is being rendered ..."


@contextmanager
def playing(
    run: Path,
    *,
    motions: Sequence[str] = (),
    scene: str | None = None,
    methods: Sequence[str] = (),
    options: AuthOptions | None = None,
    device: str = "cpu",
    trust: bool = False,
) -> Iterator[PlayServer]:
    """A player for as long as the body runs; avatars draw on `device`, methods of others only where they are trusted.

    Raises:
        InputError: nothing to play, a motion that cannot be read, or an address that is not safe.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(cores())
    try:
        with open_avatars(run, scene=scene, methods=methods, device=device, trust=trust) as avatars:
            avatars[avatars.titles[0]]  # A run that cannot be played is refused before a browser opens.
            player = PlayServer(avatars, motions, options or AuthOptions())
            try:
                yield player
            finally:
                player.close()
    finally:
        torch.set_num_threads(before)
