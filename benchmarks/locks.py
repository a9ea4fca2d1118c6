"""One run per folder: two at once would train the same cells twice."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from ash.files import InputError


@contextlib.contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the lock ends with the process, however that ends.

    Raises:
        InputError: another process holds it.
    """
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder}: another ash-bench is at work there; wait for it or choose another --out"
            ) from None
        yield
