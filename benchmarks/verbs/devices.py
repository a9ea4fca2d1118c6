"""The flag `--device` of verbs that train: which device is meant, and which rows of a suite can take it."""

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

if TYPE_CHECKING:
    from benchmarks.suites.suites import MethodSpec, Suite

CPU = "cpu"
DeviceName = Annotated[str, arg(metavar="DEVICE")]


def chosen_device(wanted: str) -> str:
    """The device that is meant: `auto` takes CUDA where everything works there, and says why where it does not.

    Raises:
        InputError: there is no such device here; says why.
    """
    from ash.devices import device_named, obstacle

    if wanted != "auto":
        device_named(wanted)
        return wanted
    why = obstacle()
    if why:
        print(f"device: {CPU}, because {why}", file=sys.stderr)
    return CPU if why else "cuda"


def on_device(suite: "Suite", device: str) -> "Suite":
    """The suite with the rows that have a device learning and drawing on this one. The CPU is where all are anyway."""
    if device == CPU:
        return suite
    return replace(suite, methods=tuple(_moved(row, row.preset or suite.preset, device) for row in suite.methods))


def _moved(row: "MethodSpec", preset: str, device: str) -> "MethodSpec":
    from benchmarks.cell.methods import offered

    if not hasattr(offered(row.of or row.name, preset), "device"):
        return row
    return replace(row, changes=tuple(sorted({**dict(row.changes), "device": device}.items())))
