"""ASH with one switch turned: where paper and release differ, and what the fast presets add to both.

Methods by their path (`baselines.switches:wo_base`): they are rows of the suites `switches` and `template`.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ash.dataset import Capture
from ash.method import AshAvatar
from ash.presets import named

Factory = Callable[..., AshAvatar]


def _turned(
    *,
    model: dict[str, Any] | None = None,
    training: dict[str, Any] | None = None,
    template: dict[str, Any] | None = None,
) -> Factory:
    def factory(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
        config = named(preset)
        config = replace(
            config,
            model=replace(config.model, **(model or {})),
            training=replace(config.training, **(training or {})),
            template=replace(config.template, **(template or {})),
            seed=seed,
        )
        return AshAvatar(config, capture)

    return factory


# The warm-up (Eq. 8): frames fitted one by one, a guess from the mesh, none.
warm_up_paper = _turned(training={"warmup": "fitted"})
warm_up_released = _turned(training={"warmup": "analytic"})
warm_up_none = _turned(training={"warmup": "none", "warmup_steps": 0})

# Paper against release.
loss_paper = _turned(training={"l1_weight": 0.1, "ssim_weight": 0.9})
loss_released = _turned(training={"l1_weight": 0.9, "ssim_weight": 0.1})
norm_released = _turned(model={"norm": "batch-as-released"})
norm_instance = _turned(model={"norm": "instance"})
world_rotations = _turned(model={"quat_frame": "world"})
released_phi = _turned(model={"global_mlp": "released"})
wo_phi = _turned(model={"global_features": False})
sh_3 = _turned(model={"sh_degree": 3})

# What the fast presets add.
wide_dilation = _turned(model={"dilation": 0.3})
wo_base = _turned(model={"base": False}, training={"warmup": "none", "warmup_steps": 0})
wo_light = _turned(model={"light": False})
wo_light_and_motion = _turned(model={"light": False, "motion": False})
wo_standardise = _turned(model={"standardise": False})
wo_heading = _turned(model={"yaw_normalise": False})
two_trunks = _turned(model={"shared_trunk": False})
noisy_textures = _turned(training={"texture_noise": 1.0})
averaged = _turned(training={"ema": 0.99})
blendshapes = _turned(model={"head": "blendshapes"})
learned_template = _turned(template={"kind": "learned"})

# How the template comes about, where a surface per frame ("chamfer") is what ASH learns it from.
by_vertices = _turned(template={"kind": "learned", "supervision": "vertices"})
by_images = _turned(template={"kind": "learned", "supervision": "images"})
by_graph = _turned(template={"kind": "learned", "network": "graph"})
unlearned = _turned(template={"kind": "skinned"})
refined = _turned(model={"refine": True}, template={"kind": "learned"})
