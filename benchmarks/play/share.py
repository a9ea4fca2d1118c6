"""`export --format html`: one page that plays a clip of an avatar without a server, its splats drawn in the browser."""

import base64
import html
import json
import math
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ash.capture.dataset import Pose
from ash.devices import CPU, moved
from ash.files import InputError
from ash.gaussians.gaussians import Gaussians
from ash.harmonics import SH_C0
from ash.protocol import PosesGaussians
from benchmarks.play.avatars import LoadedAvatar
from benchmarks.play.cameras import camera_distance, first_camera, fov_of, middle_of
from benchmarks.play.motions import MotionClip

HERE = Path(__file__).parent
LIBRARY = HERE / "vendor" / "splats.min.js.gz"
LICENCES = ("LICENSE-spark", "LICENSE-three", "LICENSE-fflate")
MIN_SCALE = 1e-4  # metres: smaller Gaussians cannot be seen
COLUMNS = 17  # bytes of a Gaussian: position 6, scale 3, rotation 4, colour 3, opacity 1; then harmonics, if any
EPSILON = 1e-6  # no range is empty


def shared_page(loaded: LoadedAvatar, clip: MotionClip, frames: Sequence[int]) -> bytes:
    """The page, with frames of a clip, seen as by the capture's cameras.

    Colours that depend on the view are computed in the browser for where its camera stands.

    Raises:
        InputError: an avatar that has no Gaussians, or another number of them in each frame.
    """
    avatar, capture, title = loaded.avatar, loaded.capture, f"{loaded.title}: {clip.title}"
    if not isinstance(avatar, PosesGaussians):
        raise InputError(f"{loaded.title}: has no Gaussians; expected an avatar made of them")
    posed = [moved(avatar.gaussians(Pose(clip.motion, frame)), CPU) for frame in frames]
    if len({len(frame.means) for frame in posed}) != 1:
        raise InputError(f"{loaded.title}: expected as many Gaussians in each frame")
    means, scales = torch.cat([frame.means for frame in posed]), torch.cat([frame.scales for frame in posed])
    log_scales = scales.clamp(min=MIN_SCALE).log()
    above = [float(frame.sh[:, 1:].abs().max()) for frame in posed if frame.sh.shape[1] > 1]
    document = {
        "count": len(posed[0].means),
        "frames": len(posed),
        "fps": clip.motion.fps,
        "dilation": avatar.dilation,  # px^2
        "middle": middle_of(capture).tolist(),  # what the camera looks at, metres
        "distance": camera_distance(capture),
        "fov": math.degrees(fov_of(first_camera(capture))),
        "low": means.amin(0).tolist(),  # the ranges of the bytes
        "high": (means.amax(0) + EPSILON).tolist(),
        "logScale": [float(log_scales.min()), float(log_scales.max()) + EPSILON],
        "bands": 3 * (posed[0].sh.shape[1] - 1),
        "harmonics": max(above, default=0.0) + EPSILON,  # the largest coefficient above degree 0
    }
    content = {
        "TITLE": html.escape(title),
        "CLIP": json.dumps(document),
        "LICENCES": html.escape("\n\n".join((HERE / "vendor" / name).read_text() for name in LICENCES)),
        "LIBRARY": base64.b64encode(LIBRARY.read_bytes()).decode(),
        "FRAMES": base64.b64encode(_packed(posed, document)).decode(),
    }
    # In one pass: inserted text is not searched again.
    page = re.sub(r"@@([A-Z]+)@@", lambda marker: content[marker[1]], (HERE / "share.html").read_text())
    return page.encode()


def _packed(frames: Sequence[Gaussians], document: dict) -> bytes:
    """All frames, byte by byte as differences to the frame before, in columns, deflated."""
    before = np.zeros((document["count"], COLUMNS + document["bands"]), dtype=np.uint8)
    quats = np.zeros((len(before), 4), dtype=np.float32)
    compressor, parts = zlib.compressobj(9), []
    for frame in frames:
        unit = torch.nn.functional.normalize(frame.quats, dim=-1).numpy()
        quats = np.where((unit * quats).sum(axis=1, keepdims=True) < 0, -unit, unit)  # The nearer of both signs.
        rows = _rows(frame, quats, document)
        parts.append(compressor.compress((rows - before).T.tobytes()))
        before = rows
    return b"".join([*parts, compressor.flush()])


def _rows(frame: Gaussians, quats: np.ndarray, document: dict) -> np.ndarray:
    """A frame as bytes `[n, 17 + bands]`; the high bytes of positions come before the low ones."""
    low, high, (first, last) = np.array(document["low"]), np.array(document["high"]), document["logScale"]
    positions = _steps((frame.means.numpy() - low) / (high - low), 65535)
    scales = _steps((np.log(np.maximum(frame.scales.numpy(), MIN_SCALE)) - first) / (last - first), 255)
    colours = _steps(0.5 + SH_C0 * frame.sh[:, 0].numpy(), 255)
    opacities = _steps(frame.opacities.numpy()[:, None], 255)
    above = frame.sh[:, 1:].reshape(len(positions), -1).numpy() / document["harmonics"]
    columns = [positions >> 8, positions & 255, scales, _signed(quats), colours, opacities, _signed(above)]
    return np.concatenate(columns, axis=1).astype(np.uint8)


def _steps(share: np.ndarray, most: int) -> np.ndarray:
    return np.rint(share.clip(0, 1) * most).astype(np.int64)


def _signed(values: np.ndarray) -> np.ndarray:
    """-1..1 as signed bytes."""
    return np.rint(127 * values).astype(np.int64) & 255
