"""An executor for tests to which it does not matter where captures are rendered."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any


class InThisProcess(Executor):
    """Does at once what it is given: no other process has to start first."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """What the call returned; what it raises, it raises here."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
