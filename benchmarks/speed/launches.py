"""How many kernels a training step asks a GPU for: each takes the processor some microseconds to launch.

What is counted is what torch is asked to compute, on whichever device, and Warp's launches beside it; what only looks
at a tensor in another way, or makes room for one, launches nothing. Several kernels may stand behind one operation, so
that the count is a lower bound. On the CPU it says little about a GPU, because native kernels do the work of many.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

from torch.utils._python_dispatch import TorchDispatchMode

from ash.config import TrainingConfig
from ash.training.adam import Adam
from ash.training.batches import Batch
from ash.training.loop import Trainable, draw_training_step, view_loss

LAUNCH_US = 5.0  # Of a kernel, on the processor: the order of magnitude that is usual for torch; not measured here.
NOTHING_LAUNCHED = frozenset(
    {
        "aten::_local_scalar_dense",
        "aten::_unsafe_view",
        "aten::_reshape_alias",
        "aten::empty",
        "aten::empty_like",
        "aten::empty_strided",
        "aten::lift_fresh",
        "aten::new_empty",
        "aten::new_empty_strided",
        "aten::resize_",
        "aten::set_",
    }
)


class LaunchCount(TorchDispatchMode):
    """Operations by name, the forward pass and the backward pass alike."""

    def __init__(self) -> None:
        super().__init__()
        self.of: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """Of all operations together."""
        return self.of.total()

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        """Count the operation, and let it be done."""
        name = function.name().split(".")[0]
        if not function.is_view and name not in NOTHING_LAUNCHED:
            self.of[name] += 1
        return function(*arguments, **(options or {}))


@contextmanager
def launches() -> Iterator[LaunchCount]:
    """Count what the body asks torch and Warp to launch."""
    import warp  # It takes a second.

    count = LaunchCount()

    def counted(launch: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            count.of["warp::launch"] += 1
            return launch(*arguments, **options)

        return run

    with patch.object(warp, "launch", counted(warp.launch)), count:
        yield count


def launches_of_step(learner: Trainable, batches: Sequence[Batch], training: TrainingConfig, optimiser: Adam) -> int:
    """Of the second step through the decoders: the first also makes what is kept for the next. Batches are there."""
    for _ in range(2):
        optimiser.zero_grad()
        with launches() as count:
            drawn = draw_training_step(learner, batches, training.static_steps)
            view_loss(drawn, batches, training).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
    return count.total


def launching_ms(count: int) -> float:
    """What launching so many kernels takes at least, milliseconds: a step on a GPU is never faster."""
    return count * LAUNCH_US / 1e3
