"""GPUs, lent to cells: the process of a cell that learns on CUDA sees one of them, the least busy."""

import os
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from benchmarks.cell.schema import CellConfig

VISIBLE = "CUDA_VISIBLE_DEVICES"
ANY = "cuda"  # The device of a cell that takes whichever GPU it is given; cuda:1 names its own.

_lent: Counter[str] = Counter()
_lending = threading.Lock()


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that this process may use, as the variable names them: those of a list that the user gave, or all."""
    import torch

    count, listed = torch.cuda.device_count(), os.environ.get(VISIBLE)
    names = map(str, range(count)) if listed is None else (name.strip() for name in listed.split(","))
    return tuple(names)[:count]


@contextmanager
def lent_gpu(gpus: Sequence[str], config: CellConfig) -> Iterator[dict[str, str]]:
    """What a cell's process is told of GPUs for as long as the body runs; nothing where it wants none of `gpus`."""
    if not gpus or config.device != ANY:
        yield {}
        return
    with _lending:
        gpu = min(gpus, key=_lent.__getitem__)
        _lent[gpu] += 1
    try:
        yield {VISIBLE: gpu}
    finally:
        with _lending:
            _lent[gpu] -= 1
