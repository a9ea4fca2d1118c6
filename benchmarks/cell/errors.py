"""How a method may fail: what it did, what was done to it, and what it did to others."""

from ash.files import one_line
from benchmarks.cell.schema import Status


class MethodFailed(Exception):
    """The method did not come through; `status` says how."""

    def __init__(self, status: Status, reason: str) -> None:
        super().__init__(one_line(reason))
        self.status: Status = status


class CaptureModifiedError(MethodFailed):
    """The capture is no longer what it was when a method that could reach it began."""

    def __init__(self, damage: str) -> None:
        super().__init__("crashed", f"while it ran without isolation the capture was changed: {damage}")


class HarnessFailed(Exception):
    """Something of ours failed before the method began, so that the method has no result from it."""


class Killed(Exception):
    """The method's process was killed by somebody else, such as the kernel for want of memory."""
