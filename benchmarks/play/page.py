"""The panel beside the picture: what a viewer can turn, in words for somebody who never read the paper."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import viser
import viser._messages as messages

from benchmarks.play.camera_control import CameraControl
from benchmarks.play.cameras import FREE, SPIRAL
from benchmarks.play.joints import FREE_DEG, ORDER, Angles, angles_of, ranges_of
from benchmarks.play.rendering import (
    ABSOLUTE,
    FLIP,
    NO_ERROR,
    NOTHING,
    TRUTH,
    RenderedView,
    ViewRenderer,
    ViewState,
)
from benchmarks.play.viewer import Viewer, may_be_closed

NUMBERS_SECONDS = 0.3  # between two changes of the line of numbers, so that it can be read
SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}
NO_JOINT = "(choose a joint)"
BACK, TOGGLE, AHEAD = "◀", "Play / pause", "▶"

LABEL = "ash-bench play"
SCRIPT = Path(__file__).with_name("page.js")

HELP = """\
**Look around**: drag to turn, right-drag or two fingers to move, wheel or pinch to come closer.

**Keys**: space plays and pauses, ← and → go frame by frame, M is the next avatar, C the next camera, T the truth \
beside it, E the error, \
D dark, L light.

**What you see** is an avatar that learned from films of a synthetic person. It is given only a pose and a camera. \
Because the person is synthetic, the *truth* is known too: put it beside the avatar under *Compare*, for any pose and \
from any side.

**Numbers**: the error against the truth in dB (higher is better) and as FLIP (lower is better); the picture's size, \
and how many milliseconds it took. Of these, Stg.1 poses the template mesh, Stg.2 draws what the networks see of it, \
Stg.3 decodes the Gaussians, Stg.4 splats them. Poses seen before need Stg.4 alone.

