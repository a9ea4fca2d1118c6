"""A reference: 3D Gaussians of one frame, skinned. What is lost against it is what other frames teach."""

from dataclasses import replace
from pathlib import Path

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.config import AshConfig, TemplateConfig
from baselines.ablations import wo_mot
from baselines.nearest import central_frame


class StaticAvatar(AshAvatar):
    """ASH without motion, which sees what the cameras saw of a single training frame."""

    @classmethod
    def from_capture(cls, config: AshConfig, capture: Capture) -> "StaticAvatar":
        """The avatar, untrained."""
        return super().from_capture(config, of_one_frame(capture))

    def fit(self, capture: Capture, *, folder: Path) -> None:
        """Train on the one frame."""
        super().fit(of_one_frame(capture), folder=folder)


def of_one_frame(capture: Capture) -> Capture:
    """The capture with one training frame: the one whose pose is nearest to all others."""
    train = capture.splits["train"]
    frame = central_frame(capture.motion, train.frames)
    return replace(capture, splits=capture.splits | {"train": train.only(frames=(frame,))})


# One set of Gaussians from one frame, at the preset's budget; one frame teaches no deformation.
static = replace(wo_mot, build=StaticAvatar.from_capture).with_overrides({"template": TemplateConfig(kind="skinned")})
