"""Waiting for what another process or thread does; a test that waits in vain fails, and never hangs."""

import time
from collections.abc import Callable


def wait_for(what: Callable[[], object], seconds: float = 60.0, *, about: Callable[[], object] = str) -> None:
    """Until `what()` is true; `about()` is told where it never is."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, f"still not so after {seconds:g} s {about()}"
        time.sleep(0.02)
