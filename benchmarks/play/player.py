"""`ash-bench play`: the avatars of a run in the browser, beside the truth."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import viser

from benchmarks.play.actors import Cast, open_cast
from benchmarks.play.cameras import first_camera, fov_of, middle_of, starting_place
from benchmarks.play.doors import DoorOptions, close_server, open_server
from benchmarks.play.motions import acts_of, first_act
from benchmarks.play.page import LABEL, Page
from benchmarks.play.picture import Painter
from benchmarks.play.shelf import TruthShelf, truth_from
from benchmarks.play.state import ViewState
from benchmarks.play.truth import TruthStudio, Wanted
from benchmarks.play.viewer import Stream, Viewer
from benchmarks.provenance import cores

TRUTH_PIXELS = 384 * 384  # of a rendered truth: some seconds on two cores
STAGE_SHARE = {"starting the renderer": 0.1, "posing the body and its clothes": 0.3, "tracing light": 0.6}


class PlayServer:
    """Everything that runs while people watch."""

    def __init__(self, cast: Cast, motions: Sequence[str], doors: DoorOptions) -> None:
        self.cast, self.acts = cast, acts_of(cast.capture, motions)
        self.first_act = first_act(self.acts, motions)
        self.shelf = TruthShelf(cast.capture)
        self.painter = Painter(cast, self.acts, self.shelf)
        self.studio = TruthStudio(cast.capture.folder)
        self.stream = Stream(self.painter)
        self._pages: dict[int, Page] = {}
        self._lock = threading.Lock()
        self.server, self.url, self.doors = open_server(doors, label=LABEL)
        self._set_stage()
        self.server.on_client_connect(self._arrive)
        self.server.on_client_disconnect(self._leave)
        self.stream.start()

    def close(self) -> None:
        """End all threads and processes."""
        close_server(self.server)
        self.stream.stop()
        self.studio.close()

    def _set_stage(self) -> None:
        """Where a new viewer stands, and what the page looks like."""
        start = self.server.initial_camera
        start.position, start.look_at = starting_place(self.cast.capture), middle_of(self.cast.capture)
        start.up = np.array([0.0, 1.0, 0.0])
        start.fov = fov_of(first_camera(self.cast.capture))
        self.server.scene.set_up_direction("+y")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)

    def _arrive(self, client: viser.ClientHandle) -> None:
        state = ViewState(left=self.cast.titles[0], act=self.first_act)
        viewer = Viewer(client, self.acts, state, self.stream.wake)
        page = Page(viewer, self.painter, self._render_truth)
        with self._lock:
            self._pages[client.client_id] = page
        self.stream.add(viewer)

    def _leave(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            self.stream.remove(page.viewer)

    def _render_truth(self, viewer: Viewer) -> str:
        """Begin to path-trace what a viewer sees."""
        state = viewer.state
        if state.eye is None:
            return ""
        act, page = self.acts[state.act], self._pages.get(viewer.client.client_id)
        shrink = min(1.0, (TRUTH_PIXELS / (state.eye.width * state.eye.height)) ** 0.5)
        size = {"width": round(shrink * state.eye.width), "height": round(shrink * state.eye.height)}
        camera = self.painter.camera(state, **size)
        frame = act.frames[state.step]
        captured = act.captured and not state.held
        start = time.perf_counter()

        def heard(words: str) -> None:
            if page is not None:
                page.truth_progress(f"Truth: {words} ...", STAGE_SHARE.get(words, 0.5))

        def shown(picture: np.ndarray | None, problem: str) -> None:
            if picture is not None:
                self.shelf.put(act, state, truth_from(camera, picture))
            if page is not None:
                took = f"Truth rendered in {time.perf_counter() - start:.0f} s."
                page.truth_progress(problem or took, None)
                viewer.redraw()

        wanted = Wanted(motion=self.painter.motion(act, state), frame=frame, camera=camera, captured=captured)
        if not self.studio.ask(wanted, heard=heard, shown=shown):
            return "Another truth is being rendered; try again in a moment."
        return "Truth: waiting for the renderer ..."


@contextmanager
def playing(
    run: Path,
    *,
    motions: Sequence[str] = (),
    scene: str | None = None,
    methods: Sequence[str] = (),
    doors: DoorOptions | None = None,
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
        with open_cast(run, scene=scene, methods=methods, device=device, trust=trust) as cast:
            cast.actor(cast.titles[0])  # A run that cannot be played says so before a browser opens.
            player = PlayServer(cast, motions, doors or DoorOptions())
            try:
                yield player
            finally:
                player.close()
    finally:
        torch.set_num_threads(before)


def wait_for_interrupt() -> None:
    """Until Ctrl-C."""
    with_nothing_to_do = threading.Event()
    with_nothing_to_do.wait()
