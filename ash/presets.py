"""Whole configurations by name. A preset is a function that returns one; an ablation replaces the field it is about."""

from dataclasses import replace

from ash.config import AshConfig, ModelConfig, TrainingConfig
from ash.dataset import Capture
from ash.files import InputError
from ash.method import AshAvatar


def ci() -> AshConfig:
    """Seconds on one core: the mannequin at 128x128."""
    model = ModelConfig(
        texels=64,
        window=3,
        yaw_normalise=True,
        width=8,
        levels=3,
        norm="none",
        shared_trunk=True,
        shuffle=2,
        sh_degree=0,
        standardise=True,
        base=True,
        light=True,
        dilation=0.05,
    )
    training = TrainingConfig(
        steps=250,
        views_per_step=2,
        warmup="static",
        warmup_steps=60,
        l1_weight=0.8,
        ssim_weight=0.2,
        learning_rate=2e-3,
    )
    return AshConfig(model=model, training=training)


def cpu() -> AshConfig:
    """Minutes on one core: the tables' default, at 256x256."""
    base = ci()
    return replace(
        base,
        model=replace(base.model, texels=256, shuffle=4, width=16, levels=3),
        training=replace(base.training, steps=1100, warmup_steps=200, learning_rate=1e-3, base_learning_rate=2e-2),
    )


PRESETS = {"ci": ci, "cpu": cpu}


def named(name: str) -> AshConfig:
    """The configuration of a preset, or an InputError that lists the names."""
    if name not in PRESETS:
        raise InputError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]()


def ash(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """ASH as the preset says."""
    return AshAvatar(replace(named(preset), seed=seed), capture)


def ash_truth(capture: Capture, *, seed: int, preset: str) -> AshAvatar:
    """ASH on the exact surface: an oracle, to see what the template's error costs."""
    return AshAvatar(replace(named(preset), seed=seed, template="exact"), capture)
