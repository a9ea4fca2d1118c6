"""The paper's experiment with SMPL: ASH on the body without clothes, as a fitted body model would give it."""

from dataclasses import replace

from ash.config import TemplateConfig
from ash.dataset import Capture, read_body
from ash.method import AshAvatar
from ash.presets import named


def smpl(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """ASH whose template is the bare body, skinned: clothes are whatever the offsets and the splats make of them."""
    config = replace(named(preset), seed=seed, template=TemplateConfig(kind="skinned"))
    return AshAvatar(config, replace(capture, template=read_body(capture)))
