"""How long a frame takes, stage by stage, and a step of training, beside their definitions: `ash-bench speed frame`."""

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Motion, Pose
from ash.capture.formats import load_capture
from ash.config import AshConfig
from ash.devices import CPU, finish, moved
from ash.files import write_json
from ash.gaussians.splatting import Splatted, splat_naive
from ash.gaussians.texels import place_naive, pose_naive
from ash.inference import Player, psnr
from ash.model import AshModel, image_of, mixed, views_of
from ash.presets import named
from ash.protocol import StageClock
from ash.training.adam import Adam
from ash.training.batches import Batch, draw_batch
from ash.training.images import load_training_images
from ash.training.loop import draw_training_step
from ash.training.losses import l1_ssim_loss, l1_ssim_loss_naive, ssim_target
from benchmarks.speed.rows import SpeedRow, as_json, row_of

# Milliseconds of a stage, or of the whole "frame", by threads.
Samples = dict[tuple[str, int], list[float]]

STAGES = ("stg1", "stg2", "stg3", "stg4")
# ASH, appendix "Runtime Analysis": milliseconds on an A100 at 1285x940, by texels per side.
PAPER_MS = {
    128: {"stg1": 20.28, "stg2": 1.93, "stg3": 5.57, "stg4": 1.91, "frame": 29.69},
    256: {"stg1": 21.03, "stg2": 3.60, "stg3": 7.00, "stg4": 2.11, "frame": 33.74},
    512: {"stg1": 24.25, "stg2": 16.34, "stg3": 18.45, "stg4": 4.31, "frame": 63.35},
}
CAPTURE = Path("data/mannequin-ci-0")


@dataclass(frozen=True, kw_only=True)
class TimedAvatar:
    """A configuration to be timed."""

    name: str
    config: AshConfig
    width: int
    height: int
    trains: bool = False  # time steps of training, too


def subjects() -> tuple[TimedAvatar, ...]:
    """`cpu` at four resolutions of the texel lattice, and the paper's."""
    cpu = named("cpu")
    lattices = {texels: replace(cpu, model=replace(cpu.model, texels=texels)) for texels in (64, 128, 256, 512)}
    small = [
        TimedAvatar(
            name="cpu" if config == cpu else f"cpu@{texels}", config=config, width=512, height=512, trains=config == cpu
        )
        for texels, config in lattices.items()
    ]
    return (*small, TimedAvatar(name="paper", config=named("paper"), width=1285, height=940))


@runtime_checkable
class AgreementLine(Protocol):
    """How far the images that are played are from those by the definitions; its fields are those of the JSON."""

    def told(self) -> str:
        """In one line."""
        ...


@dataclass(frozen=True, kw_only=True)
class PictureAgreement:
    """How far the image that is played is from the one by the definitions, which the avatar was trained against."""

    preset: str
    gaussians: int
    psnr_db: float
    engine: str  # of the decoders, on one thread

    def told(self) -> str:
        """In one line."""
        about = f"{self.gaussians:,} Gaussians, decoders in {self.engine}"
        return f"{self.preset}: {about}; agrees with the definitions to {self.psnr_db:.1f} dB"


