"""ASH, DDC and a fixed mesh on the exact surface with a planted error of 2 to 16 mm rms: what their margins depend on.

All get the same wrong surface in one seed. Zero is `ash_truth`, `ddc_truth` and `oracle_texture`.
"""

from dataclasses import replace
from functools import partial

from ash.config import TemplateConfig
from ash.dataset import Capture
from ash.method import AshAvatar
from ash.presets import named
from baselines.ddc import DdcAvatar, ddc_config
from baselines.oracle_texture import oracle_texture


def ash_off(capture: Capture, *, seed: int, preset: str, error_mm: float) -> AshAvatar:
    """ASH on a template that is wrong by `error_mm`."""
    template = TemplateConfig(kind="exact", error_mm=error_mm)
    return AshAvatar(replace(named(preset), seed=seed, template=template), capture)


def ddc_off(capture: Capture, *, seed: int, preset: str, error_mm: float) -> DdcAvatar:
    """DDC on a template that is wrong by `error_mm`."""
    template = TemplateConfig(kind="exact", error_mm=error_mm)
    return DdcAvatar(ddc_config(named(preset), seed=seed, template=template), capture)


ash_2mm, ash_4mm, ash_8mm, ash_16mm = (partial(ash_off, error_mm=mm) for mm in (2.0, 4.0, 8.0, 16.0))
ddc_2mm, ddc_4mm, ddc_8mm, ddc_16mm = (partial(ddc_off, error_mm=mm) for mm in (2.0, 4.0, 8.0, 16.0))
texture_2mm, texture_4mm, texture_8mm, texture_16mm = (
    partial(oracle_texture, error_mm=mm) for mm in (2.0, 4.0, 8.0, 16.0)
)
