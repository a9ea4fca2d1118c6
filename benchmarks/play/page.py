"""The page beside the picture: what a viewer can turn, in words for somebody who never read the paper."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser
import viser._messages as messages
from scipy.spatial.transform import Rotation

from ash.capture.dataset import Camera
from benchmarks.play.cameras import resized
from benchmarks.play.picture import Drawn, Painter
from benchmarks.play.state import ABSOLUTE, FLIP, FREE, NO_ERROR, NOTHING, SPIRAL, TRUTH, Eye, State
from benchmarks.play.viewer import Viewer, gone_is_fine

MOST_BEND_DEG = 90
WORDS_SECONDS = 0.3  # between two changes of the line of numbers: faster nobody reads
SETTLE_SECONDS = 0.6  # after a jump, in which the browser may still report where it was
SAME_M, SAME_DEG = 0.01, 0.6
SPEEDS = {"1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0}
NO_JOINT = "(choose a joint)"
BACK, TOGGLE, AHEAD = "◀", "Play / pause", "▶"

LABEL = "ash-bench play"
# On a narrow screen viser opens its panel over the person; a touch on its bar opens it again.
PICTURE_FIRST = f"""
document.title = "{LABEL}";
let tries = window.innerWidth < 576 ? 25 : 0;
function fold() {{
  const bar = [...document.querySelectorAll("*")].find((e) => !e.childElementCount && e.textContent === "{LABEL}");
  if (bar) bar.click(); else if (tries-- > 0) setTimeout(fold, 200);
}}
if (tries) setTimeout(fold, 800);
"""

HELP = """\
**Look around**: drag to turn, right-drag or two fingers to move, wheel or pinch to come closer.

**Keys**: space plays and pauses, ← and → go frame by frame, M is the next avatar, C the next camera, T the truth \
beside it, E the error, D dark.

**What you see** is an avatar that learned from films of a synthetic person. It is given only a pose and a camera. \
Because the person is synthetic, the *truth* is known too: put it beside the avatar under *Compare*, for any pose and \
from any side.

