"""The paper's experiment with SMPL: ASH on the body without clothes, as a fitted body model would give it."""

from dataclasses import replace

import numpy as np

from ash.config import TemplateConfig
from ash.dataset import Capture, Motion, read_body
from ash.method import AshAvatar
from ash.presets import named


class BareBodyAvatar(AshAvatar):
    """ASH on a mesh whose vertices are not those of the clothed template, even where there are as many."""

    def template_vertices(self, motion: Motion, frame: int) -> np.ndarray:
        """None that could be compared with the truth, `[0, 3]`."""
        return np.zeros((0, 3))


def smpl(capture: Capture, *, seed: int, preset: str) -> BareBodyAvatar:
    """ASH whose template is the bare body, skinned: clothes are whatever the offsets and the splats make of them."""
    config = replace(named(preset), seed=seed, template=TemplateConfig(kind="skinned"))
    return BareBodyAvatar(config, replace(capture, template=read_body(capture)))
