"""How long a frame takes, stage by stage, and a step of training, beside their definitions: `ash-bench speed frame`.

Frames follow each other as in playback: the template was posed in the frames before, and not yet in the timed one.
"""

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.capture.formats import load_capture
from ash.config import AshConfig
from ash.devices import CPU, moved
from ash.files import InputError, write_json
from ash.gaussians.splatting import Splatted, splat_naive
from ash.gaussians.texels import pose_naive, sample_surface_naive
from ash.model import AshModel, image_of, views_of
from ash.plus import AshPlusModel
from ash.presets import named, plus
from ash.protocol import Avatar, StageClock
from ash.textures import FrameInputs
from ash.training.adam import Adam
from ash.training.batches import Batch, draw_batch
from ash.training.images import load_training_images
from ash.training.losses import l1_ssim_loss_naive, ssim_target
from benchmarks.cell.metrics import psnr
from benchmarks.speed.timing import (
    Candidate,
    SpeedRow,
    as_json,
    print_head,
    print_rows,
    rows_of,
    time_interleaved,
    torch_threads_restored,
)

# ASH, appendix "Runtime Analysis": milliseconds on an A100 at 1285x940, by texels per side.
PAPER_MS = {
    128: {"stg1": 20.28, "stg2": 1.93, "stg3": 5.57, "stg4": 1.91, "frame": 29.69},
    256: {"stg1": 21.03, "stg2": 3.60, "stg3": 7.00, "stg4": 2.11, "frame": 33.74},
    512: {"stg1": 24.25, "stg2": 16.34, "stg3": 18.45, "stg4": 4.31, "frame": 63.35},
}
CAPTURE = Path("data/mannequin-ci-0")
SPLITS = {"near": "near_pose", "new": "novel_pose"}  # held-out motion of a trained avatar
SIZE = (512, 512)  # in which it is timed, besides that of the capture's images
THREADS = (1, 2)  # of the CPU; one thread feeds a GPU
DEFINITION_RUNS = 3  # frames that an untrained avatar draws by the definitions


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A configuration to be timed, untrained: the time of a network does not depend on its weights."""

    name: str
    config: AshConfig
    width: int
    height: int
    trains: bool = False  # time steps of training, too


@dataclass(frozen=True, kw_only=True)
class Clip:
    """Frames of a motion to be timed, seen by one camera."""

    title: str
    poses: tuple[Pose, ...]
    camera: Camera
    compared: int  # so many of the frames are also drawn by the definitions

    @property
    def size(self) -> str:
        """Pixels of its images."""
        return f"{self.camera.width}x{self.camera.height}"


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How far drawn images are from those by the definitions; its fields are those of the JSON."""

    candidate: str
    size: str
    gaussians: int
    frames: int
    least_db: float  # foreground PSNR of the worst frame on any number of threads
    median_db: float  # over the frames

    def line(self) -> str:
        """In one line."""
        return (
            f"{self.candidate}, {self.size}: {self.gaussians:,} Gaussians; agrees with the definitions"
            f" to {self.least_db:.1f} dB at least, {self.median_db:.1f} dB in the median of {self.frames} frames"
        )


def subjects() -> tuple[Subject, ...]:
    """`ash`, `ash_plus` at four resolutions of the texel lattice, and the paper's size."""
    cpu = plus("cpu")
    lattices = {texels: replace(cpu, model=replace(cpu.model, texels=texels)) for texels in (64, 128, 256, 512)}
    small = []
    for texels, config in lattices.items():
        name = "ash_plus cpu" if config == cpu else f"ash_plus cpu@{texels}"
        small.append(Subject(name=name, config=config, width=512, height=512, trains=config == cpu))
    ash = Subject(name="ash cpu", config=named("cpu"), width=512, height=512, trains=True)
    return (ash, *small, Subject(name="ash paper", config=named("paper"), width=1285, height=940))


