"""A reference: Gaussians that are free in every training frame. The ceiling of ASH's parametrisation on seen motion."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import AshConfig
from ash.decoders import as_batch
from ash.gaussians.gaussians import raw_channels
from ash.presets import MethodFactory, plus
from ash.template.motion import normalised_motion
from ash.template.template import Template
from ash.textures import FrameInputs, TexelLattice


class FrameTable(nn.Module):
    """In place of decoders: raw parameters of every training frame. Another pose gets those of the nearest frame."""

    def __init__(self, poses: Float[Tensor, "f d"], texels: int, channels: int) -> None:
        super().__init__()
        self.poses: Tensor
        self.register_buffer("poses", poses)
        # Apart from each other, so that a step of Adam moves the frame that was drawn and no other.
        self.frames = nn.ParameterList(torch.zeros(texels, channels) for _ in poses)

    def forward(self, inputs: Sequence[FrameInputs]) -> Float[Tensor, "b n o"]:
        """The rows of the frames whose poses are nearest, by rotation vectors; a training frame's own is at 0."""
        nearest = [int((self.poses - of_frame.motion[0]).square().sum(1).argmin()) for of_frame in inputs]
        return as_batch([self.frames[row] for row in nearest])


class PerFrameAvatar(AshAvatar):
    """ASH on static texels with a `FrameTable`."""

    def __init__(self, config: AshConfig, capture: Capture, template: Template) -> None:
        self._frames = capture.splits["train"].frames
        super().__init__(config, capture, template)

    def make_decoders(self, lattice: TexelLattice) -> nn.Module:
        """Stg. 3 without a network."""
        model = self.config.model
        poses = [
            normalised_motion(Pose(self._motion, frame), window=1, yaw_normalise=model.yaw_normalise)[0]
            for frame in self._frames
        ]
        return FrameTable(torch.stack(poses), len(lattice.texels), raw_channels(model))


# `ash_plus` with free Gaussians in place of decoders, which learn as fast as static texels do. Of motion that was not
# seen it knows nothing: there it draws the Gaussians of the nearest training frame, in the new pose.
per_frame = MethodFactory(config=plus, build=PerFrameAvatar.from_capture).with_overrides(
    {"training.learning_rate": lambda config: config.training.base_learning_rate}
)
