"""Playback of a trained avatar: template and history cached, the decoders on the engine that is fastest here.

Engines are measured on the machine and in the process that plays, with as many threads as torch is given there. One
counts only where its image agrees with that of the precision that was trained. OpenVINO is one where it is installed
(`pip install ash-bench[openvino]`).
"""

import math
import time
import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Motion, Pose
from ash.decoders import Decoders
from ash.devices import CPU, finish
from ash.model import Decode, image_of
from ash.protocol import StageClock
from ash.textures import FrameInputs

LEAST_AGREEMENT_DB = 45.0  # An image at 30 dB from the truth changes by less than 0.3 dB.
ROUNDS = 5


@dataclass(frozen=True, kw_only=True, slots=True)
class Engine:
    """One way to run the decoders, and what it was found to be worth."""

    name: str
    decode: Decode
    ms: float  # the fastest of a few decodings
    agreement_db: float  # PSNR of its image against that of the trained precision, on the foreground


class Player:
    """Draws frames of a motion with a trained avatar, as fast as this machine can."""

    def __init__(self, avatar: AshAvatar, motion: Motion, camera: Camera) -> None:
        """Measures the engines on the motion's first frame, seen by `camera`."""
        self._model, self._motion = avatar.module, motion
        self.engines = self._measured(camera)
        self.engine = min(self.engines, key=lambda engine: engine.ms, default=None)

    @torch.no_grad()
    def draw(self, frame: int, camera: Camera, *, clock: StageClock | None = None) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`; stages are timed as the paper's `stg1` to `stg4`."""
        decoders = None if self.engine is None else self.engine.decode
        return image_of(self._model(Pose(self._motion, frame), camera, clock, decoders=decoders))

    @torch.no_grad()
    def _measured(self, camera: Camera) -> tuple[Engine, ...]:
        """All engines that agree; none where the avatar has no decoders."""
        decoders = self._model.decoders
        if decoders is None:
            return ()
        conditions = self._model.frame_inputs(Pose(self._motion, 0))
        ways: dict[str, Decode] = {"float32": decoders, "bfloat16": _in_bfloat16(decoders)}
        here = conditions.textures.device == CPU
        if here and isinstance(decoders, Decoders) and find_spec("openvino") is not None:
            ways["openvino"] = _in_openvino(decoders, conditions)
        images = {
            name: image_of(self._model(Pose(self._motion, 0), camera, decoders=way)) for name, way in ways.items()
        }
        trained = images["float32"]
        found = []
        for name, decode in ways.items():
            agreement = psnr(images[name][..., :3], trained[..., :3], trained[..., 3])
            if agreement >= LEAST_AGREEMENT_DB:
                found.append(
                    Engine(name=name, decode=decode, ms=_fastest_ms(decode, conditions), agreement_db=agreement)
                )
        return tuple(found)


def _in_bfloat16(decoders: nn.Module) -> Decode:
    """The decoders with weights and activations of half the size: faster where the processor multiplies them."""
    half = deepcopy(decoders).to(torch.bfloat16)

    def decode(conditions: FrameInputs) -> Tensor:
        with torch.autocast(conditions.textures.device.type, torch.bfloat16):
            raw: Tensor = half(conditions)
        return raw.float()

    return decode


class _OfTensors(nn.Module):
    """The decoders as a function of tensors alone, so that they can be traced."""

    def __init__(self, decoders: Decoders, conditions: FrameInputs) -> None:
        super().__init__()
        self.decoders, self.conditions = decoders, conditions

    def forward(self, textures: Tensor, root_translation: Tensor) -> Tensor:
        raw: Tensor = self.decoders(replace(self.conditions, textures=textures, root_translation=root_translation))
        return raw


def _in_openvino(decoders: Decoders, conditions: FrameInputs) -> Decode:
    """The decoders compiled by OpenVINO, in the precision that it takes for this processor's best."""
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    def inputs(seen: FrameInputs) -> tuple[Tensor, Tensor]:
        return seen.textures.contiguous(), seen.root_translation

    # Not by `openvino.convert_model`, which reports its use over the network.
    with warnings.catch_warnings(action="ignore"):  # Sizes become constants when traced, as they should.
        traced = torch.jit.trace(_OfTensors(decoders, conditions), inputs(conditions), check_trace=False)  # type: ignore[no-untyped-call]
    source = TorchScriptPythonDecoder(traced)
    frontend = FrontEndManager().load_by_framework("pytorch")
    options = {"INFERENCE_NUM_THREADS": torch.get_num_threads(), "PERFORMANCE_HINT": "LATENCY"}
    compiled = _openvino().compile_model(frontend.convert(frontend.load(source)), "CPU", options)

    def decode(seen: FrameInputs) -> Tensor:
        return torch.from_numpy(compiled([tensor.numpy() for tensor in inputs(seen)])[0])

    return decode


@cache
def _openvino() -> Any:
    """One core for the whole process, for good.

    Where the processor has AMX each core takes a stack for signals of its own, and gives the one before back when it
    goes: of two that go in the order in which they came, the second gives back memory that is gone, and the next
    signal ends the process.
    """
    import openvino  # Optional, and half a second that training does not need.

    return openvino.Core()


def _fastest_ms(decode: Callable[[FrameInputs], Tensor], conditions: FrameInputs) -> float:
    best = math.inf
    for _ in range(ROUNDS):
        start = time.perf_counter()
        decode(conditions)
        finish(conditions.textures.device)
        best = min(best, time.perf_counter() - start)
    return best * 1e3


def psnr(image: np.ndarray, reference: np.ndarray, alpha: np.ndarray) -> float:
    """Of float colours `[h, w, 3]` in dB, where `alpha` `[h, w]` is above one half; infinite where nothing differs."""
    error = (image - reference)[alpha > 0.5]
    mse = float(np.mean(error**2)) if error.size else 0.0
    return -10 * math.log10(mse) if mse > 0 else math.inf