def speed_frame(
    capture: Capture,
    *,
    timed: tuple[TimedAvatar, ...] | None = None,
    threads: tuple[int, ...] = (1, 2),
    rounds: int = 15,
    device: torch.device = CPU,
) -> Iterator[list[SpeedRow] | PictureAgreement]:
    """Time frames and steps on a capture; yields results as they come. `timed`: all `subjects()` where none are given.

    Nothing is trained for long, the template's graph networks for a step: a network takes its time whatever its weights
    are, and texels start as they are drawn.
    Frames follow each other as in playback. Large presets are timed a tenth as often.
    """
    before = torch.get_num_threads()
    threads = threads if device == CPU else (1,)  # A GPU is fed by one.
    try:
        for subject in timed or subjects():
            config = replace(subject.config, device=str(device))
            few = max(2, rounds // 10) if config.model.width >= 64 else rounds
            avatar = AshAvatar(replace(config, template=replace(config.template, steps=1)), capture)
            _wake(avatar)
            camera = scaled_camera(next(iter(capture.cameras.values())), subject.width, subject.height)
            players = players_of(avatar, capture.motion, camera, threads)
            yield agreement(avatar, players[threads[0]], subject.name, capture, camera)
            yield _time_frames(avatar, players, subject.name, capture, camera, rounds=few)
            if subject.trains:
                yield _time_steps(avatar, subject.name, capture, rounds=rounds)
    finally:
        torch.set_num_threads(before)


def players_of(avatar: AshAvatar, motion: Motion, camera: Camera, threads: tuple[int, ...]) -> dict[int, Player]:
    """A player for each number of threads, whose engines were measured on as many."""
    players = {}
    for count in threads:
        torch.set_num_threads(count)
        players[count] = Player(avatar, motion, camera)
    return players


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view in another size of image, the subject as large in the height."""
    K = camera.K.copy()
    K[:2] *= height / camera.height
    K[0, 2] += (width - camera.width * height / camera.height) / 2
    return Camera(name=camera.name, width=width, height=height, K=K, viewmat=camera.viewmat)


def _wake(avatar: AshAvatar) -> None:
    """Give the networks something to say: an untrained head is zero."""
    generator = torch.Generator().manual_seed(0)
    decoders = avatar.module.decoders
    assert decoders is not None
    for name, parameter in decoders.named_parameters():
        if "head" in name or name == "shapes":
            parameter.data.copy_(0.01 * torch.randn(parameter.shape, generator=generator, device=CPU))


@torch.no_grad()
def frame_by_definition(model: AshModel, pose: Pose, camera: Camera) -> np.ndarray:
    """The image of a frame by the definitions alone, on one thread: premultiplied RGBA, float32 `[h, w, 4]`."""
    torch.set_num_threads(1)
    posed = model.template.pose(pose)
    canonical, normals, transforms = place_naive(model.lattice, posed, model.config.anchor)
    conditions = replace(model.conditions(pose), canonical=canonical, normals=normals, transforms=transforms)
    shares = model.shares(model.decode(conditions), conditions)
    drawn = [(share, _splatted_by_definition(model, raw, conditions, [camera], None)) for share, raw in shares]
    return image_of(mixed(drawn))


def _splatted_by_definition(
    model: AshModel, raw: Tensor, conditions: object, cameras: list[Camera], background: Tensor | None
) -> Splatted:
    gaussians = pose_naive(raw, conditions, model.config, model.light)  # type: ignore[arg-type]
    views = {name: moved(value, gaussians.means.device) for name, value in views_of(cameras).items()}
    return splat_naive(gaussians, **views, background=background, dilation=model.config.dilation)


def agreement(avatar: AshAvatar, player: Player, preset: str, capture: Capture, camera: Camera) -> PictureAgreement:
    """Foreground PSNR between the image of a frame as it is played and the one by the definitions."""
    frame = capture.splits["train"].frames[-1]
    defined = frame_by_definition(avatar.module, Pose(capture.motion, frame), camera)
    agrees = agreement_db(player.draw(frame, camera), defined)
    engine = player.engine.name if player.engine else "none"
    return PictureAgreement(preset=preset, gaussians=avatar.gaussian_count(), psnr_db=agrees, engine=engine)


def agreement_db(drawn: np.ndarray, defined: np.ndarray) -> float:
    """PSNR between two premultiplied RGBA images `[h, w, 4]` in dB, on the foreground of the one by the definitions."""
    return psnr(drawn[..., :3], defined[..., :3], defined[..., 3])


def timed_frame(player: Player, frame: int, camera: Camera, threads: int) -> dict[str, float]:
    """Milliseconds of a frame's stages and of the whole, played on so many threads."""
    torch.set_num_threads(threads)
    clock, start = StageClock(), time.perf_counter()
    player.draw(frame, camera, clock=clock)
    elapsed = (time.perf_counter() - start) * 1e3
    return {stage: clock.ms[stage] for stage in STAGES} | {"frame": elapsed}


def frame_rows(
    samples: Samples,
    defined_ms: list[float],
    name: str,
    camera: Camera,
    device: torch.device,
) -> list[SpeedRow]:
    """Rows of the frame by the definitions, then of every stage and the whole frame by threads."""
    size = f"{camera.width}x{camera.height}"
    reference = min(defined_ms)
    rows = [row_of("frame", size, "forward", 1, f"{name}-naive", defined_ms, reference, device)]
    for (what, count), taken in samples.items():
        over = reference if what == "frame" else math.nan
        rows.append(row_of(what, size, "forward", count, name, taken, over, device))
    return rows


def _time_frames(
    avatar: AshAvatar, players: dict[int, Player], preset: str, capture: Capture, camera: Camera, *, rounds: int
) -> list[SpeedRow]:
    """Rows of every stage and of the whole frame, by threads; the definitions first, drawn once."""
    threads = tuple(players)
    frames = capture.splits["train"].frames
    start = time.perf_counter()
    frame_by_definition(avatar.module, Pose(capture.motion, frames[0]), camera)
    defined_ms = [(time.perf_counter() - start) * 1e3]
    samples: Samples = defaultdict(list)
    for number in range(rounds + 1):
        for count in threads:
            # Another motion frame every time, and the history of each posed already, as in playback.
            frame = frames[(1 + number * len(threads) + threads.index(count)) % len(frames)]
            measured = timed_frame(players[count], frame, camera, count)
            if number:
                for what, value in measured.items():
                    samples[what, count].append(value)
    return frame_rows(samples, defined_ms, preset, camera, avatar.device)


def _time_steps(avatar: AshAvatar, preset: str, capture: Capture, *, rounds: int) -> list[SpeedRow]:
    """A step of training on the capture's images, with the definitions in torch and with the kernels, by turns."""
    torch.set_num_threads(1)
    images = load_training_images(capture, avatar.device)
    groups = avatar.parameter_groups()
    optimisers = {name: Adam([group | {"lr": 0.0} for group in groups]) for name in ("naive", "native")}
    samples: dict[str, list[float]] = {"naive": [], "native": []}
    for number in range(1 + max(1, rounds // 5)):
        for name in ("naive", *["native"] * 5):
            batch = draw_batch(images, avatar.config.training, 0, number)
            avatar._conditions_of(batch.frame)
            finish(avatar.device)
            start = time.perf_counter()
            _step(avatar, batch, optimisers[name], naive=name == "naive")
            finish(avatar.device)
            if number:
                samples[name].append((time.perf_counter() - start) * 1e3)
    camera = next(iter(images.cameras.values()))
    size = f"{camera.width}x{camera.height}"
    reference = min(samples["naive"])
    return [
        row_of(
            "train_step",
            size,
            "forward+backward",
            1,
            preset if name == "native" else f"{preset}-naive",
            taken,
            reference,
            avatar.device,
        )
        for name, taken in samples.items()
    ]


def _step(avatar: AshAvatar, batch: Batch, optimiser: Adam, *, naive: bool) -> None:
    training = avatar.config.training
    conditions = avatar._conditions_of(batch.frame)
    if naive:
        raw = avatar.module.decode(conditions)
        drawn = _splatted_by_definition(avatar.module, raw, conditions, batch.cameras, batch.background).rgb
    else:
        (drawn,) = draw_training_step(avatar, [batch], training.steps)
    loss = l1_ssim_loss_naive if naive else l1_ssim_loss
    losses = [
        loss(image, ssim_target(target), l1_weight=training.l1_weight, ssim_weight=training.ssim_weight)
        for image, target in zip(drawn, batch.targets, strict=True)
    ]
    optimiser.zero_grad()
    torch.stack(losses).mean().backward()  # type: ignore[no-untyped-call]
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
    """Print the table of a capture, and write it to `json_path`; returns the exit code."""
    return print_table(speed_frame(captured(folder), device=device), json_path, device)


def print_table(results: Iterable[list[SpeedRow] | AgreementLine], json_path: Path | None, device: torch.device) -> int:
    """Print rows and agreements as they come, and write them to `json_path`; returns the exit code."""
    print(f"device {device}")
    print(f"{'what':10} {'size':9} {'pass':17} th {'by':18} {'min ms':>9} {'median ms':>9} {'naive/min':>9} {'1/s':>6}")
    rows: list[SpeedRow] = []
    agreements: list[AgreementLine] = []
    for result in results:
        if not isinstance(result, list):
            agreements.append(result)
            print(f"  {result.told()}", flush=True)
            continue
        rows += result
        for row in result:
            ratio = "" if math.isnan(row.ratio) else f"{row.ratio:9.1f}"
            rate = f"{1e3 / row.median_ms:6.1f}" if row.what in ("frame", "train_step") else ""
            print(
                f"{row.what:10} {row.size:9} {row.pass_:17} {row.threads:2} {row.candidate:18}"
                f" {row.min_ms:9.2f} {row.median_ms:9.2f} {ratio:>9} {rate:>6}",
                flush=True,
            )
    print("the paper, on an A100 with its learned template at 1285x940:")
    for texels, found in PAPER_MS.items():
        stages = ", ".join(f"{name} {ms:.2f}" for name, ms in found.items())
        print(f"  {texels} texels: {stages} ms, {1e3 / found['frame']:.2f} frames per second")
    if json_path is not None:
        content = {"rows": [as_json(row) for row in rows], "agreements": [vars(a) for a in agreements]}
        write_json(json_path, content | {"paper_ms": PAPER_MS})
    return 0
