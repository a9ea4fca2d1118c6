"""The panel beside the picture, in words for somebody who never read the paper, and the camera of its browser."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
import viser._messages as messages
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera, Capture
from benchmarks.play.cameras import FREE, distance_between, fov_of, middle_of, resized
from benchmarks.play.rendering import NOTHING, TRUTH, RenderedView, ViewRenderer, ViewState
from benchmarks.play.viewer import Viewer, may_be_closed

NUMBERS_SECONDS = 0.3  # between two changes of the line of numbers, so that it can be read
SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}
SETTLE_SECONDS = 0.6  # after a jump, in which the browser may still report its old camera
SAME_M, SAME_RAD = 0.01, 0.01  # errors of a browser's numbers
BACK, TOGGLE, AHEAD = "◀", "Play / pause", "▶"

LABEL = "ash-bench play"
SCRIPT = Path(__file__).with_name("page.js")

HELP = """\
**Look around**: drag to turn, right-drag to move, wheel to come closer.

**Keys**: space plays and pauses, ← and → go frame by frame, M is the next avatar, C the next camera, T the truth \
beside it, E the error.

**What you see** is an avatar that learned from films of a synthetic person. It is given only a pose and a camera. \
Because the person is synthetic, the *truth* is known too: put it beside the avatar under *Compare*, for any motion \
and from any side.

**Numbers**: the error against the truth in dB (higher is better) and as FLIP (lower is better); the picture's size, \
and how many milliseconds it took.

