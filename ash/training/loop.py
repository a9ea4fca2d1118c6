"""The loop: Adam over anything that draws views differentiably. ASH, its ablations and the mesh baseline all use it.

Sampling is a function of (seed, step), so that a run stopped anywhere and resumed makes the same steps. When it ends is
decided in `ash.training.stopping`, from scores, which are part of the checkpoint; a limit in seconds counts CPU time.
"""

import json
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import safetensors
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor

from ash.capture.dataset import Camera
from ash.checkpoints import contiguous_state, load_module, read_safetensors
from ash.config import TrainingConfig
from ash.devices import CPU
from ash.files import InputError, write_atomic
from ash.native.library import keep_freed_memory
from ash.protocol import TrainingOutcome
from ash.training.adam import Adam
from ash.training.batches import Batch, draw_step, make_batch
from ash.training.images import READERS, ReadAhead, TrainingImages
from ash.training.stopping import (
    ReservedScore,
    ScheduleState,
    gain_of_last_third,
    is_eval_step,
    last_step,
    rate_factor,
    update,
)

LOG_EVERY = 50
FIRST_STEPS = 8  # Each of them is logged, with its gradient: the gate compares them bit by bit.
CHECKPOINT_SECONDS = 60.0  # Between two checkpoints.
SNAPSHOT_SECONDS = tuple(round(30 * 2 ** (i / 2)) for i in range(13))  # Half a minute to half an hour of CPU time.


class Diverged(FloatingPointError):
    """Training produced NaN or infinity twice. That is a result, and is recorded as one."""


class Interrupted(KeyboardInterrupt):
    """SIGTERM came; the state was saved."""


@runtime_checkable
class Trainable(Protocol):
    """What the loop needs of a model."""

    @property
    def module(self) -> torch.nn.Module:
        """Everything that is saved in a checkpoint."""

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Adam's groups, each with its own `lr`."""

    def loss(self, batches: Sequence[Batch], step: int) -> Tensor:
        """What a step minimises, a scalar.

        Raises:
            FloatingPointError: what the weights make cannot be drawn, because it holds NaN or infinity, say.
        """

    def render_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Float[Tensor, "c h w 3"]:
        """Rgb of a training frame over `background`, for cameras of one size.

        Raises:
            FloatingPointError: as `loss`.
        """