**While you move**, the picture is coarser, so that it stays smooth; it is sharp again once you let go.
"""


class Page:
    """Builds the controls of one browser, and keeps them in step with its state."""

    def __init__(self, viewer: Viewer, painter: Painter, render_truth: Callable[[Viewer], str]) -> None:
        """`render_truth` begins a picture of the truth of what the viewer sees, and says what came of that."""
        self.viewer, self.painter, self.render_truth = viewer, painter, render_truth
        self.capture = painter.cast.capture
        self.client, self.gui = viewer.client, viewer.client.gui
        self._jumped: tuple[float, np.ndarray] | None = None
        self._said = 0.0
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._build()
        self.client._websock_connection.queue_message(messages.RunJavascriptMessage(PICTURE_FIRST))
        viewer.show = self.show
        self.client.camera.on_update(self._moved)
        first = eye_of(self.client.camera)  # What it told before anybody listened; it may never say it again.
        viewer.change(lambda state: replace(state, eye=state.eye or first))

    # ---------------------------------------------------------------------------------------------------------------
    # Controls

    def _build(self) -> None:
        self.title = self.gui.add_markdown(self._headline(self.viewer.state, ""))
        self.words = self.gui.add_markdown("*loading the avatar ...*")
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
        self._on(self.camera, lambda value: self.jump(str(value)))
        self._on(self.frustums, lambda value: self._show_frustums(bool(value)))

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
        self.divider = self.gui.add_slider(
            "Divider", 0.0, 1.0, 0.01, 0.5, hint="Move it over the picture.", visible=False
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
        self._on(self.divider, lambda value: self._set(divider=float(value)))
        self._on(self.error, lambda value: self._set(error=str(value)))
        self.render.on_click(lambda _: self.ask_truth())

    def _build_pose(self) -> None:
        self.gui.add_markdown("Turn a joint further than the motion does, and see whether the avatar bears it.")
        names = [NO_JOINT, *self.capture.skeleton.names]
        self.joint = self.gui.add_dropdown(
            "Joint", names, initial_value=NO_JOINT, hint="Turned joints are marked in the skeleton."
        )
        self.bends = [
            self.gui.add_slider(
                f"About {axis}", -MOST_BEND_DEG, MOST_BEND_DEG, 1, 0, hint=f"Degrees, {words}.", visible=False
            )
            for axis, words in (("x", "forward and back"), ("y", "about the body's length"), ("z", "sideways"))
        ]
        self.reset_joint = self.gui.add_button("Reset this joint", visible=False)
        self.reset_pose = self.gui.add_button("Reset all joints")
        self._on(self.joint, lambda _: self._choose_joint())
        for slider in self.bends:
            self._on(slider, lambda _: self._bend())
        self.reset_joint.on_click(lambda _: self._reset(self._joint_index()))
        self.reset_pose.on_click(lambda _: self._reset(None))

    def _build_view(self) -> None:
        self.mesh = self.gui.add_checkbox("Template mesh", False, hint="The surface that carries the Gaussians.")
        self.skeleton = self.gui.add_checkbox("Skeleton", False, hint="The joints that the pose turns.")
        self.ellipsoids = self.gui.add_checkbox(
            "Gaussians as ellipsoids", False, hint="Each one small and opaque, so that it can be told from the others."
        )
        self.dark = self.gui.add_checkbox("Dark", False, hint="Page and background. Key: D")
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
            ("Dark", "D", self._toggle_dark),
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
            self.jump(control.value)
        elif control is self.right:
            self._choose_right(control.value)
        else:
            self._set(**{"left" if control is self.left else "error": control.value})

    def _press(self, button: str) -> None:
        def press(state: State) -> State:
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
        return None if self.joint.value == NO_JOINT else self.capture.skeleton.names.index(self.joint.value)

    def _choose_joint(self) -> None:
        joint = self._joint_index()
        for slider, degrees in zip(self.bends, self.viewer.state.bend_of(-1 if joint is None else joint), strict=True):
            slider.visible = joint is not None
            slider.value = round(degrees)
        self.reset_joint.visible = joint is not None

    def _bend(self) -> None:
        joint = self._joint_index()
        if joint is not None:
            x, y, z = (float(slider.value) for slider in self.bends)
            self.viewer.change(lambda state: state.with_bend(joint, (x, y, z)))

    def _reset(self, joint: int | None) -> None:
        kept = () if joint is None else tuple(bend for bend in self.viewer.state.bends if bend[0] != joint)
        self._set(bends=kept)
        for slider in self.bends:
            slider.value = 0

    def _toggle_dark(self) -> None:
        self.dark.value = not self.dark.value
        self._darken(self.dark.value)

    def _darken(self, dark: bool) -> None:
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
    # Cameras

    def jump(self, name: str) -> None:
        """Look through one of the capture's cameras, follow the spiral, or look around freely from here."""
        own, eye = self.capture.cameras.get(name), self.viewer.state.eye
        if own is not None and eye is not None:
            self._place_browser(resized(own, width=eye.width, height=eye.height))
        self._show_frustums(self.frustums.value, without=name)
        self._set(camera=name)

    def _place_browser(self, camera: Camera) -> None:
        """Put the browser's own camera there, so that turning goes on from it."""
        rotation = camera.viewmat[:3, :3]
        middle = self.capture.template.vertices.mean(axis=0)
        depth = float(rotation[2] @ (middle - camera.position))
        self._jumped = time.perf_counter(), camera.viewmat
        with self.client.atomic():
            self.client.camera.fov = 2 * float(np.arctan2(camera.height / 2, camera.K[1, 1]))
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
            return
        first = self.viewer.state.eye is None
        resized_only = not first and np.array_equal(eye.viewmat, self.viewer.state.eye.viewmat)  # type: ignore[union-attr]
        self.viewer.change(
            lambda state: replace(state, eye=eye, camera=state.camera if first or resized_only else FREE)
        )
        if self.camera.value != self.viewer.state.camera:
            self.camera.value = FREE

    def _is_where_it_jumped(self, eye: Eye) -> bool:
        if self._jumped is None or self.viewer.state.camera not in self.capture.cameras:
            return False
        when, viewmat = self._jumped
        if time.perf_counter() - when < SETTLE_SECONDS:
            return True
        place = -viewmat[:3, :3].T @ viewmat[:3, 3]
        turn = Rotation.from_matrix(viewmat[:3, :3] @ eye.viewmat[:3, :3].T).magnitude()
        return bool(np.linalg.norm(place - eye.position) < SAME_M and np.rad2deg(turn) < SAME_DEG)

    def _show_frustums(self, wanted: bool, without: str = "") -> None:
        for handle in self._frustums:
            handle.remove()
        self._frustums = []
        for name, camera in self.capture.cameras.items() if wanted else ():
            if name == without:
                continue
            held_out = name not in self.capture.splits["train"].cameras
            quat = Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat()
            handle = self.client.scene.add_camera_frustum(
                f"/cameras/{name}",
                fov=2 * float(np.arctan2(camera.height / 2, camera.K[1, 1])),
                aspect=camera.width / camera.height,
                scale=0.12,
                color=(221, 107, 32) if held_out else (47, 111, 222),
                wxyz=quat[[3, 0, 1, 2]],
                position=camera.position,
            )
            handle.on_click(lambda _, name=name: self._clicked(name))
            self._frustums.append(handle)

    def _clicked(self, name: str) -> None:
        self.camera.value = name
        self.jump(name)

    # ---------------------------------------------------------------------------------------------------------------
    # What the page says

    def show(self, state: State, drawn: Drawn | None, words: str) -> None:
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

    def _headline(self, state: State, score: str) -> str:
        act = self.painter.acts[state.act]
        where = f"{act.title}, frame {state.step + 1} of {len(act)}"
        compared = f"\n\nAgainst the truth: **{_plain(score)}**" if score else ""
        return f"**{_plain(state.left)}** · {_plain(where)}{compared}"


def eye_of(camera: viser.CameraHandle) -> Eye | None:
    """What a browser's camera sees; None for numbers that no camera has."""
    if camera.image_width < 16 or camera.image_height < 16 or not 0.01 < camera.fov < 3.0:
        return None
    if not (np.isfinite(camera.position).all() and np.isfinite(camera.wxyz).all() and np.linalg.norm(camera.wxyz) > 0):
        return None
    w, x, y, z = camera.wxyz
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ camera.position
    return Eye(
        viewmat=viewmat,
        fov=float(camera.fov),
        width=min(int(camera.image_width), 8192),
        height=min(int(camera.image_height), 8192),
    )


def _plain(text: str) -> str:
    """Without what Markdown or HTML would take for its own: names come from files."""
    for mark in "\\`*_{}[]<>#|":
        text = text.replace(mark, f"\\{mark}" if mark != "<" else "&lt;")
    return text
