"""Where a step of training spends its time, part by part: `ash-bench speed frame --profile`.

The step is the loop's own. Its parts are timed from outside: a part's forward pass as it is called, its backward pass
from the moment when the gradients of all that it returned are there until those of the part before it are. Parts are
CPU time of the thread, in which waiting for a core does not count; "train_step" is wall time. A step that also learns
vertices is timed as a whole, and its parts are not.
"""

import math
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

import ash.trained_avatar
from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.devices import CPU, finish
from ash.files import write_json
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted
from ash.native.library import has_tiles
from ash.training.batches import draw_batch
from ash.training.images import TrainingImages, load_training_images
from ash.training.loop import Trainer
from baselines.ddc import DdcAvatar, ddc, ddc_plus
from benchmarks.speed.frames import captured
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

VERTICES = "step with vertices"  # of the mesh
FORWARD = ("batch", "decode", "pose", "draw", "loss")
BACKWARD = ("loss backward", "draw backward", "pose backward", "decode backward")
PARTS = (*FORWARD, *BACKWARD, "adam", "rest", "step")  # "step": the whole; "rest": what no other part holds
STEPS = 80
FACTORIES: dict[str, presets.MethodFactory[Any]] = {
    "ash": presets.ash,
    "ash_plus": presets.ash_plus,
    "ddc": ddc,
    "ddc_plus": ddc_plus,
}
SUBJECTS = (
    ("ash", "cpu", "float32"),
    ("ash", "cpu", "bfloat16"),
    ("ash_plus", "cpu", "float32"),
    ("ddc", "cpu", "float32"),
    ("ddc_plus", "cpu", "float32"),
)


class _Parts:
    """Seconds of the parts of one step on a device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.spent: dict[str, float] = defaultdict(float)
        self.gradients_at: dict[str, float] = {}  # when the last gradient of what a part returned was there
        self.span: dict[str, tuple[float, float]] = {}  # of the last call

    def now(self) -> float:
        """The CPU time of this thread; on a GPU the clock, once all that was queued is done."""
        if self.device.type == "cpu":
            return time.thread_time()
        finish(self.device)
        return time.perf_counter()

    def timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, with its time counted for the part, and the moment of its results' gradients noted."""

        def run(*arguments: Any, **options: Any) -> Any:
            start = self.now()
            result = call(*arguments, **options)
            self.span[name] = start, self.now()
            self.spent[name] += self.span[name][1] - start
            for tensor in _tensors_in(result):
                if tensor.requires_grad and not tensor.is_leaf:
                    tensor.register_hook(lambda _: self.gradients_at.__setitem__(name, self.now()))
            return result

        return run

    def split_backward(self) -> None:
        """Share out the backward pass, from the loss to Adam, between the parts whose results it passed."""
        order = [name for name in ("draw", "pose", "decode") if name in self.gradients_at]
        moments = [self.span["loss"][1], *(self.gradients_at[name] for name in order), self.span["adam"][0]]
        self.spent |= dict.fromkeys(BACKWARD, 0.0)
        for name, (begun, done) in zip(("loss", *order), pairwise(moments), strict=True):
            self.spent[f"{name} backward"] = done - begun


def _tensors_in(result: Any) -> list[Tensor]:
    """The part's results that the loss depends on."""
    if isinstance(result, Gaussians):
        return [getattr(result, name) for name in result.__slots__]
    if isinstance(result, Splatted):
        return [result.rgb]
    parts = result if isinstance(result, list | tuple) else [result]
    return [part for part in parts if isinstance(part, Tensor)]


def profiled(learner: AshAvatar | DdcAvatar, images: TrainingImages, name: str, folder: Path) -> Candidate:
    """Steps of a training, to be timed; each returns the milliseconds of its parts. The learner learns meanwhile.

    The first epoch is made at once: it poses each frame's template.
    """
    training = learner.config.training
    first = training.warmup_steps  # Before, decoders do not take part.
    config = replace(training, warmup="none", warmup_steps=0, steps=10**9)
    trainer = Trainer(learner, config, images, folder=folder, seed=0)
    epoch = len(images.frames)

    def step(number: int) -> dict[str, float]:
        trainer.steps = first + number
        parts = _Parts(learner.device)
        start = parts.now()
        with _timed_parts(parts, learner, trainer):
            trainer.step([parts.timed("batch", draw_batch)(images, config, 0, trainer.steps)])
        whole = parts.now() - start
        if isinstance(learner, DdcAvatar) and (first + number) % learner.config.vertices_every == 0:
            return {VERTICES: 1e3 * whole}
        parts.split_backward()
        seconds = parts.spent | {"rest": whole - sum(parts.spent.values()), "step": whole}
        return {part: 1e3 * seconds[part] for part in PARTS if part in seconds}

    for number in range(epoch):
        step(number)
    return Candidate(name=name, threads=1, call=lambda number: step(epoch + number))


@contextmanager
def _timed_parts(parts: _Parts, learner: AshAvatar | DdcAvatar, trainer: Trainer) -> Iterator[None]:
    """Time the parts of the step that the body makes."""
    parts_of = {"gaussians": "pose", "rasterize": "draw"}
    if isinstance(learner, DdcAvatar):
        parts_of = {"refined": "pose", "see": "draw", "rasterize": "draw"}
    timed: list[tuple[Any, str, str]] = [
        (learner, "_decode", "decode"),
        *((learner.module, name, part) for name, part in parts_of.items()),
    ]
    timed += [(ash.trained_avatar, "view_loss", "loss"), (trainer.optimiser, "step", "adam")]
    with ExitStack() as stack:
        for owner, name, part in timed:
            stack.enter_context(patch.object(owner, name, parts.timed(part, getattr(owner, name))))
        yield


def profile_rows(capture: Capture, device: torch.device = CPU) -> list[SpeedRow]:
    """The subjects' steps, interleaved, on one thread and a device, as they learn from a capture."""
    images = load_training_images(capture, device)
    candidates = []
    with torch_threads_restored(), tempfile.TemporaryDirectory() as folder:
        torch.set_num_threads(1)
        for method, preset, precision in SUBJECTS:
            if precision == "bfloat16" and device == CPU and not has_tiles():
                continue
            make = FACTORIES[method].with_overrides({"training.precision": precision, "device": str(device)})
            learner: AshAvatar | DdcAvatar = make(capture, seed=0, preset=preset)
            name = f"{method} {preset} {precision}"
            candidates.append(profiled(learner, images, name, Path(folder) / name))
        samples = time_interleaved(candidates, rounds=STEPS, warm_up=False, device=device)
    camera = next(iter(images.cameras.values()))
    rows = rows_of("train_step", f"{camera.width}x{camera.height}", "forward+backward", samples, device)
    return [replace(row, ratio=math.nan) for row in rows]  # No definition is timed beside them.


def main(json_path: Path | None, folder: Path | None, device: torch.device = CPU) -> int:
    """Print the profiles on a capture, and write them to `json_path`; returns the exit code."""
    print(f"device {device}")
    rows = profile_rows(captured(folder), device)
    print_head()
    print_rows(rows)
    if json_path is not None:
        write_json(json_path, {"rows": [as_json(row) for row in rows]})
    return 0
