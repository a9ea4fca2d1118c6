"""From what a viewer looks at to the picture: avatars, truth, divider, errors and overlays, all drawn here."""

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Camera, Motion, Pose
from ash.mesh.rasterizing import rasterize_mesh
from ash.protocol import StageClock
from benchmarks.cell import metrics
from benchmarks.play.actors import Actor, Cast, on_colour
from benchmarks.play.cameras import resized, spiral_camera
from benchmarks.play.joints import held
from benchmarks.play.motions import Act, joint_heads
from benchmarks.play.shelf import TruthPicture, TruthShelf
from benchmarks.play.state import ABSOLUTE, FREE, NO_ERROR, NOTHING, SPIRAL, TRUTH, ViewState

LIGHT, DARK = (236, 236, 236), (24, 26, 30)  # behind the subject
INK = {False: (20, 25, 35), True: (235, 238, 242)}
MESH, BONE, JOINT, HELD_JOINT = (47, 111, 222), (221, 107, 32), (255, 255, 255), (255, 60, 60)
LINE = 1 / 900  # of the picture's height: how wide a triangle's outline is drawn, at least a pixel
CLEAR = 6.0  # lines' widths between a triangle's edges, below which its outline fades: a dense mesh veils nothing
ERROR_WHITE = {ABSOLUTE: 0.3, "FLIP": 0.7}  # the error at which the map's colours end
UNKNOWN_TRUTH = (
    "No truth of this view yet: press *Render truth here* under *Compare*, "
    "or look through one of the capture's cameras."
)
SCORES_KEPT = 256
NAMES_AT = 0.94  # of the height, from the top: above the bar that a phone has at the bottom
NEAR = 0.01  # metres, of depth: nearer is not drawn


@dataclass(frozen=True, kw_only=True, slots=True)
class Painting:
    """A picture and what is to be said about it."""

    pixels: np.ndarray  # uint8 [h, w, 3]
    stage_ms: dict[str, float]  # of the left avatar
    score: str  # against the truth, empty where it is not known
    note: str  # why something asked for is not there


