"""How long a trained avatar takes for frames of its held-out motion: `ash-bench speed frame --avatar`.

The frames are those that the capture has images of, near the training motion and new. Each is drawn as in playback: the
template was posed in the frames before it, and not yet in its own. Engines of the decoders are chosen on the first
frame of the capture's motion, one of training; how well the chosen ones agree with the definitions is measured on the
held-out frames.
"""

import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.devices import CPU
from ash.files import InputError
from ash.inference import Player
from ash.model import AshModel
from ash.protocol import Avatar
from benchmarks.speed.frames import (
    Samples,
    agreement_db,
    frame_by_definition,
    frame_rows,
    players_of,
    print_table,
    scaled_camera,
    timed_frame,
)
from benchmarks.speed.rows import SpeedRow

SPLIT_OF = {"near": "near_pose", "new": "novel_pose"}
SIZE = (512, 512)  # Besides that of the capture's own images.


@dataclass(frozen=True, kw_only=True)
class PlaybackAgreement:
    """How far played images are from those by the definitions."""

    candidate: str
    size: str
    gaussians: int
    engines: tuple[str, ...]  # of the decoders, by threads, fewest first; none without decoders
    frames: int
    least_trust: float  # 0..1, the least share of a picture that is decoded
    least_db: float  # foreground PSNR of the worst frame on any number of threads
    median_db: float  # over the frames

    def told(self) -> str:
        """In one line."""
        decoders = f"decoders in {' and '.join(dict.fromkeys(self.engines))}" if self.engines else "no decoders"
        about = f"{self.candidate}, {self.size}: {self.gaussians:,} Gaussians, {decoders}"
        found = f"to {self.least_db:.1f} dB at least, {self.median_db:.1f} dB in the median"
        where = f"of {self.frames} frames, decoded by shares of {self.least_trust:.2f} or more"
        return f"{about}; agrees with the definitions {found} {where}"


@dataclass(frozen=True, kw_only=True)
class TimedClip:
    """Frames of the capture's motion to be timed, seen by one camera."""

    candidate: str
    poses: tuple[Pose, ...]
    trust: tuple[float, ...]  # 0..1, the share of each that is decoded
    camera: Camera


@torch.no_grad()
def held_out_clips(model: AshModel, capture: Capture, title: str) -> list[TimedClip]:
    """The held-out near motion and the new motion of a capture, each at 512x512 and at the size of its images.

    Raises:
        InputError: the capture has neither.
    """
    clips = []
    for name, split in SPLIT_OF.items():
        if split not in capture.splits:
            continue
        poses = tuple(Pose(capture.motion, frame) for frame in sorted(capture.splits[split].frames))
        trust = tuple(model.conditions(pose).trust for pose in poses)
        own = capture.cameras[capture.splits[split].cameras[0]]
        for width, height in dict.fromkeys((SIZE, (own.width, own.height))):
            camera = scaled_camera(own, width, height)
            clips.append(TimedClip(candidate=f"{title} {name}", poses=poses, trust=trust, camera=camera))
    if not clips:
        raise InputError(f"{capture.folder}: expected held-out frames of near or new motion, and it has neither")
    return clips


def speed_playback(
    avatar: AshAvatar, clips: list[TimedClip], *, threads: tuple[int, ...] = (1, 2), rounds: int = 2
) -> Iterator[list[SpeedRow] | PlaybackAgreement]:
    """Time a trained avatar through clips of its capture's motion, each `rounds` times; yields results as they come."""
    before = torch.get_num_threads()
    threads = threads if avatar.device == CPU else (1,)  # A GPU is fed by one.
    try:
        players = players_of(avatar, clips[0].poses[0].motion, clips[0].camera, threads)
        for clip in clips:
            samples = _timed(avatar, players, clip, rounds)
            agreement, defined_ms = _compared(avatar, players, clip)
            yield agreement
            yield frame_rows(samples, defined_ms, clip.candidate, clip.camera, avatar.device)
    finally:
        torch.set_num_threads(before)


def _timed(avatar: AshAvatar, players: dict[int, Player], clip: TimedClip, rounds: int) -> Samples:
    """Milliseconds of the stages and of the whole, by all players in turns."""
    samples: Samples = defaultdict(list)
    for pose in clip.poses * rounds:
        for count, player in players.items():
            _arrive(avatar.module, pose)
            for what, value in timed_frame(player, pose.frame, clip.camera, count).items():
                samples[what, count].append(value)
    return samples


def _compared(avatar: AshAvatar, players: dict[int, Player], clip: TimedClip) -> tuple[PlaybackAgreement, list[float]]:
    """How the played images agree with those by the definitions, and the milliseconds that each of the latter took."""
    defined_ms, worst = [], []
    for pose in clip.poses:
        _arrive(avatar.module, pose)
        start = time.perf_counter()
        defined = frame_by_definition(avatar.module, pose, clip.camera)
        defined_ms.append((time.perf_counter() - start) * 1e3)
        drawn = (player.draw(pose.frame, clip.camera) for player in players.values())
        worst.append(min(agreement_db(image, defined) for image in drawn))
    found = PlaybackAgreement(
        candidate=clip.candidate,
        size=f"{clip.camera.width}x{clip.camera.height}",
        gaussians=avatar.gaussian_count(),
        engines=tuple(player.engine.name for player in players.values() if player.engine),
        frames=len(clip.poses),
        least_trust=min(clip.trust),
        least_db=min(worst),
        median_db=statistics.median(worst),
    )
    return found, defined_ms


def _arrive(model: AshModel, pose: Pose) -> None:
    """Leave with the template what playback leaves there: the frames before this one, and not this one."""
    model.template.forget()
    for past in pose.window(model.config.window):
        if past != pose.frame:
            model.template.pose(pose.at(int(past)))


def main(avatar: Avatar, capture: Capture, title: str, json_path: Path | None) -> int:
    """Print the table of a trained avatar on its capture, and write it to `json_path`; returns the exit code.

    Raises:
        InputError: the avatar is none of ASH, or its capture has no held-out motion.
    """
    if not isinstance(avatar, AshAvatar):
        raise InputError(f"speed frame: expected an avatar of ASH, whose stages have definitions, got {title}")
    clips = held_out_clips(avatar.module, capture, title)
    return print_table(speed_playback(avatar, clips), json_path, avatar.device)
