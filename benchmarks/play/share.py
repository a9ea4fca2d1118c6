"""`export --format html`: one page that plays a clip of an avatar without a server, its splats drawn in the browser."""

import base64
import html
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from ash.capture.dataset import Pose
from ash.devices import CPU, moved
from ash.files import InputError
from ash.protocol import PosesGaussians
from benchmarks.export.gaussians import spz_bytes
from benchmarks.play.avatars import LoadedAvatar
from benchmarks.play.cameras import START, camera_distance, first_camera, fov_of, middle_of
from benchmarks.play.motions import MotionClip

HERE = Path(__file__).parent
LIBRARY = HERE / "vendor" / "splats.min.js.gz"
LICENCES = ("LICENSE-spark", "LICENSE-three", "LICENSE-fflate")


def shared_page(loaded: LoadedAvatar, clip: MotionClip, frames: Sequence[int]) -> bytes:
    """The page, with frames of a clip as SPZ, seen as by the capture's cameras.

    Raises:
        InputError: an avatar that has no Gaussians.
    """
    avatar, capture, title = loaded.avatar, loaded.capture, f"{loaded.title}: {clip.title}"
    if not isinstance(avatar, PosesGaussians):
        raise InputError(f"{loaded.title}: has no Gaussians; expected an avatar made of them")
    middle = middle_of(capture)
    posed = [moved(avatar.gaussians(Pose(clip.motion, frame)), CPU) for frame in frames]
    # The person stands at the origin: half precision, in which the browser keeps positions, is finest there.
    posed = [replace(frame, means=frame.means - torch.from_numpy(middle).float()) for frame in posed]
    document = {
        "fps": clip.motion.fps,
        "dilation": avatar.dilation,  # px^2
        "middle": middle.tolist(),  # of the person, metres
        "start": (camera_distance(capture) * torch.tensor(START)).tolist(),  # of the camera, from the middle
        "fov": math.degrees(fov_of(first_camera(capture))),
        "frames": [base64.b64encode(spz_bytes(frame)).decode() for frame in posed],
    }
    content = {
        "TITLE": html.escape(title),
        "CLIP": json.dumps(document),
        "LICENCES": html.escape("\n\n".join((HERE / "vendor" / name).read_text() for name in LICENCES)),
        "LIBRARY": base64.b64encode(LIBRARY.read_bytes()).decode(),
    }
    # In one pass: inserted text is not searched again.
    page = re.sub(r"@@([A-Z]+)@@", lambda marker: content[marker[1]], (HERE / "share.html").read_text())
    return page.encode()