class Painter:
    """Draws states. One thread uses it."""

    def __init__(self, cast: Cast, acts: tuple[Act, ...], shelf: TruthShelf) -> None:
        self.cast, self.acts, self.shelf = cast, acts, shelf
        self._held: tuple[tuple, Motion] | None = None
        self._scores: OrderedDict[tuple, tuple[float, float, np.ndarray | None]] = OrderedDict()

    def draw(self, state: ViewState, *, width: int, height: int, careful: bool) -> Painting:
        """The picture at a size. `careful`: the viewer stands still, and there is time for scores.

        Raises:
            InputError, FloatingPointError, ...: whatever an avatar raises.
        """
        act = self.acts[state.act]
        motion, frame = self.motion(act, state), act.frames[state.step]
        camera = self.camera(state, width=width, height=height)
        truth = self.shelf.find(act, state)
        clock, note = StageClock(), ""
        pose = Pose(motion, frame)
        if truth is None and (state.error != NO_ERROR or state.right == TRUTH):
            note = UNKNOWN_TRUTH
        pixels = left = self._side(state, state.left, pose, truth, camera, clock)
        if state.right == TRUTH:
            shown = _blank(camera, state, "No truth of\nthis view yet") if truth is None else _fit(truth, camera, state)
            pixels = _divided(left, shown, state)
        elif state.right != NOTHING:
            pixels = _divided(left, self._side(state, state.right, pose, truth, camera, StageClock()), state)
        if state.mesh or state.skeleton:
            pixels, missing = self._overlaid(pixels, state, pose, camera)
            note = missing or note
        score = self._score(state, pose, truth) if truth is not None and careful else ""
        return Painting(pixels=pixels, stage_ms=dict(clock.ms), score=score, note=note)

    def camera(self, state: ViewState, *, width: int, height: int) -> Camera:
        """The camera that the viewer looks through, in pixels of the picture."""
        own = self.cast.capture.cameras.get(state.camera)
        if own is not None:
            return resized(own, width=width, height=height)
        if state.camera == SPIRAL:
            return spiral_camera(self.cast.capture, state.angle, width=width, height=height)
        assert state.camera == FREE and state.eye is not None
        return state.eye.camera(width=width, height=height)

    def motion(self, act: Act, state: ViewState) -> Motion:
        """The act's motion, with the joints that the viewer holds; the last one is kept."""
        if not state.held:
            return act.motion
        key = (act.name, state.held)
        if self._held is None or self._held[0] != key:
            self._held = key, held(act.motion, self.cast.capture.skeleton, dict(state.held))
        return self._held[1]

    def _side(
        self, state: ViewState, title: str, pose: Pose, truth: TruthPicture | None, camera: Camera, clock: StageClock
    ) -> np.ndarray:
        """An avatar, or its error where that is wanted and the truth is known."""
        actor = self.cast.actor(title)
        draw = actor.ellipsoids if state.ellipsoids else actor.view
        drawn = draw(pose, camera, clock, DARK if state.dark else LIGHT)
        return drawn if truth is None or state.error == NO_ERROR else self._error(state, title, pose, truth, camera)

    def _compared(
        self, state: ViewState, title: str, pose: Pose, truth: TruthPicture
    ) -> tuple[float, float, np.ndarray | None]:
        """PSNR and FLIP on the foreground in the truth's own pixels, as the protocol has them; the error's map."""
        key = (title, truth.key, state.error)
        if key not in self._scores:
            self._scores[key] = _compare(self.cast.actor(title), pose, truth, state.error)
            if len(self._scores) > SCORES_KEPT:
                self._scores.popitem(last=False)
        return self._scores[key]

    def _score(self, state: ViewState, pose: Pose, truth: TruthPicture) -> str:
        titles = [state.left, *([state.right] if state.right in self.cast.titles else [])]
        rows = [(title, *self._compared(state, title, pose, truth)[:2]) for title in titles]
        return " · ".join(f"{title} {psnr:.1f} dB, FLIP {flip:.3f}" for title, psnr, flip in rows)

    def _error(self, state: ViewState, title: str, pose: Pose, truth: TruthPicture, camera: Camera) -> np.ndarray:
        error = self._compared(state, title, pose, truth)[2]
        assert error is not None
        alpha = np.where(truth.on_black[..., 3:] > 0, 255, 0).astype(np.uint8)
        heat = np.concatenate([_heat(error / ERROR_WHITE[state.error]), np.maximum(alpha, _visible(error))], axis=-1)
        shown = TruthPicture(camera=truth.camera, on_black=metrics.on_black(heat))
        return _fit(shown, camera, state)

    def _overlaid(self, pixels: np.ndarray, state: ViewState, pose: Pose, camera: Camera) -> tuple[np.ndarray, str]:
        """With the template's triangles and the skeleton on top, and what of it is not there."""
        missing = ""
        if state.mesh:
            vertices = self.cast.actor(state.left).template(pose)
            if vertices is None:
                missing = f"{state.left} shows no template mesh."
            else:
                pixels = _with_mesh(pixels, vertices, self.cast.capture.template.faces, camera)
        if state.skeleton:
            heads = joint_heads(self.cast.capture, pose)
            pixels = _with_skeleton(pixels, heads, self.cast.capture.skeleton.parents, camera, state)
        return pixels, missing


def _compare(actor: Actor, pose: Pose, truth: TruthPicture, error: str) -> tuple[float, float, np.ndarray | None]:
    drawn = metrics.quantise(actor.picture(pose, truth.camera, StageClock()))
    ours, theirs = drawn[..., :3], truth.on_black[..., :3]
    mask, flip = metrics.foreground(truth.on_black), metrics.flip_map(ours, theirs)
    mean_flip = float(flip[mask].mean()) if mask.any() else 0.0
    shown = None
    if error == ABSOLUTE:
        shown = np.abs(ours.astype(np.float32) - theirs).mean(axis=-1) / 255
    elif error != NO_ERROR:
        shown = flip
    return metrics.psnr(ours, theirs, mask), mean_flip, shown


def _heat(share: np.ndarray) -> np.ndarray:
    from matplotlib import colormaps

    return np.rint(np.asarray(colormaps["magma"](np.clip(share, 0, 1)))[..., :3] * 255).astype(np.uint8)


def _visible(error: np.ndarray) -> np.ndarray:
    """Errors beside the person are seen as well."""
    return np.where(error > 0.02, 255, 0).astype(np.uint8)[..., None]


def _fit(picture: TruthPicture, camera: Camera, state: ViewState) -> np.ndarray:
    """A picture taken by one camera, in the pixels of another that stands and looks alike."""
    scale = camera.K[0, 0] / picture.camera.K[0, 0]
    size = (max(1, round(picture.camera.width * scale)), max(1, round(picture.camera.height * scale)))
    left, top = np.rint(camera.K[:2, 2] - scale * picture.camera.K[:2, 2]).astype(int).tolist()
    sheet = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    for channel in range(4):  # Each by itself: as RGBA, colours would be taken for straight ones.
        whole = Image.fromarray(picture.on_black[..., channel].astype(np.float32) / 255)
        page = Image.new("F", (camera.width, camera.height))
        page.paste(whole.resize(size, Image.Resampling.BICUBIC), (left, top))
        sheet[..., channel] = np.asarray(page)
    return on_colour(sheet, DARK if state.dark else LIGHT)


