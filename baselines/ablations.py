"""The rows of the paper's ablation tables: each is ASH with the one field replaced that the row is about."""

from dataclasses import replace

from ash.config import AshConfig
from ash.dataset import Capture
from ash.method import AshAvatar
from ash.presets import named

STUDIO_CAMERAS = 120  # The paper's rig, of which its ablation keeps 12, 30 and 60.


def wo_disp(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/o disp.: no learned canonical offset."""
    config = named(preset)
    return _ash(replace(config, model=replace(config.model, offset=False)), capture, seed)


def wo_mot(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/o mot.: one set of Gaussians, skinned only."""
    config = named(preset)
    model = replace(config.model, motion=False, base=True)
    training = replace(config.training, warmup="none", warmup_steps=0)
    return _ash(replace(config, model=model, training=training), capture, seed)


def res_128(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/ 128.res.: half the preset's texels per side (the paper's preset has 256)."""
    config = named(preset)
    return _ash(replace(config, model=replace(config.model, texels=config.model.texels // 2)), capture, seed)


def res_512(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/ 512.res.: twice the preset's texels per side."""
    config = named(preset)
    return _ash(replace(config, model=replace(config.model, texels=config.model.texels * 2)), capture, seed)


def ash_frugal(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """ASH with the model of the preset `frugal`: what lightness costs."""
    return _ash(replace(named(preset), model=named("frugal").model), capture, seed)


def cams_12(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/ 12.cam: a tenth of the rig."""
    return _with_cameras(capture, seed, preset, 12)


def cams_30(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/ 30.cam: a quarter of the rig."""
    return _with_cameras(capture, seed, preset, 30)


def cams_60(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """w/ 60.cam: half of the rig."""
    return _with_cameras(capture, seed, preset, 60)


def _with_cameras(capture: Capture, seed: int, preset: str, cameras: int) -> AshAvatar:
    config = named(preset)
    return _ash(
        replace(config, training=replace(config.training, camera_share=cameras / STUDIO_CAMERAS)), capture, seed
    )


def _ash(config: AshConfig, capture: Capture, seed: int) -> AshAvatar:
    return AshAvatar(replace(config, seed=seed), capture)
