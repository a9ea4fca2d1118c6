"""A control for blending: the mean picture of two static avatars that differ in nothing but their seed.

What it gains over one of them is what any average of two pictures gains, without motion.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import safetensors.torch

from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.checkpoints import contiguous_state, load_module, read_safetensors
from ash.config import AshConfig
from ash.files import write_atomic
from ash.protocol import StageClock
from baselines.ablations import wo_mot, wo_mot_plus

SEEDS_APART = 1000  # The second avatar's seed is the first's plus this: no other row of a suite has it.


class MeanAvatar:
    """The Avatar protocol (see `ash.protocol`) for the mean of avatars that were trained apart."""

    def __init__(self, avatars: Sequence[AshAvatar]) -> None:
        self.avatars = tuple(avatars)

    @classmethod
    def from_capture(cls, config: AshConfig, capture: Capture) -> "MeanAvatar":
        """Two avatars of a configuration, untrained."""
        seeds = (config.seed, config.seed + SEEDS_APART)
        return cls([AshAvatar.from_capture(replace(config, seed=seed), capture) for seed in seeds])

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Train one after the other."""
        for index, avatar in enumerate(self.avatars):
            avatar.fit(capture, folder=folder / str(index))

    def render(self, pose: Pose, camera: Camera, *, clock: StageClock) -> np.ndarray:
        """Premultiplied RGBA, float32 `[h, w, 4]`."""
        return np.mean([avatar.render(pose, camera, clock=clock) for avatar in self.avatars], axis=0)

    def parameter_count(self) -> int:
        """Numbers that training may change."""
        return sum(avatar.parameter_count() for avatar in self.avatars)

    def gaussian_count(self) -> int:
        """Drawn per frame, for both pictures."""
        return sum(avatar.gaussian_count() for avatar in self.avatars)

    def save(self, path: Path) -> None:
        """Write the weights."""
        states = (contiguous_state(avatar.module) for avatar in self.avatars)
        tensors = {f"{index}.{name}": value for index, state in enumerate(states) for name, value in state.items()}
        write_atomic(path, safetensors.torch.save(tensors))

    def load(self, path: Path) -> None:
        """Read the weights that `save` wrote."""
        tensors, _ = read_safetensors(path)
        for index, avatar in enumerate(self.avatars):
            own = {name[2:]: value for name, value in tensors.items() if name.startswith(f"{index}.")}
            load_module(avatar.module, own, path)


# Two rows w/o mot. averaged, for `ash` and for `ash_plus`.
wo_mot_twice = replace(wo_mot, build=MeanAvatar.from_capture)
wo_mot_plus_twice = replace(wo_mot_plus, build=MeanAvatar.from_capture)