class Trainer:
    """Trains a `Trainable` on images: the loop, and all that a checkpoint holds.

    Optimiser, number of steps made, CPU seconds, and what the schedule decided so far.
    """

    def __init__(
        self, learner: Trainable, config: TrainingConfig, images: TrainingImages, *, folder: Path, seed: int
    ) -> None:
        """Checkpoints and `log.jsonl` go to `folder`."""
        keep_freed_memory()
        self.learner, self.config, self.seed = learner, config, seed
        self.images = replace(images, whole=not config.crop)
        groups = learner.parameter_groups()
        self.optimiser = Adam(groups, eps=1e-15)
        self.initial_rates = [group["lr"] for group in groups]
        self.folder, self.path, self.log = folder, folder / "checkpoint.safetensors", folder / "log.jsonl"
        self.steps, self.seconds, self.rate_scale = 0, 0.0, 1.0
        self.state = ScheduleState()
        self.average: dict[str, Tensor] = {}
        self.averaged: list[Tensor] = []  # the parameters, in the order of `average`
        self._average_afresh()
        self.started, self.saved_at = time.process_time(), time.monotonic()

    def fit(self, before_start: Callable[[], None] = lambda: None) -> TrainingOutcome:
        """Train until nothing more is learned or a limit is spent, from the checkpoint in the folder if there is one.

        `before_start` runs only when training starts afresh (warm-ups that do not render).

        Raises:
            Diverged: a loss, gradient or weight was not finite, again after one roll-back with half the learning rate.
            Interrupted: SIGTERM came; the checkpoint holds everything up to the last whole step.
        """
        if not self.load():
            before_start()
            self._average_afresh()
            if not self.save():
                raise Diverged("the warm-up left weights that are not finite")
        # A thread beside the one core that a cell has on the CPU would gain nothing.
        ahead = ReadAhead(self.images.views, readers=0 if self.images.device == CPU else READERS)
        with closing(ahead), _sigterm() as asked_to_stop:
            while not self.has_ended or not self.save():  # What cannot be saved was rolled back: on from there.
                self.step(draw_step(ahead, self.images, self.config, self.seed, self.steps))
                if asked_to_stop():
                    self.save()
                    raise Interrupted(f"stopped at step {self.steps} of {self.config.steps}; run again to go on")
                if time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
                    self.save()
        self._load_weights(self.average)  # The result is the average, if there is one; the checkpoint holds both.
        return self._outcome()

    @property
    def has_ended(self) -> bool:
        """Whether no step is left."""
        return self.steps >= last_step(self.state, self.config)

    def _average_afresh(self) -> None:
        """Let the average of the weights start from the weights as they are."""
        if self.config.ema:
            learned = dict(self.learner.module.named_parameters())
            self.average = {name: value.detach().clone() for name, value in learned.items()}
            self.averaged = [value.detach() for value in learned.values()]

    def step(self, batches: Sequence[Batch]) -> None:
        """One step of Adam; one that is not finite is rolled back to the last checkpoint."""
        factor = rate_factor(self.state, self.config, step=self.steps) * self.rate_scale
        for group, rate in zip(self.optimiser.groups, self.initial_rates, strict=True):
            group["lr"] = rate * factor
        self.optimiser.zero_grad()
        try:
            loss = self.learner.loss(batches, self.steps)
        except FloatingPointError as error:
            self._roll_back(str(error))
            return
        loss.backward()  # type: ignore[no-untyped-call]
        if not (math.isfinite(loss.item()) and self.optimiser.step()):
            self._roll_back("loss or gradient not finite")
            return
        if self.average:
            # A short memory at first, so that the start is soon forgotten.
            weight = 1 - min(self.config.ema, (1 + self.steps) / (10 + self.steps))
            torch._foreach_lerp_(list(self.average.values()), self.averaged, weight)
        self.steps += 1
        self._look(loss)

    def _look(self, loss: Tensor) -> None:
        """Score the reserved views where it is time to, decide what follows from it, and write the log."""
        is_due = is_eval_step(self.steps) and self.steps >= self.config.score_from
        if self.images.reserved and (is_due or self.has_ended):
            self._score()
        self.state = update(self.state, self.config, step=self.steps, seconds=self._elapsed())
        regular = self.steps <= FIRST_STEPS or self.steps % LOG_EVERY == 1
        if regular or self.has_ended or self._score_of_this_step() is not None:
            self._write_log(loss)
        if self.config.snapshots:
            self._save_snapshots()

    def _score(self) -> None:
        with self._ema_weights():
            score = ReservedScore(step=self.steps, psnr=self._reserved_psnr())
        if math.isfinite(score.psnr):  # Else the next step meets the same, and deals with it.
            self.state = replace(self.state, scores=(*self.state.scores, score))

    def _score_of_this_step(self) -> float | None:
        last = self.state.scores[-1:]
        return last[0].psnr if last and last[0].step == self.steps else None

    def _roll_back(self, why: str) -> None:
        if self.rate_scale < 1:
            raise Diverged(f"{why} at step {self.steps}, again after a roll-back")
        self.load()
        self.rate_scale = 0.5

    def _write_log(self, loss: Tensor) -> None:
        row = {"step": self.steps, "seconds": round(self._elapsed(), 3), "loss": float(loss.detach())}
        if self.steps <= FIRST_STEPS:
            gradients = [p.grad for p in self.learner.module.parameters() if p.grad is not None]
            row["gradient"] = float(torch.stack([gradient.double().norm() for gradient in gradients]).norm())
        if (psnr := self._score_of_this_step()) is not None:
            row["train_psnr"] = psnr
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a") as file:
            file.write(json.dumps(row) + "\n")

    @torch.no_grad()
    def _reserved_psnr(self) -> float:
        """Foreground PSNR of the training views that no step sees, in dB."""
        errors = []
        for name, frame in self.images.reserved:
            view = make_batch(self.images, frame, [name], torch.zeros(3, device="cpu"))
            try:
                drawn = self.learner.render_views(frame, view.cameras, view.background)
            except FloatingPointError:
                return math.nan
            errors.append((drawn.clamp(0, 1) - view.targets)[view.foreground > 0.5].square().flatten())
        return float(-10 * torch.log10(torch.cat(errors).mean()))

    def _elapsed(self) -> float:
        return self.seconds + time.process_time() - self.started

    def save(self) -> bool:
        """Write the checkpoint atomically. False: the weights are not finite, and were rolled back instead."""
        if not all(torch.isfinite(value).all() for value in self.learner.module.state_dict().values()):
            if self.path.exists():
                self._roll_back("weights not finite")
            return False
        tensors = {f"model.{name}": value for name, value in contiguous_state(self.learner.module).items()}
        for index, moments in enumerate(self.optimiser.moments):
            for name, value in (moments or {}).items():
                tensors[f"adam.{index}.{name}"] = value.contiguous()
        tensors |= {f"average.{name}": value.contiguous() for name, value in self.average.items()}
        facts = {"step": str(self.steps), "seconds": repr(self._elapsed()), "rate_scale": repr(self.rate_scale)}
        facts["course"] = self.state.to_json()
        write_atomic(self.path, safetensors.torch.save(tensors, metadata=facts))
        self.saved_at = time.monotonic()
        return True

    @contextmanager
    def _ema_weights(self) -> Iterator[None]:
        """With the weights as they would be used: averaged, if they are averaged at all."""
        own = {name: value.detach().clone() for name, value in self._averaged()}
        self._load_weights(self.average)
        try:
            yield
        finally:
            self._load_weights(own)

    def _averaged(self) -> list[tuple[str, torch.nn.Parameter]]:
        return list(self.learner.module.named_parameters()) if self.average else []

    @torch.no_grad()
    def _load_weights(self, weights: dict[str, Tensor]) -> None:
        for name, value in self._averaged():
            value.copy_(weights[name])

    def _save_snapshots(self) -> None:
        """Keep the weights as they would be used after so many seconds; what is there already is kept."""
        for seconds in SNAPSHOT_SECONDS:
            path = self.folder / "snapshots" / f"{seconds:06d}.safetensors"
            if seconds <= self._elapsed() and not path.exists():
                with self._ema_weights():
                    write_atomic(path, safetensors.torch.save(contiguous_state(self.learner.module)))

    def _outcome(self) -> TrainingOutcome:
        return TrainingOutcome(
            steps=self.steps,
            seconds=self._elapsed(),
            ended_by=self.state.ended_by,
            gained=gain_of_last_third(self.state.scores),
            reserved_psnr=self._score_of_this_step(),
            cameras=len(self.images.cameras),
            frames=len(self.images.frames),
        )

    def load(self) -> bool:
        """Load the checkpoint, if there is one.

        Raises:
            InputError: it is damaged, or of another configuration.
        """
        if not self.path.exists():
            return False
        tensors, facts = read_safetensors(self.path)
        load_module(self.learner.module, {n[6:]: t for n, t in tensors.items() if n.startswith("model.")}, self.path)
        try:
            self._load_state(tensors, facts)
        except (KeyError, ValueError, RuntimeError, OverflowError) as error:
            raise InputError(f"{self.path}: expected a whole checkpoint ({type(error).__name__}: {error})") from error
        return True

    def _load_state(self, tensors: dict[str, Tensor], facts: dict[str, str]) -> None:
        """Moments, averages and the place in the course, as they were saved."""
        if not all(torch.isfinite(tensor).all() for tensor in tensors.values()):
            raise ValueError("NaN or infinity among its numbers")
        for index, parameter in enumerate(self.optimiser.parameters):
            if f"adam.{index}.step" not in tensors:  # It never had a gradient.
                self.optimiser.moments[index] = None
                continue
            moments = self.optimiser.moments[index] = Adam.moments_like(parameter)
            for name, value in moments.items():
                value.copy_(tensors[f"adam.{index}.{name}"])
        for name, value in self.average.items():
            value.copy_(tensors[f"average.{name}"])
        self.steps, self.seconds = int(facts["step"]), float(facts["seconds"])
        self.rate_scale, self.state = float(facts["rate_scale"]), ScheduleState.from_json(facts["course"])
        if self.steps < 0 or not (0 <= self.seconds < math.inf and 0 < self.rate_scale <= 1):
            raise ValueError(f"step {self.steps} after {self.seconds} s at {self.rate_scale} of the rate")
        self.started = time.process_time()


class _sigterm:
    """Turns SIGTERM into a question that the loop asks after each step (main thread only)."""

    def __enter__(self) -> Callable[[], bool]:
        self.asked = False
        try:
            self.previous = signal.signal(signal.SIGTERM, self._ask)
        except ValueError:  # Not the main thread: signals are somebody else's business.
            self.previous = None
        return lambda: self.asked

    def _ask(self, *_: object) -> None:
        self.asked = True

    def __exit__(self, *_: object) -> None:
        if self.previous is not None:
            signal.signal(signal.SIGTERM, self.previous)
