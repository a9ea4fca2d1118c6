"""The page beside the picture: what a viewer can turn, in words for somebody who never read the paper."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import viser
import viser._messages as messages

from benchmarks.play.joints import ORDER, UNKNOWN, Angles, angles_of, ranges_of
from benchmarks.play.picture import Painter, Painting
from benchmarks.play.standpoint import Standpoint
from benchmarks.play.state import ABSOLUTE, FLIP, FREE, NO_ERROR, NOTHING, SPIRAL, TRUTH, ViewState
from benchmarks.play.viewer import Viewer, gone_is_fine

WORDS_SECONDS = 0.3  # between two changes of the line of numbers: faster nobody reads
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
    """Builds the controls of one browser, and keeps them in step with its state."""

    def __init__(self, viewer: Viewer, painter: Painter, render_truth: Callable[[Viewer], str]) -> None:
        """`render_truth` begins a picture of the truth of what the viewer sees, and says what came of that."""
        self.viewer, self.painter, self.render_truth = viewer, painter, render_truth
        self.capture = painter.cast.capture
        self.client, self.gui = viewer.client, viewer.client.gui
        self._said = 0.0
        self._angles_shown: tuple[int | None, int, int] = (None, 0, 0)  # of which joint, act and step
        self._build()
        given = f"const LABEL = {json.dumps(LABEL)}, DIVIDER = {json.dumps(self.divider._impl.uuid)};\n"
        script = messages.RunJavascriptMessage(given + SCRIPT.read_text())
        self.client._websock_connection.queue_message(script)
        viewer.show = self.show
        self.standpoint = Standpoint(viewer, self.capture, self._camera_is)

    # ---------------------------------------------------------------------------------------------------------------
    # Controls

    def _build(self) -> None:
        self.title = self.gui.add_markdown(self._headline(self.viewer.state, ""))
        self.words = self.gui.add_markdown("*loading the avatar ...*")
        self.divider = self.gui.add_slider(
            "Divider", 0.0, 1.0, 0.002, 0.5, hint="Or drag the line in the picture.", visible=False
        )
        self._on(self.divider, lambda value: self._set(divider=float(value)))
        tabs = self.gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self._build_motion()
        with tabs.add_tab("Compare"):
            self._build_compare()
        with tabs.add_tab("Pose"):
            self._build_pose()
        with tabs.add_tab("View"):
            self._build_view()
        with tabs.add_tab("Help"):
            self.gui.add_markdown(HELP)
        self._build_keys()

    def _build_motion(self) -> None:
        state, acts = self.viewer.state, self.painter.acts
        titles = [act.title for act in acts]
        self.act = self.gui.add_dropdown(
            "Motion", titles, hint="Training motion was learned from, the others were not."
        )
        self.act.value = titles[state.act]
        self.step = self.gui.add_slider(
            "Frame", 0, max(1, len(acts[state.act]) - 1), 1, state.step, hint="Drag to scrub."
        )
        self.buttons = self.gui.add_button_group("Step", [BACK, TOGGLE, AHEAD], hint="Keys: ← space →")
        self.speed = self.gui.add_dropdown(
            "Speed", list(SPEEDS), initial_value="1", hint="1 is as fast as it was recorded."
        )
        self.loop = self.gui.add_checkbox("Again and again", state.loop, hint="Begin anew at the end of the motion.")
        choices = self._cameras()
        self.camera = self.gui.add_dropdown(
            "Camera",
            choices,
            initial_value=FREE,
            hint="Yours, the paper's spiral around the person, or one of the capture's. Key: C",
        )
        self.frustums = self.gui.add_checkbox("Show cameras", False, hint="Click on one to look through it.")
        self._on(self.act, self._choose_act)
        self._on(self.step, lambda value: self._set(step=int(value)))
        self.buttons.on_click(lambda event: self._press(str(event.target.value)))
        self._on(self.speed, lambda value: self._set(speed=SPEEDS[str(value)]))
        self._on(self.loop, lambda value: self._set(loop=bool(value)))
        self._on(self.camera, lambda value: self.standpoint.jump(str(value)))
        self._on(self.frustums, lambda value: self.standpoint.show_frustums(bool(value)))

    def _cameras(self) -> list[str]:
        """Held-out cameras first: of them the truth of the held-out motion is known."""
        apart = [name for name in self.capture.cameras if name not in self.capture.splits["train"].cameras]
        return [FREE, SPIRAL, *apart, *(name for name in self.capture.cameras if name not in apart)]

    def _build_compare(self) -> None:
        titles = list(self.painter.cast.titles)
        self.left = self.gui.add_dropdown(
            "Avatar", titles, initial_value=self.viewer.state.left, hint="Which method drew it. Key: M"
        )
        self.right = self.gui.add_dropdown(
            "Beside it",
            [NOTHING, TRUTH, *titles],
            initial_value=NOTHING,
            hint="Another method, or the path-traced truth. Key: T",
        )
        self.error = self.gui.add_dropdown(
            "Show the error", [NO_ERROR, ABSOLUTE, FLIP], initial_value=NO_ERROR,
            hint="Bright is wrong. FLIP is how visible it is to people. Where the truth is known. Key: E",
        )  # fmt: skip
        self.render = self.gui.add_button(
            "Render truth here", hint="Path-traces this pose from this side; takes some seconds."
        )
        self.progress = self.gui.add_progress_bar(0, visible=False, animated=True)
        self.truth_words = self.gui.add_markdown("")
        self._on(self.left, lambda value: self._set(left=str(value)))
        self._on(self.right, lambda value: self._choose_right(str(value)))
        self._on(self.error, lambda value: self._set(error=str(value)))
        self.render.on_click(lambda _: self.ask_truth())

    def _build_pose(self) -> None:
        self.gui.add_markdown("Hold a joint as you like, and see whether the avatar bears it; the others go on moving.")
        self.joint_names = [name.replace("_", " ") for name in self.capture.skeleton.names]
        self.joint = self.gui.add_dropdown(
            "Joint",
            [NO_JOINT, *self.joint_names],
            initial_value=NO_JOINT,
            hint="Joints that you hold are marked in the skeleton.",
        )
        self.turns = [
            self.gui.add_slider(f"About {axis.lower()}", -UNKNOWN, UNKNOWN, 0.5, 0.0, visible=False) for axis in ORDER
        ]
        self.reset_joint = self.gui.add_button("Reset this joint", visible=False)
        self.reset_pose = self.gui.add_button("Reset all joints")
        self._on(self.joint, lambda _: self._choose_joint())
        for number, slider in enumerate(self.turns):
            self._on(slider, lambda value, number=number: self._turn(number, float(value)))
        self.reset_joint.on_click(lambda _: self._reset(self._joint_index()))
        self.reset_pose.on_click(lambda _: self._reset(None))

    def _build_view(self) -> None:
        self.mesh = self.gui.add_checkbox("Template mesh", False, hint="The surface that carries the Gaussians.")
        self.skeleton = self.gui.add_checkbox("Skeleton", False, hint="The joints that the pose turns.")
        self.ellipsoids = self.gui.add_checkbox(
            "Gaussians as ellipsoids", False, hint="Each one small and opaque, so that it can be told from the others."
        )
        self.dark = self.gui.add_checkbox(
            "Dark", False, hint="Page and background; at first as your system has it. Keys: D and L"
        )
        self._on(self.mesh, lambda value: self._set(mesh=bool(value)))
        self._on(self.skeleton, lambda value: self._set(skeleton=bool(value)))
        self._on(self.ellipsoids, lambda value: self._set(ellipsoids=bool(value)))
        self._on(self.dark, lambda value: self._darken(bool(value)))

    def _build_keys(self) -> None:
        titles = list(self.painter.cast.titles)
        for label, key, act in (
            ("Play or pause", "space", lambda: self._press(TOGGLE)),
            ("Next frame", "arrowright", lambda: self._press(AHEAD)),
            ("Previous frame", "arrowleft", lambda: self._press(BACK)),
            ("Next avatar", "M", lambda: self._next(self.left, titles)),
            ("Next camera", "C", lambda: self._next(self.camera, self._cameras())),
            ("Truth beside it", "T", lambda: self._next(self.right, [NOTHING, TRUTH])),
            ("Dark", "D", lambda: self._darken(True)),
            ("Light", "L", lambda: self._darken(False)),
            ("Error", "E", lambda: self._next(self.error, [NO_ERROR, ABSOLUTE, FLIP])),
        ):
            command = self.gui.add_command(label, hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(lambda _, act=act: act())

    def _on(self, control: viser.GuiInputHandle, act: Callable[[Any], None]) -> None:
        """Call `act` when the viewer changes a control, and not when we do so ourselves."""

        @control.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                act(event.target.value)

    # ---------------------------------------------------------------------------------------------------------------
    # What controls do

    def _set(self, **changes: object) -> None:
        self.viewer.change(lambda state: replace(state, **changes))  # type: ignore[arg-type]

    def _next(self, control: viser.GuiDropdownHandle, choices: list[str]) -> None:
        at = choices.index(control.value) if control.value in choices else -1
        control.value = choices[(at + 1) % len(choices)]
        if control is self.camera:
            self.standpoint.jump(control.value)
        elif control is self.right:
            self._choose_right(control.value)
        else:
            self._set(**{"left" if control is self.left else "error": control.value})

    def _press(self, button: str) -> None:
        def press(state: ViewState) -> ViewState:
            if button == TOGGLE:
                length = len(self.painter.acts[state.act])
                at_end = not state.loop and state.step == length - 1
                return replace(state, playing=not state.playing, step=0 if at_end and not state.playing else state.step)
            steps = 1 if button == AHEAD else -1
            return replace(state, playing=False, loop=True).stepped(steps, len(self.painter.acts[state.act]))

        loop = self.viewer.state.loop
        self.viewer.change(lambda state: replace(press(state), loop=loop))

    def _choose_act(self, value: object) -> None:
        index = [act.title for act in self.painter.acts].index(str(value))
        self.step.max = max(1, len(self.painter.acts[index]) - 1)
        self._set(act=index, step=0)

    def _choose_right(self, value: str) -> None:
        self.divider.visible = value != NOTHING
        self._set(right=value)

    def _joint_index(self) -> int | None:
        return None if self.joint.value == NO_JOINT else self.joint_names.index(self.joint.value)

    def _choose_joint(self) -> None:
        joint = self._joint_index()
        self.reset_joint.visible = joint is not None
        ranges = (None,) * len(self.turns) if joint is None else ranges_of(self.capture.skeleton.names[joint])
        for slider, limits in zip(self.turns, ranges, strict=True):
            slider.visible = limits is not None
            if limits is not None:
                slider.min, slider.max, slider.label = limits.low, limits.high, limits.more.capitalize()
                slider.hint = f"Degrees: {limits.high:g} {limits.more}, {limits.low:g} {limits.less}."
        self._show_angles(self.viewer.state)

    def _show_angles(self, state: ViewState) -> None:
        """Put the sliders where the chosen joint is; at an end, where the motion goes beyond."""
        joint = self._joint_index()
        for slider, angle in zip(self.turns, self._angles(state, joint) if joint is not None else (), strict=False):
            slider.value = min(max(angle, slider.min), slider.max)
        self._angles_shown = joint, state.act, state.step

    def _angles(self, state: ViewState, joint: int) -> Angles:
        """The angles at which a joint is held, or to which the motion has it turned."""
        act = self.painter.acts[state.act]
        rotvec = act.motion.dofs[act.frames[state.step], 3 + 3 * joint : 6 + 3 * joint]
        return dict(state.held).get(joint) or angles_of(self.capture.skeleton, joint, rotvec)

    def _turn(self, number: int, degrees: float) -> None:
        joint = self._joint_index()
        if joint is not None:
            x, z, y = (degrees if i == number else a for i, a in enumerate(self._angles(self.viewer.state, joint)))
            self.viewer.change(lambda state: state.with_held(joint, (x, z, y)))

    def _reset(self, joint: int | None) -> None:
        self._show_angles(self.viewer.change(lambda state: state.without_held(joint)))

    def _darken(self, dark: bool) -> None:
        self.dark.value = dark
        self.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self._set(dark=dark)

    def ask_truth(self) -> None:
        """Render the truth of what is seen, and put it beside the avatar."""
        self.truth_words.content = self.render_truth(self.viewer)
        if self.viewer.state.right == NOTHING:
            self.right.value = TRUTH
            self._choose_right(TRUTH)

    def truth_progress(self, words: str, share: float | None) -> None:
        """How far a picture of the truth is; None: it came or failed."""
        with gone_is_fine(self.client):
            self.progress.visible = share is not None
            self.progress.value = 100 * (share or 0.0)
            self.truth_words.content = words

    # ---------------------------------------------------------------------------------------------------------------
    # What the page says

    def _camera_is(self, name: str) -> None:
        if self.camera.value != name:
            self.camera.value = name

    def show(self, state: ViewState, drawn: Painting | None, words: str) -> None:
        """A picture was sent, or could not be drawn (None), and `words` say more."""
        self.step.value = state.step
        if drawn is None:
            self.words.content = f"**This could not be drawn.** {_plain(words)}"
            return
        now = time.perf_counter()
        still = not state.playing
        if still or now - self._said > WORDS_SECONDS:
            self._said = now
            self.title.content = self._headline(state, drawn.score)
            self.words.content = _plain(words) + (f"\n\n{drawn.note}" if drawn.note else "")
        joint = self._joint_index()
        if still and self._angles_shown != (joint, state.act, state.step) and joint not in dict(state.held):
            self._show_angles(state)

    def _headline(self, state: ViewState, score: str) -> str:
        act = self.painter.acts[state.act]
        where = f"{act.title}, frame {state.step + 1} of {len(act)}"
        compared = f"\n\nAgainst the truth: **{_plain(score)}**" if score else ""
        return f"**{_plain(state.left)}** · {_plain(where)}{compared}"


def _plain(text: str) -> str:
    """Without what Markdown or HTML would take for its own: names come from files."""
    for mark in "\\`*_{}[]<>#|":
        text = text.replace(mark, f"\\{mark}" if mark != "<" else "&lt;")
    return text
