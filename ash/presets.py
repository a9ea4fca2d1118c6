"""Whole configurations by name. A preset is a function that returns one; an ablation replaces the field it is about."""

from dataclasses import replace

from ash.config import AshConfig, ModelConfig, TemplateConfig, TrainingConfig
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
    """Minutes on one core: the default, at 256x256."""
    base = ci()
    return replace(
        base,
        model=replace(base.model, texels=256, shuffle=4, width=16, levels=3),
        training=replace(base.training, steps=1100, warmup_steps=200, learning_rate=1e-3, base_learning_rate=2e-2),
        template=TemplateConfig(kind="learned"),
    )


def thorough() -> AshConfig:
    """`cpu` for four minutes: three times its steps, and noise in what the decoders see against learning by heart."""
    base = cpu()
    training = replace(base.training, steps=3500, base_learning_rate=4e-2, texture_noise=1.0)
    return replace(base, model=replace(base.model, dilation=0.0), training=training)


def brief() -> AshConfig:
    """`cpu` with a third of its steps, half a decibel below it: tables with three seeds within an hour on two cores."""
    base = cpu()
    return replace(base, training=replace(base.training, steps=400, warmup_steps=80))


def frugal() -> AshConfig:
    """Twice the frames per second of `cpu`: half its texels per side, and blendshapes in place of the U-Net."""
    base = cpu()
    return replace(
        base,
        model=replace(base.model, texels=128, shuffle=1, head="blendshapes", rank=6, global_features=False),
    )


def paper() -> AshConfig:
    """ASH as the paper writes it, at full size: work for a GPU.

    From the paper: 256 texels; separate U-Nets after Ronneberger et al., which have no norm; SH of degree 3 (48
    coefficients); Phi from a 3-layer MLP of width 32; rotations that are posed with the mean's set; the warm-up fits
    frames one by one; weights 0.1 and 0.9 in Eq. 9; the root translation normalised, the heading not.
    Not in the paper, hence as in the release (`official`): width 64, a window of 3, learning rate 1e-4 without a
    schedule, 15,000 and 2,000,000 steps of one whole image over black, 0.3 px^2 of dilation, 852 nodes and eight blocks
    of width 16 in Stg.1.
    """
    model = ModelConfig(texels=256, window=3, yaw_normalise=False, offset_unit_m=1.0)
    training = TrainingConfig(
        steps=2_000_000,
        views_per_step=1,
        warmup="fitted",
        warmup_steps=15_000,
        l1_weight=0.1,
        ssim_weight=0.9,
        learning_rate=1e-4,
        schedule="constant",
        background="black",
        crop=False,
    )
    template = TemplateConfig(kind="learned", network="graph", nodes=852, window=3, blocks=8, steps=2000)
    return AshConfig(model=model, training=training, template=template)


def official() -> AshConfig:
    """ASH as the released code trains it (facts of kv2000/ASH at 0aea45c), where it differs from `paper`.

    Colours do not depend on the view (the active SH degree stays 0); BatchNorm that never leaves its training mode;
    quaternions decoded in the world's frame; Phi's first layer 64 wide, on the translation over 1.2; a warm-up towards
    a guess from the mesh; 0.9 L1 + 0.1 (1 - SSIM); in Stg.1 weights per node, one full matrix over the vertices, and
    skinning through the embedded graph. Not reproduced: 45 decoded channels that nothing reads, the corner-sampled and
    transposed lattice, division of colours by 256.
    """
    base = paper()
    return replace(
        base,
        model=replace(base.model, sh_degree=0, norm="batch-as-released", quat_frame="world", global_mlp="released"),
        training=replace(base.training, warmup="analytic", l1_weight=0.9, ssim_weight=0.1),
        template=replace(base.template, weights="per-node", dense=True, skinning="graph"),
    )


PRESETS = {
    "ci": ci,
    "brief": brief,
    "cpu": cpu,
    "thorough": thorough,
    "frugal": frugal,
    "paper": paper,
    "official": official,
}


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
    return AshAvatar(replace(named(preset), seed=seed, template=TemplateConfig(kind="exact")), capture)
