"""The flag `--device` of commands that train or draw: which device is meant, and which rows of a suite can take it."""

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from benchmarks.commands.arguments import Argument

if TYPE_CHECKING:
    from benchmarks.suites.suites import MethodSpec, Suite

CPU = "cpu"
DeviceName = Annotated[str, Argument(metavar="DEVICE")]


def chosen_device(name: str, *, here: bool = True) -> str:
    """The device that is meant: `auto` takes CUDA where everything works there, and says why where it does not.

    `here`: cells run on this machine, so that it must have the device.

    Raises:
        InputError: there is no such device; says why.
    """
    from ash.config import check_device
    from ash.devices import cuda_error, device_named

    if name != "auto":
        device_named(name) if here else check_device(name)
        return name
    why = cuda_error()
    if why:
        print(f"device: {CPU}, because {why}", file=sys.stderr)
    return CPU if why else "cuda"


def gpus_for(device: str) -> tuple[str, ...]:
    """The GPUs that cells on this device share out: all for `cuda`, the one that is named for `cuda:1`."""
    from benchmarks.suites.gpus import ANY, visible_gpus

    if device == CPU:
        return ()
    return visible_gpus() if device == ANY else (device,)


def on_device(suite: "Suite", device: str) -> "Suite":
    """The suite with the rows that have a device learning and drawing on this one. The CPU is where all are anyway."""
    if device == CPU:
        return suite
    return replace(suite, methods=tuple(_moved(row, row.preset or suite.preset, device) for row in suite.methods))


def _moved(row: "MethodSpec", preset: str, device: str) -> "MethodSpec":
    from benchmarks.cell.registry import brought_folder, offered

    if brought_folder(row.of) is not None or not hasattr(offered(row.of or row.name, preset), "device"):
        return row
    return replace(row, changes=tuple(sorted({**dict(row.changes), "device": device}.items())))
