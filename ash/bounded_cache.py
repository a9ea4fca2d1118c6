"""Values that are made when they are asked for, and kept as far as there is room for them."""

import threading
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from torch import Tensor

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")

MAX_BYTES = 256 * 2**20


class BoundedCache(Generic[Key, Value]):
    """Values by key. The first ones stay; from `max_bytes` on a value is made anew each time it is asked for.

    Training asks for frames in random order, each as often as the others: to drop one for another would gain nothing.
    Threads may ask side by side.
    """

    def __init__(self, make: Callable[[Key], Value], *, max_bytes: int = MAX_BYTES) -> None:
        self._make, self._max_bytes = make, max_bytes
        self._values: dict[Key, Value] = {}
        self._adding = threading.Lock()
        self.bytes = 0
        self.is_full = False  # Something was not kept.

    def __getitem__(self, key: Key) -> Value:
        """The value of a key, the same whether it was kept or not."""
        if key in self._values:
            return self._values[key]
        value = self._make(key)
        size = size_of(value)
        with self._adding:
            if key not in self._values and self.bytes + size <= self._max_bytes:
                self._values[key] = value
                self.bytes += size
            self.is_full |= key not in self._values
        return value


def size_of(value: Any) -> int:
    """Bytes of an array, a tensor, or of all of them in a dataclass or a list."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    if is_dataclass(value):
        return sum(size_of(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, list | tuple):
        return sum(map(size_of, value))
    return 0