def speed_frame(
    capture: Capture,
    *,
    timed: tuple[Subject, ...] | None = None,
    threads: tuple[int, ...] = THREADS,
    rounds: int = 15,
    device: torch.device = CPU,
) -> Iterator[list[SpeedRow] | Agreement]:
    """Time frames and steps of untrained avatars on a capture, large ones in fewer rounds; yields results one by one.

    `timed`: all `subjects()` where none are given.
    """
    frames = capture.splits["train"].frames
    for subject in timed or subjects():
        config = replace(subject.config, device=str(device))
        avatar = AshAvatar.from_capture(replace(config, template=replace(config.template, steps=1)), capture)
        _fill_heads(avatar)
        large = config.model.width >= 64
        count = max(2, rounds // 10) if large else rounds
        clip = Clip(
            title=subject.name,
            poses=tuple(Pose(capture.motion, frames[number % len(frames)]) for number in range(1, 1 + count)),
            camera=scaled_camera(next(iter(capture.cameras.values())), subject.width, subject.height),
            compared=1 if large else DEFINITION_RUNS,
        )
        yield from time_clip(avatar, clip, threads=threads)
        if subject.trains:
            yield time_steps(avatar, subject.name, capture, rounds=max(1, rounds // 5))


def held_out_clips(capture: Capture, title: str) -> list[Clip]:
    """The held-out near motion and the new motion of a capture, each at 512x512 and at the size of its images.

    Raises:
        InputError: the capture has neither.
    """
    clips = []
    for name, split in SPLITS.items():
        if split not in capture.splits:
            continue
        poses = tuple(Pose(capture.motion, frame) for frame in sorted(capture.splits[split].frames))
        camera = capture.cameras[capture.splits[split].cameras[0]]
        clips += [
            Clip(
                title=f"{title} {name}",
                poses=poses,
                camera=scaled_camera(camera, width, height),
                compared=len(poses),
            )
            for width, height in dict.fromkeys((SIZE, (camera.width, camera.height)))
        ]
    if not clips:
        raise InputError(f"{capture.folder}: expected held-out frames of near or new motion, and it has neither")
    return clips


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view in another size of image, the subject as large in the height."""
    K = camera.K.copy()
    K[:2] *= height / camera.height
    K[0, 2] += (width - camera.width * height / camera.height) / 2
    return Camera(name=camera.name, width=width, height=height, K=K, viewmat=camera.viewmat)


def _fill_heads(avatar: AshAvatar) -> None:
    """Give the decoders an output that is not zero: an untrained head is zero."""
    generator = torch.Generator().manual_seed(0)
    decoders = avatar.module.decoders
    assert decoders is not None
    for name, parameter in decoders.named_parameters():
        if "head" in name:
            parameter.data.copy_(0.01 * torch.randn(parameter.shape, generator=generator, device=CPU))


@torch.no_grad()
def frame_by_definition(model: AshModel, pose: Pose, camera: Camera) -> np.ndarray:
    """The image of a frame by the definitions alone: premultiplied RGBA, float32 `[h, w, 4]`."""
    posed = model.template.pose(pose)
    canonical, normals, transforms = sample_surface_naive(model.lattice, posed)
    inputs = replace(model.frame_inputs(pose), canonical=canonical, normals=normals, transforms=transforms)
    (raw,) = model.decode([inputs])
    return image_of(_splat_by_definition(model, raw, inputs, [camera]))


def _splat_by_definition(
    model: AshModel, raw: Tensor, inputs: FrameInputs, cameras: list[Camera], background: Tensor | None = None
) -> Splatted:
    light = model.light if isinstance(model, AshPlusModel) else None
    gaussians = pose_naive(raw, inputs, model.config, light)
    views = {name: moved(value, gaussians.means.device) for name, value in views_of(cameras).items()}
    return splat_naive(gaussians, **views, background=background, dilation=model.config.dilation)


def agreement_db(drawn: np.ndarray, defined: np.ndarray) -> float:
    """PSNR between two premultiplied RGBA images `[h, w, 4]` in dB, on the foreground of the one by the definitions."""
    return psnr(255 * drawn[..., :3], 255 * defined[..., :3], defined[..., 3] > 0.5)


def time_clip(
    avatar: AshAvatar, clip: Clip, *, threads: tuple[int, ...] = THREADS, rounds: int = 1
) -> Iterator[Agreement | list[SpeedRow]]:
    """Draw a clip's frames on each number of threads, and the compared ones by the definitions on one thread."""
    threads = threads if avatar.device == CPU else (1,)
    model = avatar.module
    drawn: dict[int, np.ndarray] = {}  # the last image
    defined: dict[int, np.ndarray] = {}  # by number of the call
    agreed: dict[int, list[float]] = {}

    def pose_of(number: int) -> Pose:
        return clip.poses[number % len(clip.poses)]

    def arrive(count: int) -> Callable[[int], None]:
        return lambda number: _arrive(model, pose_of(number), count)

    def draw(number: int) -> Mapping[str, float]:
        clock = StageClock()
        drawn[0] = avatar.render(pose_of(number), clip.camera, clock=clock)
        return clock.ms

    def define(number: int) -> None:
        defined[number] = frame_by_definition(model, pose_of(number), clip.camera)

    def compare(number: int) -> None:
        if number in defined:
            agreed.setdefault(number, []).append(agreement_db(drawn[0], defined[number]))

    with torch_threads_restored():
        by_definition = Candidate(name=f"{clip.title}-naive", threads=1, call=define, before=arrive(1))
        samples = time_interleaved([by_definition], rounds=clip.compared, warm_up=False, device=avatar.device)
        samples |= time_interleaved(
            [
                Candidate(name=clip.title, threads=count, call=draw, before=arrive(count), after=compare)
                for count in threads
            ],
            rounds=rounds * len(clip.poses),
            warm_up=False,
            device=avatar.device,
        )
    worst = [min(several) for several in agreed.values()]
    yield Agreement(
        candidate=clip.title,
        size=clip.size,
        gaussians=avatar.gaussian_count(),
        frames=len(worst),
        least_db=min(worst),
        median_db=statistics.median(worst),
    )
    yield rows_of("frame", clip.size, "forward", samples, avatar.device)


def _arrive(model: AshModel, pose: Pose, threads: int) -> None:
    """Leave with the template what playback leaves there: the frames before this one, and not this one."""
    torch.set_num_threads(threads)
    model.template.clear_cache()
    for past in pose.window(model.config.window):
        if past != pose.frame:
            model.template.pose(pose.at(int(past)))


def time_steps(avatar: AshAvatar, preset: str, capture: Capture, *, rounds: int) -> list[SpeedRow]:
    """A step of training on the capture's images on one thread, by the definitions and as it is trained, interleaved.

    Batches are drawn before; weights stay as they are.
    """
    images = load_training_images(capture, avatar.device)
    batches: dict[int, Batch] = {}

    def prepare(number: int) -> None:
        torch.set_num_threads(1)
        if number not in batches:
            batches[number] = draw_batch(images, avatar.config.training, 0, number)
        avatar._inputs_of(batches[number].frame)

    def candidate(name: str, *, naive: bool, repeats: int) -> Candidate:
        optimiser = Adam([group | {"lr": 0.0} for group in avatar.parameter_groups()])

        def step(number: int) -> None:
            _step(avatar, batches[number], optimiser, naive=naive)

        return Candidate(name=name, threads=1, call=step, before=prepare, repeats=repeats)

    candidates = [
        candidate(f"{preset}-naive", naive=True, repeats=1),
        candidate(preset, naive=False, repeats=5),
    ]
    with torch_threads_restored():
        samples = time_interleaved(candidates, rounds=rounds, device=avatar.device)
    camera = next(iter(images.cameras.values()))
    return rows_of("train_step", f"{camera.width}x{camera.height}", "forward+backward", samples, avatar.device)


def _step(avatar: AshAvatar, batch: Batch, optimiser: Adam, *, naive: bool) -> None:
    training = avatar.config.training
    if naive:
        inputs = avatar._inputs_of(batch.frame)
        (raw,) = avatar.module.decode([inputs])
        drawn = _splat_by_definition(avatar.module, raw, inputs, batch.cameras, batch.background).rgb
        by_view = [
            l1_ssim_loss_naive(
                image, ssim_target(target), l1_weight=training.l1_weight, ssim_weight=training.ssim_weight
            )
            for image, target in zip(drawn, batch.targets, strict=True)
        ]
        loss = torch.stack(by_view).mean()
    else:
        loss = avatar.loss([batch], training.steps)
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimiser.step()


def captured(folder: Path | None) -> Capture:
    """The capture in a folder; where none is named, the mannequin of the suite `ci`, rendered if it is not there."""
    if folder is None:
        from benchmarks.provenance import cores
        from benchmarks.suites.captures import make_capture_in
        from benchmarks.suites.suites import CaptureSpec

        folder = CAPTURE
        make_capture_in(CaptureSpec(scene="mannequin", size="ci"), folder, workers=cores())
    return replace(load_capture(folder), store=folder.parent / "templates")


def main(json_path: Path | None, folder: Path | None = None, device: torch.device = CPU) -> int:
    """Print the table of untrained avatars on a capture, and write it to `json_path`; returns the exit code."""
    return print_table(speed_frame(captured(folder), device=device), json_path, device)


def main_of_avatar(avatar: Avatar, capture: Capture, title: str, json_path: Path | None) -> int:
    """Print the table of a trained avatar on its capture, and write it to `json_path`; returns the exit code.

    Raises:
        InputError: the avatar is none of ASH, or its capture has no held-out motion.
    """
    if not isinstance(avatar, AshAvatar):
        raise InputError(f"speed frame: expected an avatar of ASH, whose stages have definitions, got {title}")
    clips = held_out_clips(capture, title)
    results = (result for clip in clips for result in time_clip(avatar, clip, rounds=2))
    return print_table(results, json_path, avatar.device)


def print_table(results: Iterable[list[SpeedRow] | Agreement], json_path: Path | None, device: torch.device) -> int:
    """Print rows and agreements one by one, and write them to `json_path`; returns the exit code."""
    print(f"device {device}")
    print_head()
    rows: list[SpeedRow] = []
    agreements: list[Agreement] = []
    for result in results:
        if isinstance(result, Agreement):
            agreements.append(result)
            print(f"  {result.line()}", flush=True)
        else:
            rows += result
            print_rows(result)
    print("the paper, on an A100 with its learned template at 1285x940:")
    for texels, paper in PAPER_MS.items():
        stages = ", ".join(f"{name} {ms:.2f}" for name, ms in paper.items())
        print(f"  {texels} texels: {stages} ms, {1e3 / paper['frame']:.2f} frames per second")
    if json_path is not None:
        content = {"rows": [as_json(row) for row in rows], "agreements": [vars(a) for a in agreements]}
        write_json(json_path, content | {"paper_ms": PAPER_MS})
    return 0