**While something moves**, the picture is coarser, so that it stays smooth; it is sharp again once all stands still.
"""


class Page:
    """Builds the controls of one browser, and keeps them equal to its state."""

    def __init__(self, viewer: Viewer, renderer: ViewRenderer, render_truth: Callable[[Viewer], str]) -> None:
        """`render_truth` begins a picture of the truth of what the viewer sees, and returns what to say about it."""
        self.viewer, self._renderer, self._render_truth = viewer, renderer, render_truth
        self._clips, self._capture = renderer.clips, renderer.avatars.capture
        self._client, self._gui = viewer.client, viewer.client.gui
        self._numbers_at = 0.0  # when the line of numbers changed
        self._build()
        script = f"const LABEL = {json.dumps(LABEL)};\n{SCRIPT.read_text()}"
        self._client._websock_connection.queue_message(messages.RunJavascriptMessage(script))
        viewer.show = self.show
        self.cameras = CameraControl(viewer, self._capture, self._select_free_camera)

    # ---------------------------------------------------------------------------------------------------------------
    # Controls

    def _build(self) -> None:
        self._title = self._gui.add_markdown(self._headline(self.viewer.state, ""))
        self._numbers = self._gui.add_markdown("*loading the avatar ...*")
        self._divider = self._gui.add_slider("Divider", 0.0, 1.0, 0.002, 0.5, visible=False)
        self._sets(self._divider, "divider", float)
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self._build_motion()
        with tabs.add_tab("Compare"):
            self._build_compare()
        with tabs.add_tab("Help"):
            self._gui.add_markdown(HELP)
        self._build_keys()

    def _build_motion(self) -> None:
        state, titles = self.viewer.state, [clip.title for clip in self._clips]
        hint = "Training motion was learned from, the others were not."
        clip = self._gui.add_dropdown("Motion", titles, initial_value=titles[state.clip], hint=hint)
        self._on(clip, lambda value: self._choose_clip(titles.index(str(value))))
        most = max(1, len(self._clips[state.clip]) - 1)
        self._step = self._gui.add_slider("Frame", 0, most, 1, state.step, hint="Drag to scrub.")
        self._sets(self._step, "step", int)
        buttons = self._gui.add_button_group("Step", [BACK, TOGGLE, AHEAD], hint="Keys: ← space →")
        buttons.on_click(lambda event: self._press(str(event.target.value)))
        hint = "1 is as fast as it was recorded."
        speed = self._gui.add_dropdown("Speed", list(SPEEDS), initial_value="1", hint=hint)
        self._sets(speed, "speed", lambda value: SPEEDS[str(value)])
        hint = "Yours, or one of the capture's. Key: C"
        self._camera = self._gui.add_dropdown("Camera", self._camera_names(), initial_value=FREE, hint=hint)
        self._on(self._camera, lambda value: self.cameras.jump(str(value)))

    def _camera_names(self) -> list[str]:
        """Novel-view cameras first: the truth of novel poses is known for them."""
        training = self._capture.splits["train"].cameras
        return [FREE, *sorted(self._capture.cameras, key=lambda name: name in training)]

    def _build_compare(self) -> None:
        titles, left = list(self._renderer.avatars.titles), self.viewer.state.left
        hint = "Which method drew it. Key: M"
        self._left = self._gui.add_dropdown("Avatar", titles, initial_value=left, hint=hint)
        self._sets(self._left, "left", str)
        choices, hint = [NOTHING, TRUTH, *titles], "Another method, or the path-traced truth. Key: T"
        self._right = self._gui.add_dropdown("Beside it", choices, initial_value=NOTHING, hint=hint)
        self._on(self._right, lambda value: self._choose_right(str(value)))
        hint = "FLIP, where the truth is known: bright is where people see that it is wrong. Key: E"
        self._error = self._gui.add_checkbox("Show the error", False, hint=hint)
        self._on(self._error, lambda value: self._show_error(bool(value)))
        hint = "Path-traces this pose from this side; takes some seconds."
        self._gui.add_button("Render truth here", hint=hint).on_click(lambda _: self._ask_truth())
        self._truth_message = self._gui.add_markdown("")

    def _build_keys(self) -> None:
        titles = list(self._renderer.avatars.titles)
        for label, key, action in (
            ("Play or pause", "space", lambda: self._press(TOGGLE)),
            ("Next frame", "arrowright", lambda: self._press(AHEAD)),
            ("Previous frame", "arrowleft", lambda: self._press(BACK)),
            ("Next avatar", "M", lambda: self._next(self._left, titles, lambda value: self._set(left=value))),
            ("Next camera", "C", lambda: self._next(self._camera, self._camera_names(), self.cameras.jump)),
            ("Truth beside it", "T", lambda: self._next(self._right, [NOTHING, TRUTH], self._choose_right)),
            ("Error", "E", lambda: self._show_error(not self.viewer.state.error)),
        ):
            command = self._gui.add_command(label, hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(lambda _, action=action: action())

    def _on(self, control: viser.GuiInputHandle, action: Callable[[Any], None]) -> None:
        """Call `action` when the viewer changes a control, and not when this class does."""

        @control.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                action(event.target.value)

    def _sets(self, control: viser.GuiInputHandle, name: str, convert: Callable[[Any], object]) -> None:
        """Let a control set a field of the state."""
        self._on(control, lambda value: self._set(**{name: convert(value)}))

    # ---------------------------------------------------------------------------------------------------------------
    # What controls do

    def _set(self, **changes: object) -> None:
        self.viewer.change(lambda state: replace(state, **changes))  # type: ignore[arg-type]

    def _next(self, control: viser.GuiDropdownHandle, choices: list[str], choose: Callable[[str], None]) -> None:
        at = choices.index(control.value) if control.value in choices else -1
        control.value = choices[(at + 1) % len(choices)]
        choose(control.value)

    def _press(self, button: str) -> None:
        def pressed(state: ViewState) -> ViewState:
            if button == TOGGLE:
                return replace(state, playing=not state.playing)
            step = (state.step + (1 if button == AHEAD else -1)) % len(self._clips[state.clip])
            return replace(state, playing=False, step=step)

        self.viewer.change(pressed)

    def _choose_clip(self, index: int) -> None:
        self._step.max = max(1, len(self._clips[index]) - 1)
        self._set(clip=index, step=0)

    def _choose_right(self, value: str) -> None:
        self._divider.visible = value != NOTHING
        self._set(right=value)

    def _select_free_camera(self) -> None:
        if self._camera.value != FREE:
            self._camera.value = FREE

    def _show_error(self, shown: bool) -> None:
        self._error.value = shown
        self._set(error=shown)

    def _ask_truth(self) -> None:
        """Render the truth of what is seen, and put it beside the avatar."""
        self._truth_message.content = self._render_truth(self.viewer)
        if self.viewer.state.right == NOTHING:
            self._right.value = TRUTH
            self._choose_right(TRUTH)

    # ---------------------------------------------------------------------------------------------------------------
    # What the page says

    def say_of_truth(self, message: str) -> None:
        """Say what became of a picture of the truth."""
        with may_be_closed(self._client):
            self._truth_message.content = message

    def show(self, state: ViewState, drawn: RenderedView | None, message: str) -> None:
        """A picture was sent, or could not be drawn (None); `message` has the numbers or the reason."""
        self._step.value = state.step
        if drawn is None:
            self._numbers.content = f"**This could not be drawn.** {_escaped(message)}"
            return
        now = time.perf_counter()
        if not state.playing or now - self._numbers_at > NUMBERS_SECONDS:
            self._numbers_at = now
            self._title.content = self._headline(state, drawn.score)
            self._numbers.content = _escaped(message) + (f"\n\n{drawn.note}" if drawn.note else "")

    def _headline(self, state: ViewState, score: str) -> str:
        clip = self._clips[state.clip]
        position = f"{clip.title}, frame {state.step + 1} of {len(clip)}"
        compared = f"\n\nAgainst the truth: **{_escaped(score)}**" if score else ""
        return f"**{_escaped(state.left)}** · {_escaped(position)}{compared}"


def _escaped(text: str) -> str:
    """Without what Markdown or HTML would interpret: names come from files."""
    for mark in "\\`*_{}[]<>#|":
        text = text.replace(mark, f"\\{mark}" if mark != "<" else "&lt;")
    return text


class CameraControl:
    """Moves a browser's camera, and follows it."""

    def __init__(self, viewer: Viewer, capture: Capture, on_free: Callable[[], None]) -> None:
        """`on_free` is called once the view was turned away from one of the capture's cameras."""
        self._viewer, self._capture, self._on_free = viewer, capture, on_free
        self._client = viewer.client
        self._jumped: tuple[float, np.ndarray] | None = None
        self._client.camera.on_update(self._moved)
        first = viewpoint_of(self._client.camera)  # Sent before anybody listened; it may never be sent again.
        viewer.change(lambda state: replace(state, viewpoint=state.viewpoint or first))

    def jump(self, name: str) -> None:
        """Look through one of the capture's cameras, or look around freely from here."""
        own, window = self._capture.cameras.get(name), self._viewer.state.viewpoint
        if own is not None and window is not None:
            self._place_browser(resized(own, width=window.width, height=window.height))
        self._viewer.change(lambda state: replace(state, camera=name))

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
        self._viewer.change(lambda s: replace(s, viewpoint=now, camera=s.camera if stays else FREE))
        if not stays:  # Else a choice that is under way would be taken back.
            self._on_free()

    def _is_where_it_jumped(self, now: Camera) -> bool:
        if self._jumped is None or self._viewer.state.camera not in self._capture.cameras:
            return False
        when, viewmat = self._jumped
        moved, turned = distance_between(viewmat, now.viewmat)
        return time.perf_counter() - when < SETTLE_SECONDS or (moved < SAME_M and turned < SAME_RAD)


def viewpoint_of(camera: viser.CameraHandle) -> Camera | None:
    """A browser's camera, in pixels of its window; None for numbers that no camera has."""
    if camera.image_width < 16 or camera.image_height < 16 or not 0.01 < camera.fov < 3.0:
        return None
    if not (np.isfinite(camera.position).all() and np.isfinite(camera.wxyz).all() and np.linalg.norm(camera.wxyz) > 0):
        return None
    width, height = min(int(camera.image_width), 8192), min(int(camera.image_height), 8192)
    focal = height / 2 / np.tan(camera.fov / 2)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix().T
    viewmat[:3, 3] = -viewmat[:3, :3] @ camera.position
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(name=FREE, width=width, height=height, K=K, viewmat=viewmat)