def _blank(camera: Camera, state: ViewState, text: str) -> np.ndarray:
    sheet = Image.new("RGB", (camera.width, camera.height), DARK if state.dark else LIGHT)
    room, longest = (1 - state.divider) * camera.width, max(map(len, text.splitlines()))
    size = max(10, min(camera.height / 32, 1.5 * room / longest))
    place = (state.divider * camera.width + size, camera.height / 3)  # Above the divider's handle, off the panel.
    font = ImageFont.load_default(size)
    ImageDraw.Draw(sheet).text(place, text, fill=INK[state.dark], font=font, anchor="lm")
    return np.asarray(sheet)


def _divided(left: np.ndarray, right: np.ndarray, state: ViewState) -> np.ndarray:
    """The left picture, the right one, a line between them, and their names."""
    height, width = left.shape[:2]
    column = round(state.divider * width)
    sheet = Image.fromarray(np.concatenate([left[:, :column], right[:, column:]], axis=1))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(max(10, height // 32))
    pen.line([(column, 0), (column, height)], fill=INK[state.dark], width=max(1, height // 300))
    gap = max(6, height // 60)
    name = "Truth" if state.right == TRUTH else state.right
    base = round(NAMES_AT * height)
    pen.text((column - gap, base), state.left, fill=INK[state.dark], font=font, anchor="rs")
    pen.text((column + gap, base), name, fill=INK[state.dark], font=font, anchor="ls")
    return np.asarray(sheet)


@lru_cache(maxsize=2)
def _faces(content: bytes) -> torch.Tensor:
    return torch.from_numpy(np.frombuffer(content, dtype=np.int64).reshape(-1, 3).copy())


def _with_mesh(pixels: np.ndarray, vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """The nearest triangles' outlines, as wide everywhere, with soft edges."""
    height, width = pixels.shape[:2]
    seen = vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    homogeneous = (seen @ camera.K.T).astype(np.float32)
    drawn = rasterize_mesh(
        torch.from_numpy(homogeneous),
        _faces(faces.tobytes()),
        width=width,
        height=height,
        threads=torch.get_num_threads(),
    )
    triangle = drawn.triangle.numpy()
    covered = triangle >= 0
    heights = _heights(homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR), faces)[triangle[covered]]
    line = max(1.0, LINE * height)
    inside = (drawn.barycentric.numpy()[covered] * heights).min(axis=1)  # pixels to the nearest edge
    opacity = np.clip((line + 1) / 2 - inside, 0, 1) * np.clip(heights.min(axis=1) / (CLEAR * line), 0, 1)
    result = pixels.copy()
    mixed = pixels[covered] + opacity[:, None] * (np.array(MESH, dtype=np.float32) - pixels[covered])
    result[covered] = np.rint(mixed).astype(np.uint8)
    return result


def _heights(corners: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """How far each corner of each triangle lies from the edge opposite, `[f, 3]` pixels."""
    triangles = corners[faces]
    edges = np.roll(triangles, -1, axis=1) - np.roll(triangles, 1, axis=1)  # opposite each corner
    twice_area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    return twice_area[:, None] / np.maximum(np.linalg.norm(edges, axis=2), 1e-6)


def _with_skeleton(
    pixels: np.ndarray, heads: np.ndarray, parents: np.ndarray, camera: Camera, state: ViewState
) -> np.ndarray:
    sheet = Image.fromarray(pixels)
    pen, size = ImageDraw.Draw(sheet), max(2, pixels.shape[0] // 150)
    places, depth = camera.project(heads)
    turned = {joint for joint, _ in state.held}
    for joint, parent in enumerate(parents):
        if parent >= 0 and min(depth[joint], depth[parent]) > 0.05:
            pen.line([tuple(places[parent]), tuple(places[joint])], fill=BONE, width=size)
    for joint, (x, y) in enumerate(places):
        if depth[joint] > 0.05:
            colour = HELD_JOINT if joint in turned else JOINT
            pen.ellipse([x - size, y - size, x + size, y + size], fill=colour, outline=BONE)
    return np.asarray(sheet)