**While you move**, the picture is coarser, so that it stays smooth; it is sharp again once you let go.
"""


class Page:
    """Builds the controls of one browser, and keeps them equal to its state."""

    def __init__(self, viewer: Viewer, renderer: ViewRenderer, render_truth: Callable[[Viewer], str]) -> None:
        """`render_truth` begins a picture of the truth of what the viewer sees, and returns what to say about it."""
        self.viewer, self._renderer, self._render_truth = viewer, renderer, render_truth
        self._clips, self._capture = renderer.clips, renderer.avatars.capture
        self._client, self._gui = viewer.client, viewer.client.gui
        self._numbers_at = 0.0  # when the line of numbers changed
        self._angles_of: tuple[int | None, int, int] = (None, 0, 0)  # joint, clip and step of the sliders' angles
        self._build()
        constants = f"const LABEL = {json.dumps(LABEL)}, DIVIDER = {json.dumps(self._divider._impl.uuid)};\n"
        script = messages.RunJavascriptMessage(constants + SCRIPT.read_text())
        self._client._websock_connection.queue_message(script)
        viewer.show = self.show
        self.cameras = CameraControl(viewer, self._capture, self._select_camera)

    # ---------------------------------------------------------------------------------------------------------------
    # Controls

    def _build(self) -> None:
        self._title = self._gui.add_markdown(self._headline(self.viewer.state, ""))
        self._numbers = self._gui.add_markdown("*loading the avatar ...*")
        self._divider = self._gui.add_slider(
            "Divider", 0.0, 1.0, 0.002, 0.5, hint="Or drag the line in the picture.", visible=False
        )
        self._sets(self._divider, "divider", float)
        tabs = self._gui.add_tab_group()
        for name, build in (
            ("Motion", self._build_motion),
            ("Compare", self._build_compare),
            ("Pose", self._build_pose),
            ("View", self._build_view),
            ("Help", lambda: self._gui.add_markdown(HELP)),
        ):
            with tabs.add_tab(name):
                build()
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
        loop = self._gui.add_checkbox("Again and again", state.loop, hint="Begin anew at the end of the motion.")
        self._sets(loop, "loop", bool)
        hint = "Yours, the paper's spiral around the person, or one of the capture's. Key: C"
        self._camera = self._gui.add_dropdown("Camera", self._camera_names(), initial_value=FREE, hint=hint)
        self._on(self._camera, lambda value: self.cameras.jump(str(value)))
        frustums = self._gui.add_checkbox("Show cameras", False, hint="Click on one to look through it.")
        self._on(frustums, lambda value: self.cameras.show_frustums(bool(value)))

    def _camera_names(self) -> list[str]:
        """Held-out cameras first: of them the truth of the held-out motion is known."""
        training = self._capture.splits["train"].cameras
        return [FREE, SPIRAL, *sorted(self._capture.cameras, key=lambda name: name in training)]

    def _build_compare(self) -> None:
        titles, left = list(self._renderer.avatars.titles), self.viewer.state.left
        hint = "Which method drew it. Key: M"
        self._left = self._gui.add_dropdown("Avatar", titles, initial_value=left, hint=hint)
        self._sets(self._left, "left", str)
        choices, hint = [NOTHING, TRUTH, *titles], "Another method, or the path-traced truth. Key: T"
        self._right = self._gui.add_dropdown("Beside it", choices, initial_value=NOTHING, hint=hint)
        self._on(self._right, lambda value: self._choose_right(str(value)))
        hint = "Bright is wrong. FLIP is how visible it is to people. Where the truth is known. Key: E"
        errors = [NO_ERROR, ABSOLUTE, FLIP]
        self._error = self._gui.add_dropdown("Show the error", errors, initial_value=NO_ERROR, hint=hint)
        self._sets(self._error, "error", str)
        hint = "Path-traces this pose from this side; takes some seconds."
        self._gui.add_button("Render truth here", hint=hint).on_click(lambda _: self._ask_truth())
        self._progress = self._gui.add_progress_bar(0, visible=False, animated=True)
        self._truth_message = self._gui.add_markdown("")

    def _build_pose(self) -> None:
        hint = "Hold a joint as you like, and see whether the avatar bears it; the others go on moving."
        self._gui.add_markdown(hint)
        self._joint_names = [name.replace("_", " ") for name in self._capture.skeleton.names]
        choices, hint = [NO_JOINT, *self._joint_names], "Joints that you hold are marked in the skeleton."
        self._joint = self._gui.add_dropdown("Joint", choices, initial_value=NO_JOINT, hint=hint)
        self._on(self._joint, lambda _: self._choose_joint())
        self._sliders = []
        for number, axis in enumerate(ORDER.lower()):
            slider = self._gui.add_slider(f"About {axis}", -FREE_DEG, FREE_DEG, 0.5, 0.0, visible=False)
            self._on(slider, lambda value, number=number: self._turn(number, float(value)))
            self._sliders.append(slider)
        self._reset_joint = self._gui.add_button("Reset this joint", visible=False)
        self._reset_joint.on_click(lambda _: self._reset(self._joint_index()))
        self._gui.add_button("Reset all joints").on_click(lambda _: self._reset(None))

    def _build_view(self) -> None:
        for name, label, hint in (
            ("mesh", "Template mesh", "The surface that carries the Gaussians."),
            ("skeleton", "Skeleton", "The joints that the pose turns."),
            ("ellipsoids", "Gaussians as ellipsoids", "Each one small and opaque, so that single ones can be seen."),
        ):
            self._sets(self._gui.add_checkbox(label, False, hint=hint), name, bool)
        hint = "Page and background; at first as your system has it. Keys: D and L"
        self._dark = self._gui.add_checkbox("Dark", False, hint=hint)
        self._on(self._dark, lambda value: self._darken(bool(value)))

    def _build_keys(self) -> None:
        titles = list(self._renderer.avatars.titles)
        for label, key, action in (
            ("Play or pause", "space", lambda: self._press(TOGGLE)),
            ("Next frame", "arrowright", lambda: self._press(AHEAD)),
            ("Previous frame", "arrowleft", lambda: self._press(BACK)),
            ("Next avatar", "M", lambda: self._next(self._left, titles, lambda value: self._set(left=value))),
            ("Next camera", "C", lambda: self._next(self._camera, self._camera_names(), self.cameras.jump)),
            ("Truth beside it", "T", lambda: self._next(self._right, [NOTHING, TRUTH], self._choose_right)),
            ("Dark", "D", lambda: self._darken(True)),
            ("Light", "L", lambda: self._darken(False)),
            ("Error", "E", lambda: self._next(
                self._error, [NO_ERROR, ABSOLUTE, FLIP], lambda value: self._set(error=value))),
        ):  # fmt: skip
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
            length = len(self._clips[state.clip])
            if button == TOGGLE:
                restart = not state.playing and not state.loop and state.step == length - 1
                return replace(state, playing=not state.playing, step=0 if restart else state.step)
            moved = replace(state, playing=False, loop=True).advanced(1 if button == AHEAD else -1, length)
            return replace(moved, loop=state.loop)

        self.viewer.change(pressed)

    def _choose_clip(self, index: int) -> None:
        self._step.max = max(1, len(self._clips[index]) - 1)
        self._set(clip=index, step=0)

    def _choose_right(self, value: str) -> None:
        self._divider.visible = value != NOTHING
        self._set(right=value)

    def _select_camera(self, name: str) -> None:
        if self._camera.value != name:
            self._camera.value = name

    def _joint_index(self) -> int | None:
        return None if self._joint.value == NO_JOINT else self._joint_names.index(self._joint.value)

    def _choose_joint(self) -> None:
        joint = self._joint_index()
        self._reset_joint.visible = joint is not None
        ranges = (None,) * len(ORDER) if joint is None else ranges_of(self._capture.skeleton.names[joint])
        for slider, limits in zip(self._sliders, ranges, strict=True):
            slider.visible = limits is not None
            if limits is not None:
                slider.min, slider.max, slider.label = limits.low, limits.high, limits.more.capitalize()
                slider.hint = f"Degrees: {limits.high:g} {limits.more}, {limits.low:g} {limits.less}."
        self._show_angles(self.viewer.state)

    def _show_angles(self, state: ViewState) -> None:
        """Set the sliders to the chosen joint's angles; to an end, where the motion goes beyond."""
        joint = self._joint_index()
        for slider, angle in zip(self._sliders, self._angles(state, joint) if joint is not None else (), strict=False):
            slider.value = min(max(angle, slider.min), slider.max)
        self._angles_of = joint, state.clip, state.step

    def _angles(self, state: ViewState, joint: int) -> Angles:
        """The angles that the viewer gave a joint, or those of the motion."""
        clip = self._clips[state.clip]
        rotvec = clip.motion.dofs[clip.frames[state.step], 3 + 3 * joint : 6 + 3 * joint]
        return dict(state.turned).get(joint) or angles_of(self._capture.skeleton, joint, rotvec)

    def _turn(self, number: int, degrees: float) -> None:
        joint = self._joint_index()
        if joint is not None:
            x, z, y = (degrees if i == number else a for i, a in enumerate(self._angles(self.viewer.state, joint)))
            self.viewer.change(lambda state: state.with_joint(joint, (x, z, y)))

    def _reset(self, joint: int | None) -> None:
        self._show_angles(self.viewer.change(lambda state: state.without_joint(joint)))

    def _darken(self, dark: bool) -> None:
        self._dark.value = dark
        self._gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self._set(dark=dark)

    def _ask_truth(self) -> None:
        """Render the truth of what is seen, and put it beside the avatar."""
        self._truth_message.content = self._render_truth(self.viewer)
        if self.viewer.state.right == NOTHING:
            self._right.value = TRUTH
            self._choose_right(TRUTH)

    # ---------------------------------------------------------------------------------------------------------------
    # What the page says

    def show_truth_progress(self, message: str, share: float | None) -> None:
        """How far a picture of the truth is; None: it came or failed."""
        with may_be_closed(self._client):
            self._progress.visible = share is not None
            self._progress.value = 100 * (share or 0.0)
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
        joint = self._joint_index()
        is_new = self._angles_of != (joint, state.clip, state.step)
        if not state.playing and is_new and joint not in dict(state.turned):
            self._show_angles(state)

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
