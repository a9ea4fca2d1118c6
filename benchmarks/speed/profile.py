"""Where a step of training spends its time, part by part: `ash-bench speed frame --profile`.

The step is the loop's own. Its parts are timed from outside: a part's forward pass as it is called, its backward pass
from the moment when the gradients of all that it returned are there until those of the part before it are. Time is the
thread's CPU time, in which waiting for a core does not count. A step that draws static views or learns vertices
besides is timed as a whole, and its parts are not.
"""

import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

import ash.training.loop
from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.config import TrainingConfig
from ash.devices import CPU, finish
from ash.files import write_json
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.splatting import Splatted
from ash.native.library import has_tiles
from ash.training.batches import draw_batch
from ash.training.images import TrainingImages, load_training_images
from baselines.ddc import DdcAvatar, ddc
from benchmarks.speed.frames import captured

STATIC, VERTICES = "step with static views", "step with vertices"  # Both at once in the mesh: the latter.
FORWARD = ("batch", "decode", "pose", "draw", "loss")
BACKWARD = ("loss backward", "draw backward", "pose backward", "decode backward")
PARTS = (*FORWARD, *BACKWARD, "adam", "rest", "step")  # "step": the whole; "rest": what no other part holds
KINDS = (*PARTS, STATIC, VERTICES)
STEPS = 80
SUBJECTS = (
    ("ash", "cpu", "float32"),
    ("ash", "cpu", "bfloat16"),
    ("ddc", "cpu", "float32"),
    ("ddc", "cpu", "bfloat16"),
)


@dataclass(frozen=True, kw_only=True)
class PartTime:
    """One part of one method's step."""

    method: str
    preset: str
    precision: str  # of the decoders
    part: str
    min_ms: float
    median_ms: float


class _Parts:
    """Seconds of the parts of the step in progress on a device."""

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
    """What the loss sees of a part's results."""
    if isinstance(result, Gaussians):
        return [getattr(result, name) for name in result.__slots__]
    if isinstance(result, Splatted):
        return [result.rgb]
    parts = result if isinstance(result, list) else [result]
    return [part for part in parts if isinstance(part, Tensor)]


def profile_step(
    method: str, learner: AshAvatar | DdcAvatar, images: TrainingImages, preset: str, *, steps: int
) -> list[PartTime]:
    """The parts of so many steps, after an epoch that is not counted. The learner learns meanwhile."""
    config = replace(learner.config.training, warmup="none", warmup_steps=0, steps=10**9)
    samples = list(_profiled_steps(learner, images, config, steps))
    return [
        PartTime(
            method=method,
            preset=preset,
            precision=config.precision,
            part=part,
            min_ms=1e3 * min(sample[part] for sample in samples if part in sample),
            median_ms=1e3 * statistics.median(sample[part] for sample in samples if part in sample),
        )
        for part in KINDS
        if any(part in sample for sample in samples)
    ]


def _profiled_steps(
    learner: AshAvatar | DdcAvatar, images: TrainingImages, config: TrainingConfig, steps: int
) -> Iterator[dict[str, float]]:
    first = learner.config.training.warmup_steps  # Before, decoders do not take part.
    warm = len(images.frames)  # An epoch: each frame's template is posed once.
    with tempfile.TemporaryDirectory() as folder:
        run = ash.training.loop.Trainer(learner, config, images, Path(folder))
        for number in range(steps + warm):
            run.step = first + number
            parts = _Parts(learner.device)
            start = parts.now()
            with _watched(parts, learner, run):
                run.advance([parts.timed("batch", draw_batch)(images, config, 0, run.step)])
            whole = parts.now() - start
            if number < warm:
                continue
            if kind := _what_else(learner, first + number):
                yield {kind: whole}
            else:
                parts.split_backward()
                yield parts.spent | {"rest": whole - sum(parts.spent.values()), "step": whole}


def _what_else(learner: AshAvatar | DdcAvatar, step: int) -> str:
    """What a step learns besides; empty: nothing."""
    if isinstance(learner, DdcAvatar) and step % learner.config.vertices_every == 0:
        return VERTICES
    return STATIC if step % learner.config.training.static_every == 0 else ""


@contextmanager
def _watched(parts: _Parts, learner: AshAvatar | DdcAvatar, run: ash.training.loop.Trainer) -> Iterator[None]:
    """Count the parts of the step that the body makes."""
    if isinstance(learner, AshAvatar):
        drawing = [(learner, "_decode", "decode"), (learner.module, "pose", "pose"), (learner.module, "draw", "draw")]
    else:
        drawing = [
            (learner, "decode_together", "decode"),
            (learner.module, "refined", "pose"),
            (learner.module, "see", "draw"),
            (learner.module, "draw", "draw"),
        ]
    rest = [(ash.training.loop, "view_loss", "loss"), (run.optimiser, "step", "adam")]
    with ExitStack() as stack:
        for owner, name, part in (*drawing, *rest):
            stack.enter_context(patch.object(owner, name, parts.timed(part, getattr(owner, name))))
        yield


def profiles(capture: Capture, device: torch.device = CPU) -> Iterator[list[PartTime]]:
    """The subjects' steps on one thread and a device, as they learn from a capture."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        images = load_training_images(capture, device)
        for method, preset, precision in SUBJECTS:
            if precision == "bfloat16" and not (device.type != "cpu" or has_tiles()):
                continue
            recipe: presets.MethodFactory[Any] = presets.ash if method == "ash" else ddc
            make = recipe.with_overrides({"training.precision": precision, "device": str(device)})
            learner: AshAvatar | DdcAvatar = make(capture, seed=0, preset=preset)
            yield profile_step(method, learner, images, preset, steps=STEPS)
    finally:
        torch.set_num_threads(before)


def print_profile(profile: list[PartTime]) -> None:
    """A line per part: least and median milliseconds."""
    name = f"{profile[0].method}, {profile[0].preset}, {profile[0].precision}"
    print(f"{name}: milliseconds of a training step on one thread, least and median")
    for row in profile:
        print(f"  {row.part:16} {row.min_ms:8.2f} {row.median_ms:8.2f}", flush=True)


def main(json_path: Path | None, folder: Path | None, device: torch.device = CPU) -> int:
    """Print the profiles on a capture, and write them to `json_path`; returns the exit code."""
    found: list[PartTime] = []
    print(f"device {device}")
    for profile in profiles(captured(folder), device):
        print_profile(profile)
        found += profile
    for method, preset in sorted({(row.method, row.preset) for row in found if row.precision == "bfloat16"}):
        took = {
            row.precision: row.min_ms for row in found if (row.method, row.preset, row.part) == (method, preset, "step")
        }
        print(f"{method}, {preset}: a step is {took['float32'] / took['bfloat16']:.2f} times as fast in bfloat16")
    if json_path is not None:
        write_json(json_path, {"parts": [vars(part) for part in found], "device": str(device)})
    return 0
