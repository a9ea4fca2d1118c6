"""From what a viewer looks at to the picture: avatars, truth, divider and errors, all drawn here."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ash.capture.dataset import Camera, Pose
from benchmarks.cell import metrics
from benchmarks.play.avatars import AvatarSet
from benchmarks.play.cameras import FREE, resized
from benchmarks.play.motions import MotionClip
from benchmarks.play.truth import TruthCache, TruthPicture
from benchmarks.report.pictures import FLIP_WHITE, PAPER, on_paper

NOTHING, TRUTH = "nothing", "the truth"
INK = (20, 25, 35)
FLIP_SHOWN = 0.02  # from here on an error beside the person is shown
UNKNOWN_TRUTH = (
    "No truth of this view yet: press *Render truth here* under *Compare*, "
    "or look through one of the capture's cameras."
)
CACHED_SCORES = 64
NAMES_AT = 0.94  # of the height, from the top


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewState:
    """Everything that decides a viewer's picture; replaced as a whole whenever something changes."""

    clip: int = 0  # index of the motion
    step: int = 0  # of the clip
    playing: bool = True
    speed: float = 1.0
    left: str  # an avatar
    right: str = NOTHING  # nothing, the truth, or another avatar
    divider: float = 0.5  # share of the width that is the left one's
    error: bool = False  # the map of FLIP in place of the avatars
    camera: str = FREE  # or one of the capture's
    viewpoint: Camera | None = None  # the browser's camera, in pixels of its window; None until it has sent it


@dataclass(frozen=True, kw_only=True, slots=True)
class RenderedView:
    """A picture and what is to be said about it."""

    pixels: np.ndarray  # uint8 [h, w, 3]
    score: str  # against the truth, empty where it is not known
    note: str  # why something asked for is not there


class ViewRenderer:
    """Renders states. One thread uses it."""

    def __init__(self, avatars: AvatarSet, clips: tuple[MotionClip, ...], truths: TruthCache) -> None:
        self.avatars, self.clips, self.truths = avatars, clips, truths
        self._compared = lru_cache(maxsize=CACHED_SCORES)(self._compare)

    def render(self, state: ViewState, *, width: int, height: int, with_scores: bool) -> RenderedView:
        """The picture at a size; with scores where there is time for them.

        Raises:
            InputError, FloatingPointError, ...: whatever an avatar raises.
        """
        camera, truth = resized(self.camera(state), width=width, height=height), self.truth(state)
        pixels = self._side(state, state.left, truth, camera)
        if state.right == TRUTH:
            empty = np.full_like(pixels, PAPER)
            shown = empty if truth is None else fitted(on_paper(truth.on_black), truth.camera, camera)
            pixels = _divided(pixels, shown, state)
        elif state.right != NOTHING:
            pixels = _divided(pixels, self._side(state, state.right, truth, camera), state)
        scores = []
        if truth is not None and with_scores:
            for title in [state.left, *([state.right] if state.right in self.avatars.titles else [])]:
                psnr, flip, _ = self._compared(title, state.clip, state.step, truth)
                scores.append(f"{title} {psnr:.1f} dB, FLIP {flip:.3f}")
        is_missed = truth is None and (state.error or state.right == TRUTH)
        return RenderedView(pixels=pixels, score=" · ".join(scores), note=UNKNOWN_TRUTH if is_missed else "")

    def camera(self, state: ViewState) -> Camera:
        """The camera that the viewer looks through: one of the capture's, or the browser's own."""
        camera = self.avatars.capture.cameras.get(state.camera, state.viewpoint)
        assert camera is not None
        return camera

    def pose(self, clip: int, step: int) -> Pose:
        """A frame of a clip."""
        return Pose(self.clips[clip].motion, self.clips[clip].frames[step])

    def truth(self, state: ViewState) -> TruthPicture | None:
        """The truth of what the viewer looks at, where it is known."""
        clip = self.clips[state.clip]
        return self.truths.find(clip, clip.frames[state.step], self.camera(state))

    def _side(self, state: ViewState, title: str, truth: TruthPicture | None, camera: Camera) -> np.ndarray:
        """An avatar, or its error where that is wanted and the truth is known."""
        if truth is None or not state.error:
            return on_paper(self.avatars[title].on_black(self.pose(state.clip, state.step), camera))
        from matplotlib import colormaps

        flip = self._compared(title, state.clip, state.step, truth)[2]
        heat = np.rint(np.asarray(colormaps["magma"](np.clip(flip / FLIP_WHITE, 0, 1)))[..., :3] * 255)
        shown = (truth.on_black[..., 3:] > 0) | (flip[..., None] > FLIP_SHOWN)
        return fitted(np.where(shown, heat, PAPER).astype(np.uint8), truth.camera, camera)

    def _compare(self, title: str, clip: int, step: int, truth: TruthPicture) -> tuple[float, float, np.ndarray]:
        """PSNR and FLIP on the foreground in the truth's own pixels, as the protocol has them; the map of FLIP."""
        drawn = self.avatars[title].on_black(self.pose(clip, step), truth.camera)
        ours, theirs, mask = drawn[..., :3], truth.on_black[..., :3], metrics.foreground(truth.on_black)
        flip = metrics.flip_map(ours, theirs)
        return metrics.psnr(ours, theirs, mask), float(flip[mask].mean()) if mask.any() else 0.0, flip


def fitted(picture: np.ndarray, taken_by: Camera, camera: Camera) -> np.ndarray:
    """A picture `[h, w, 3]` taken by one camera, in the pixels of another with the same position and direction."""
    scale = camera.K[0, 0] / taken_by.K[0, 0]
    size = (max(1, round(taken_by.width * scale)), max(1, round(taken_by.height * scale)))
    left, top = np.rint(camera.K[:2, 2] - scale * taken_by.K[:2, 2]).astype(int).tolist()
    sheet = Image.new("RGB", (camera.width, camera.height), (PAPER,) * 3)
    sheet.paste(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC), (left, top))
    return np.asarray(sheet)


def _divided(left: np.ndarray, right: np.ndarray, state: ViewState) -> np.ndarray:
    """The left picture, the right one, a line between them, and their names."""
    height, width = left.shape[:2]
    column, gap = round(state.divider * width), max(6, height // 60)
    sheet = Image.fromarray(np.concatenate([left[:, :column], right[:, column:]], axis=1))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(max(10, height // 32))
    pen.line([(column, 0), (column, height)], fill=INK, width=max(1, height // 300))
    names = (state.left, "rs", -gap), ("Truth" if state.right == TRUTH else state.right, "ls", gap)
    for name, anchor, shift in names:
        pen.text((column + shift, round(NAMES_AT * height)), name, fill=INK, font=font, anchor=anchor)
    return np.asarray(sheet)
