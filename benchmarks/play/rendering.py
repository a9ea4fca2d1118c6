"""From what a viewer looks at to the picture: avatars, truth, divider, errors and overlays, all drawn here."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Camera, Motion, Pose
from ash.mesh.rasterizing import rasterize_mesh
from ash.protocol import StageClock
from benchmarks.cell import metrics
from benchmarks.play.avatars import AvatarSet, Colour, composite
from benchmarks.play.cameras import FREE, SPIRAL, Viewpoint, resized, spiral_camera
from benchmarks.play.motions import Angles, MotionClip, with_angles
from benchmarks.play.truth import PoseKey, TruthCache, TruthPicture
from synth.posing import bone_frames

NOTHING, TRUTH = "nothing", "the truth"
LIGHT, DARK = (236, 236, 236), (24, 26, 30)  # behind the subject
MESH, BONE, JOINT, TURNED_JOINT = (47, 111, 222), (221, 107, 32), (255, 255, 255), (255, 60, 60)
LINE = 1 / 900  # of the picture's height: the width of a triangle's outline, at least a pixel
FADE_WIDTHS = 6.0  # outlines fade where a triangle is narrower than so many of them: a dense mesh hides nothing
FLIP_WHITE = 0.7  # the error at which the map's colours end
FLIP_SHOWN = 0.02  # from here on an error beside the person is shown
UNKNOWN_TRUTH = (
    "No truth of this view yet: press *Render truth here* under *Compare*, "
    "or look through one of the capture's cameras."
)
CACHED_SCORES = 256
NAMES_AT = 0.94  # of the height, from the top: above the bar that a phone has at the bottom
NEAR = 0.01  # metres, of depth: nearer is not drawn


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewState:
    """Everything that decides a viewer's picture; replaced as a whole whenever something changes."""

    clip: int = 0  # index of the motion
    step: int = 0  # of the clip
    playing: bool = True
    speed: float = 1.0
    loop: bool = True
    left: str  # an avatar
    right: str = NOTHING  # nothing, the truth, or another avatar
    divider: float = 0.5  # share of the width that is the left one's
    error: bool = False  # the map of FLIP in place of the avatars
    mesh: bool = False
    skeleton: bool = False
    turned: tuple[tuple[int, Angles], ...] = ()  # joints that the viewer turned, and their angles
    dark: bool = False
    camera: str = FREE  # or spiral, or one of the capture's
    spiral_step: float = 0.0
    viewpoint: Viewpoint | None = field(default=None, compare=False)  # None until the browser has sent it

    @property
    def background(self) -> Colour:
        """The colour behind the subject."""
        return DARK if self.dark else LIGHT

    @property
    def ink(self) -> Colour:
        """The colour of lines and names."""
        return (235, 238, 242) if self.dark else (20, 25, 35)

    def with_joint(self, joint: int, angles: Angles) -> "ViewState":
        """With one joint turned to angles, in all frames."""
        return replace(self, turned=tuple(sorted((dict(self.turned) | {joint: angles}).items())))

    def without_joint(self, joint: int | None) -> "ViewState":
        """With one joint as the motion has it again; None: with all."""
        return replace(self, turned=tuple(each for each in self.turned if joint is not None and each[0] != joint))

    def advanced(self, steps: int, length: int) -> "ViewState":
        """So many frames further; at the ends, around again or stopped, as `loop` says."""
        wanted = self.step + steps
        if self.loop:
            return replace(self, step=wanted % length)
        return replace(self, step=min(max(wanted, 0), length - 1), playing=self.playing and 0 <= wanted < length - 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class RenderedView:
    """A picture and what is to be said about it."""

    pixels: np.ndarray  # uint8 [h, w, 3]
    stage_ms: dict[str, float]  # of the left avatar
    score: str  # against the truth, empty where it is not known
    note: str  # why something asked for is not there


class ViewRenderer:
    """Renders states. One thread uses it."""

    def __init__(self, avatars: AvatarSet, clips: tuple[MotionClip, ...], truths: TruthCache) -> None:
        self.avatars, self.clips, self.truths = avatars, clips, truths
        self._turned: tuple[tuple, Motion] | None = None
        self._scores: OrderedDict[tuple, tuple[float, float, np.ndarray]] = OrderedDict()

    def render(self, state: ViewState, *, width: int, height: int, with_scores: bool) -> RenderedView:
        """The picture at a size; with scores where there is time for them.

        Raises:
            InputError, FloatingPointError, ...: whatever an avatar raises.
        """
        camera, pose = self.camera(state, width=width, height=height), self.pose(state)
        truth = self.truths.find(self.pose_key(state), self.clips[state.clip], camera)
        unknown = truth is None and (state.error or state.right == TRUTH)
        note, clock = UNKNOWN_TRUTH if unknown else "", StageClock()
        pixels = left = self._side(state, state.left, pose, truth, camera, clock)
        if state.right == TRUTH:
            empty = np.full_like(left, state.background)
            pixels = _divided(left, empty if truth is None else fitted(truth, camera, state.background), state)
        elif state.right != NOTHING:
            pixels = _divided(left, self._side(state, state.right, pose, truth, camera, StageClock()), state)
        if state.mesh:
            vertices = self.avatars[state.left].template(pose)
            if vertices is None:
                note = f"{state.left} shows no template mesh."
            else:
                pixels = with_mesh(pixels, vertices, self.avatars.capture.template.faces, camera)
        if state.skeleton:
            parents = self.avatars.capture.skeleton.parents
            pixels = _with_skeleton(pixels, self.joint_positions(pose), parents, camera, {j for j, _ in state.turned})
        score = ""
        if truth is not None and with_scores:
            titles = [state.left, *([state.right] if state.right in self.avatars.titles else [])]
            rows = [(title, *self._compared(title, pose, truth)[:2]) for title in titles]
            score = " · ".join(f"{title} {psnr:.1f} dB, FLIP {flip:.3f}" for title, psnr, flip in rows)
        return RenderedView(pixels=pixels, stage_ms=dict(clock.ms), score=score, note=note)

    def camera(self, state: ViewState, *, width: int, height: int) -> Camera:
        """The camera that the viewer looks through, in pixels of the picture."""
        own = self.avatars.capture.cameras.get(state.camera)
        if own is not None:
            return resized(own, width=width, height=height)
        if state.camera == SPIRAL:
            return spiral_camera(self.avatars.capture, state.spiral_step, width=width, height=height)
        assert state.camera == FREE and state.viewpoint is not None
        return state.viewpoint.camera(width=width, height=height)

    def pose(self, state: ViewState) -> Pose:
        """The frame of the clip, with the joints that the viewer turned; the last such motion is kept."""
        clip = self.clips[state.clip]
        motion, key = clip.motion, (clip.name, state.turned)
        if state.turned:
            if self._turned is None or self._turned[0] != key:
                self._turned = key, with_angles(motion, dict(state.turned))
            motion = self._turned[1]
        return Pose(motion, clip.frames[state.step])

    def pose_key(self, state: ViewState) -> PoseKey:
        """Equal for equal poses."""
        clip = self.clips[state.clip]
        return clip.name, clip.frames[state.step], state.turned

    def joint_positions(self, pose: Pose) -> np.ndarray:
        """Where the joints are in a frame, `[j, 3]` metres."""
        dofs = pose.motion.dofs[pose.frame : pose.frame + 1]
        return np.asarray(bone_frames(self.avatars.capture.skeleton, dofs)[0, :, :3, 3])

    def _side(
        self, state: ViewState, title: str, pose: Pose, truth: TruthPicture | None, camera: Camera, clock: StageClock
    ) -> np.ndarray:
        """An avatar, or its error where that is wanted and the truth is known."""
        drawn = self.avatars[title].on_colour(pose, camera, clock, state.background)
        if truth is None or not state.error:
            return drawn
        flip = self._compared(title, pose, truth)[2]
        shown = (truth.on_black[..., 3] > 0) | (flip > FLIP_SHOWN)
        heat = np.dstack([_heat(flip / FLIP_WHITE), np.where(shown, 255, 0).astype(np.uint8)])
        return fitted(TruthPicture(camera=truth.camera, on_black=metrics.on_black(heat)), camera, state.background)

    def _compared(self, title: str, pose: Pose, truth: TruthPicture) -> tuple[float, float, np.ndarray]:
        """PSNR and FLIP on the foreground in the truth's own pixels, as the protocol has them; the map of FLIP."""
        key = (title, truth.key)
        if key not in self._scores:
            drawn = metrics.quantise(self.avatars[title].premultiplied(pose, truth.camera, StageClock()))
            ours, theirs = drawn[..., :3], truth.on_black[..., :3]
            mask, flip = metrics.foreground(truth.on_black), metrics.flip_map(ours, theirs)
            mean_flip = float(flip[mask].mean()) if mask.any() else 0.0
            self._scores[key] = metrics.psnr(ours, theirs, mask), mean_flip, flip
            if len(self._scores) > CACHED_SCORES:
                self._scores.popitem(last=False)
        return self._scores[key]


def _heat(share: np.ndarray) -> np.ndarray:
    from matplotlib import colormaps

    return np.rint(np.asarray(colormaps["magma"](np.clip(share, 0, 1)))[..., :3] * 255).astype(np.uint8)


def fitted(picture: TruthPicture, camera: Camera, background: Colour) -> np.ndarray:
    """A picture taken by one camera, in the pixels of another with the same position and direction."""
    scale = camera.K[0, 0] / picture.camera.K[0, 0]
    size = (max(1, round(picture.camera.width * scale)), max(1, round(picture.camera.height * scale)))
    left, top = np.rint(camera.K[:2, 2] - scale * picture.camera.K[:2, 2]).astype(int).tolist()
    sheet = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    for channel in range(4):  # Each by itself: Pillow takes the colours of RGBA for straight ones.
        whole = Image.fromarray(picture.on_black[..., channel].astype(np.float32) / 255)
        page = Image.new("F", (camera.width, camera.height))
        page.paste(whole.resize(size, Image.Resampling.BICUBIC), (left, top))
        sheet[..., channel] = np.asarray(page)
    return composite(sheet, background)


def _divided(left: np.ndarray, right: np.ndarray, state: ViewState) -> np.ndarray:
    """The left picture, the right one, a line between them, and their names."""
    height, width = left.shape[:2]
    column, gap = round(state.divider * width), max(6, height // 60)
    sheet = Image.fromarray(np.concatenate([left[:, :column], right[:, column:]], axis=1))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(max(10, height // 32))
    pen.line([(column, 0), (column, height)], fill=state.ink, width=max(1, height // 300))
    names = (state.left, "rs", -gap), ("Truth" if state.right == TRUTH else state.right, "ls", gap)
    for name, anchor, shift in names:
        pen.text((column + shift, round(NAMES_AT * height)), name, fill=state.ink, font=font, anchor=anchor)
    return np.asarray(sheet)


@lru_cache(maxsize=2)
def _faces(content: bytes) -> torch.Tensor:
    return torch.from_numpy(np.frombuffer(content, dtype=np.int64).reshape(-1, 3).copy())


def with_mesh(pixels: np.ndarray, vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """The picture with the nearest triangles' outlines, of equal width everywhere, with soft edges."""
    height, width = pixels.shape[:2]
    in_camera = vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    homogeneous = (in_camera @ camera.K.T).astype(np.float32)
    drawn = rasterize_mesh(
        torch.from_numpy(homogeneous),
        _faces(faces.tobytes()),
        width=width,
        height=height,
        threads=torch.get_num_threads(),
    )
    triangle = drawn.triangle.numpy()
    covered = triangle >= 0
    corners = (homogeneous[:, :2] / np.maximum(homogeneous[:, 2:], NEAR))[faces]
    edges = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)  # opposite each corner
    twice_area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    heights = (twice_area[:, None] / np.maximum(np.linalg.norm(edges, axis=2), 1e-6))[triangle[covered]]  # pixels
    line = max(1.0, LINE * height)
    to_edge = (drawn.barycentric.numpy()[covered] * heights).min(axis=1)
    opacity = np.clip((line + 1) / 2 - to_edge, 0, 1) * np.clip(heights.min(axis=1) / (FADE_WIDTHS * line), 0, 1)
    result = pixels.copy()
    lined = pixels[covered] + opacity[:, None] * (np.array(MESH, dtype=np.float32) - pixels[covered])
    result[covered] = np.rint(lined).astype(np.uint8)
    return result


def _with_skeleton(
    pixels: np.ndarray, positions: np.ndarray, parents: np.ndarray, camera: Camera, turned: set[int]
) -> np.ndarray:
    sheet = Image.fromarray(pixels)
    pen, size = ImageDraw.Draw(sheet), max(2, pixels.shape[0] // 150)
    points, depth = camera.project(positions)
    for joint, parent in enumerate(parents):
        if parent >= 0 and min(depth[joint], depth[parent]) > NEAR:
            pen.line([tuple(points[parent]), tuple(points[joint])], fill=BONE, width=size)
    for joint, (x, y) in enumerate(points):
        if depth[joint] > NEAR:
            colour = TURNED_JOINT if joint in turned else JOINT
            pen.ellipse([x - size, y - size, x + size, y + size], fill=colour, outline=BONE)
    return np.asarray(sheet)
