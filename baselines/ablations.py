"""Methods that are ASH or the mesh baseline with some fields of the configuration replaced: one table, a row each.

A row here is an entry point. Any other variant needs no code: it is a row of a suite's file, or flags of
`ash-bench train`, with the same dotted keys; `benchmarks/suites/switches.toml` holds many.
"""

from dataclasses import replace

import numpy as np

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.capture.formats import read_body
from ash.config import AshConfig, TemplateConfig
from ash.presets import ash, ash_plus, ash_truth
from baselines.ddc import ddc_truth
from baselines.oracle_texture import oracle_texture

# The paper's rig has 120 cameras, of which its ablation keeps 12, 30 and 60: the same shares of ours, at least one.
STUDIO_CAMERAS = 120
TRUNCATED_S = 1000 / 25  # The paper's row w/o mot. has seen the first 1,000 frames, at 25 a second.
# Static Gaussians, learned directly and skinned.
WITHOUT_MOTION = {
    "model.motion": False,
    "model.base": True,
    "training.warmup": "none",
    "training.warmup_steps": 0,
}


class BareBodyAvatar(AshAvatar):
    """ASH on a mesh whose vertices are not those of the clothed template, even where there are as many."""

    def template_vertices(self, pose: Pose) -> np.ndarray:
        """None that could be compared with the truth, `[0, 3]`."""
        return np.zeros((0, 3))


def _on_bare_body(config: AshConfig, capture: Capture) -> BareBodyAvatar:
    return BareBodyAvatar.from_capture(config, replace(capture, template=read_body(capture)))


# The paper's rows.
wo_disp = ash.with_overrides({"model.offset": False})
wo_mot = ash.with_overrides(WITHOUT_MOTION)
wo_mot_truncated = wo_mot.with_overrides({"training.footage_s": TRUNCATED_S})  # As the paper has it.
res_128 = ash.with_overrides({"model.texels": lambda config: config.model.texels // 2})  # The paper's preset has 256.
res_512 = ash.with_overrides({"model.texels": lambda config: config.model.texels * 2})
cams_12 = ash.with_overrides({"training.camera_share": 12 / STUDIO_CAMERAS})
cams_30 = ash.with_overrides({"training.camera_share": 30 / STUDIO_CAMERAS})
cams_60 = ash.with_overrides({"training.camera_share": 60 / STUDIO_CAMERAS})
# A fitted body model as template: clothes are whatever the offsets and the splats make of them.
smpl = replace(ash, build=_on_bare_body).with_overrides({"template": TemplateConfig(kind="skinned")})

# What motion is worth to `ash_plus`.
wo_mot_plus = ash_plus.with_overrides(WITHOUT_MOTION)

# Oracles on a surface that is wrong by so much. A mesh may be moved by the images; an exact one has nothing to gain.
ash_2mm = ash_truth.with_overrides({"template.error_mm": 2.0})
ash_4mm = ash_truth.with_overrides({"template.error_mm": 4.0})
ash_8mm = ash_truth.with_overrides({"template.error_mm": 8.0})
ash_16mm = ash_truth.with_overrides({"template.error_mm": 16.0})
ddc_2mm = ddc_truth.with_overrides({"template.error_mm": 2.0, "refine": "static"})
ddc_4mm = ddc_truth.with_overrides({"template.error_mm": 4.0, "refine": "static"})
ddc_8mm = ddc_truth.with_overrides({"template.error_mm": 8.0, "refine": "static"})
ddc_16mm = ddc_truth.with_overrides({"template.error_mm": 16.0, "refine": "static"})
texture_2mm = oracle_texture.with_overrides({"template.error_mm": 2.0, "refine": "static"})
texture_4mm = oracle_texture.with_overrides({"template.error_mm": 4.0, "refine": "static"})
texture_8mm = oracle_texture.with_overrides({"template.error_mm": 8.0, "refine": "static"})
texture_16mm = oracle_texture.with_overrides({"template.error_mm": 16.0, "refine": "static"})
