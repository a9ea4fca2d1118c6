"""`ash-bench share`: one page that plays a clip of an avatar without a server, its splats drawn in the browser."""

import base64
import html
import json
import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ash.capture.dataset import Pose
from ash.devices import CPU, moved
from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.harmonics import SH_C0
from ash.protocol import PosesGaussians
from benchmarks.play.actors import Cast
from benchmarks.play.cameras import first_camera, fov_of, middle_of, reach_of
from benchmarks.play.motions import Act

HERE = Path(__file__).parent
LIBRARY = HERE / "vendor" / "splats.min.js.gz"
LICENCES = ("LICENSE-spark", "LICENSE-three", "LICENSE-fflate")
LEAST_SCALE = 1e-4  # metres: a tenth of a millimetre is seen as nothing
COLUMNS = 17  # bytes of a Gaussian: position 6, scale 3, rotation 4, colour 3, opacity 1; then harmonics, if any


@dataclass(frozen=True, kw_only=True, slots=True)
class SharedClip:
    """What a shared page plays."""

    frames: tuple[Gaussians, ...]
    fps: float
    title: str
    dilation: float  # px^2
    middle: tuple[float, float, float]  # what the camera looks at, metres
    distance: float  # from where, metres
    fov_deg: float  # from bottom to top


@dataclass(frozen=True, kw_only=True, slots=True)
class Bounds:
    """Between which numbers a clip's bytes lie."""

    low: list[float]  # of positions, metres
    high: list[float]
    log_scale: tuple[float, float]
    harmonics: float  # the largest coefficient above degree 0


def clip_of(cast: Cast, act: Act, frames: Sequence[int]) -> SharedClip:
    """Frames of an act, played by the one avatar of a cast, seen as by the capture's cameras.

    Raises:
        InputError: several avatars, or one that has no Gaussians.
    """
    actor = cast.only()
    if not isinstance(actor.avatar, PosesGaussians):
        raise InputError(f"{actor.title}: has no Gaussians; expected an avatar made of them")
    x, y, z = middle_of(cast.capture).tolist()
    return SharedClip(
        frames=tuple(moved(actor.avatar.gaussians(Pose(act.motion, frame)), CPU) for frame in frames),
        fps=act.motion.fps,
        title=f"{actor.title}: {act.title}",
        dilation=actor.avatar.dilation,
        middle=(x, y, z),
        distance=reach_of(cast.capture),
        fov_deg=math.degrees(fov_of(first_camera(cast.capture))),
    )


def share_page(clip: SharedClip) -> bytes:
    """The page. Colours that depend on the view are computed in the browser for where its camera stands.

    Raises:
        InputError: the clip has no frame, or frames differ in their number of Gaussians.
    """
    if not clip.frames or len({len(frame.means) for frame in clip.frames}) != 1:
        raise InputError("share: expected at least one frame, and as many Gaussians in each")
    bounds = _bounds(clip.frames)
    described = {
        "count": len(clip.frames[0].means),
        "frames": len(clip.frames),
        "fps": clip.fps,
        "title": clip.title,
        "dilation": clip.dilation,
        "middle": list(clip.middle),
        "distance": clip.distance,
        "fov": clip.fov_deg,
        "low": bounds.low,
        "high": bounds.high,
        "logScale": list(bounds.log_scale),
        "bands": 3 * (clip.frames[0].sh.shape[1] - 1),
        "harmonics": bounds.harmonics,
    }
    content = {
        "TITLE": html.escape(clip.title),
        "CLIP": json.dumps(described).replace("<", "\\u003c"),
        "LICENCES": html.escape("\n\n".join((HERE / "vendor" / name).read_text() for name in LICENCES)),
        "LIBRARY": base64.b64encode(LIBRARY.read_bytes()).decode(),
        "FRAMES": base64.b64encode(packed(clip.frames, bounds)).decode(),
    }
    # In one pass: what is put in is not looked through again.
    page = re.sub(r"@@([A-Z]+)@@", lambda place: content[place[1]], (HERE / "share.html").read_text())
    return page.encode()


def packed(frames: Sequence[Gaussians], bounds: Bounds) -> bytes:
    """All frames, byte by byte as differences to the frame before, in columns, deflated."""
    before = np.zeros((len(frames[0].means), COLUMNS + 3 * (frames[0].sh.shape[1] - 1)), dtype=np.uint8)
    quats = np.zeros((len(before), 4), dtype=np.float32)
    squeeze, parts = zlib.compressobj(9), []
    for frame in frames:
        quats = _nearest_sign(torch.nn.functional.normalize(frame.quats, dim=-1).numpy(), quats)
        rows = _rows(frame, quats, bounds)
        parts.append(squeeze.compress((rows - before).T.tobytes()))
        before = rows
    return b"".join([*parts, squeeze.flush()])


def _bounds(frames: Sequence[Gaussians]) -> Bounds:
    means = torch.cat([frame.means for frame in frames])
    scales = torch.cat([frame.scales for frame in frames]).clamp(min=LEAST_SCALE).log()
    above = [float(frame.sh[:, 1:].abs().max()) for frame in frames if frame.sh.shape[1] > 1]
    return Bounds(
        low=means.amin(0).tolist(),
        high=(means.amax(0) + 1e-6).tolist(),
        log_scale=(float(scales.min()), float(scales.max()) + 1e-6),
        harmonics=max(above, default=0.0) + 1e-6,
    )


def _rows(frame: Gaussians, quats: np.ndarray, bounds: Bounds) -> np.ndarray:
    """A frame as bytes `[n, 17 + bands]`, a number's high byte beside its low one."""
    low, high = np.array(bounds.low), np.array(bounds.high)
    place = _steps((frame.means.numpy() - low) / (high - low), 65535)
    first, last = bounds.log_scale
    scales = _steps((np.log(np.maximum(frame.scales.numpy(), LEAST_SCALE)) - first) / (last - first), 255)
    colours = _steps(0.5 + SH_C0 * frame.sh[:, 0].numpy(), 255)
    turns = np.rint(127 * quats).astype(np.int64) & 255
    opacities = _steps(frame.opacities.numpy()[:, None], 255)
    above = np.rint(127 * frame.sh[:, 1:].reshape(len(place), -1).numpy() / bounds.harmonics).astype(np.int64) & 255
    columns = [place >> 8, place & 255, scales, turns, colours, opacities, above]
    return np.concatenate(columns, axis=1).astype(np.uint8)


def _steps(share: np.ndarray, most: int) -> np.ndarray:
    return np.rint(share.clip(0, 1) * most).astype(np.int64)


def _nearest_sign(quats: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The same rotations with the signs that change the numbers least."""
    return np.where((quats * before).sum(axis=1, keepdims=True) < 0, -quats, quats)
