"""Whole configurations by name. A preset is a function that returns one; an ablation replaces the field it is about.

A preset is ASH as the paper's text has it, at some size. `plus` adds what the paper does not have.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture
from ash.config import AshConfig, ModelConfig, TemplateConfig, TrainingConfig
from ash.fields import apply_overrides
from ash.files import InputError
from ash.protocol import Avatar

Config = TypeVar("Config")


def paper() -> AshConfig:
    """ASH as the paper writes it, at full size: work for a GPU.

    From the paper: 256 texels; separate U-Nets after Ronneberger et al., which have no norm; SH of degree 3 (48
    coefficients); Phi from a 3-layer MLP of width 32; rotations that are posed with the mean's set; the warm-up fits
    frames one by one; weights 0.1 and 0.9 in Eq. 9; the root translation normalised, the heading not.
    Not in the paper, hence as in the release (`official`): width 64, a window of 3, learning rate 1e-4 without a
    schedule, 15,000 and 2,000,000 steps of one whole image over black, 0.3 px^2 of dilation, 852 nodes and eight blocks
    of width 16 in Stg.1.
    """
    model = ModelConfig(texels=256, window=3, offset_unit_m=1.0)
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
    template = TemplateConfig(kind="learned", network="graph", nodes=852, blocks=8, steps=2000)
    return AshConfig(model=model, training=training, template=template)


def official() -> AshConfig:
    """ASH as the released code trains it (facts of kv2000/ASH at 0aea45c), where it differs from `paper`.

    Colours do not depend on the view (the active SH degree stays 0); BatchNorm that never leaves its training mode;
    quaternions decoded in the world's frame; Phi's first layer 64 wide, on the translation over 1.2; a warm-up towards
    a guess from the mesh; 0.9 L1 + 0.1 (1 - SSIM); in Stg.1 weights per node, one full matrix over the vertices, and
    skinning through the embedded graph.

    Not reproduced. Of the decoders: 45 decoded channels that nothing reads, the corner-sampled and transposed lattice,
    division of colours by 256, the offset by which Phi's translation is shifted. Of the training: a warm-up on the
    first frames only, masks that are eroded before they cut the images. Of Stg.1, whose training the release has not:
    graph convolutions weighed by hops, ELU and batch norm in them, weights of the embedded graph by hops, and degrees
    of freedom that are Euler angles.
    """
    base = paper()
    return replace(
        base,
        model=replace(base.model, sh_degree=0, norm="batch-as-released", quat_frame="world", global_mlp="released"),
        training=replace(base.training, warmup="analytic", l1_weight=0.9, ssim_weight=0.1),
        template=replace(base.template, released=True),
    )


def ci() -> AshConfig:
    """`paper` in seconds on one core: the mannequin at 128x128, on the skinned template.

    Smaller: texels, U-Nets, steps. Engineering, which leaves the model what it is: two views a step, crops, a schedule,
    averaged weights, offsets in centimetres.
    """
    base = paper()
    training = replace(
        base.training,
        steps=250,
        views_per_step=2,
        warmup_steps=150,
        fitted_steps=60,
        learning_rate=2e-3,
        schedule="open",
        crop=True,
        ema=0.99,
    )
    model = replace(base.model, texels=64, width=8, levels=3, offset_unit_m=0.01)
    return replace(base, model=model, training=training, template=TemplateConfig())


def cpu() -> AshConfig:
    """6,000 steps, some minutes of one core: the default, at 256x256. `ci` at a larger size, on a learned template.

    What comes out does not depend on how fast the machine is, and all methods make equally many steps.
    """
    base = ci()
    training = replace(
        base.training,
        steps=6000,
        views_per_step=4,
        warmup_steps=500,
        fitted_steps=200,
        learning_rate=1e-3,
        base_learning_rate=2e-2,
    )
    return replace(
        base,
        model=replace(base.model, texels=128, width=16),
        training=training,
        template=TemplateConfig(kind="learned"),
    )


def thorough() -> AshConfig:
    """`cpu` until nothing more is learned, at most half an hour of one core."""
    base = cpu()
    return replace(base, training=replace(base.training, steps=60_000, seconds=1800.0))


def budget() -> AshConfig:
    """`thorough`, with the weights of half a minute, of 42 seconds, ... of half an hour kept: accuracy against time."""
    base = thorough()
    return replace(base, training=replace(base.training, snapshots=True))


def brief() -> AshConfig:
    """`cpu` for 300 steps, far from its plateau: tables with three seeds within an hour on two cores."""
    base = cpu()
    return replace(base, training=replace(base.training, steps=300, warmup_steps=200))


PRESETS = {
    "ci": ci,
    "brief": brief,
    "cpu": cpu,
    "thorough": thorough,
    "budget": budget,
    "paper": paper,
    "official": official,
}


VALIDATION = "subjects 100 and 102 in loose, 103 in tight clothes; the additions: subjects 100 to 102 in both outfits"
# On which captures a preset's numbers were chosen. From now on: on none that a suite runs on (docs/tuning.md).
CHOSEN_ON = {
    **dict.fromkeys(("ci", "brief", "cpu", "thorough", "budget"), VALIDATION),
    "paper": "the paper's text",
    "official": "the release's code",
}


def named(name: str) -> AshConfig:
    """The configuration of a preset, or an InputError that lists the names."""
    if name not in PRESETS:
        raise InputError(f"preset: expected one of {', '.join(PRESETS)}, got {name!r}")
    return PRESETS[name]()


# What `ash_plus` adds to `ash`. Each works alone.
ADDITIONS: dict[str, Mapping[str, Any]] = {
    # Static texels are learned first, then the decoders as their residual.
    "base": {
        "model.base": True,
        "training.warmup": "static",
        "training.warmup_steps": lambda config: 2 * config.training.warmup_steps // 5,
    },
    "light": {"model.light": True},
    "standardise": {"model.standardise": True},
    "heading": {"model.yaw_normalise": True, "template.yaw_normalise": True},
    "background": {"training.background": "random"},
    "loss": {"training.l1_weight": 0.8, "training.ssim_weight": 0.2},
    "dilation": {"model.dilation": 0.05},
    # Less: colours that are the same from everywhere; one U-Net, at half the side; half as wide, seeing one frame.
    "matt": {"model.sh_degree": 0},
    "coarse": {"model.shared_trunk": True, "model.shuffle": 2},
    "narrow": {"model.width": 8, "model.window": 1},
}


def plus(preset: str, *, without: str = "") -> AshConfig:
    """A preset with all `ADDITIONS`, which the paper does not have, or all but one."""
    changes = {key: value for name, each in ADDITIONS.items() if name != without for key, value in each.items()}
    return apply_overrides(named(preset), changes, of=preset)


@dataclass(frozen=True, kw_only=True)
class MethodFactory(Generic[Config]):
    """A factory of avatars that offers its configuration (`ash.protocol.Configurable`)."""

    config: Callable[[str], Config]  # what a preset means
    build: Callable[[Config, Capture], Avatar]

    def __call__(self, capture: Capture, *, seed: int, preset: str, config: Config | None = None) -> Any:
        """The avatar, untrained; `config` takes the place of what the preset says."""
        wanted: Any = self.config(preset) if config is None else config
        return self.build(replace(wanted, seed=seed), capture)

    def with_overrides(self, changes: Mapping[str, Any]) -> "MethodFactory[Config]":
        """The same with other values at dotted keys; a function gives its value from the preset's configuration."""
        return replace(self, config=lambda preset: apply_overrides(self.config(preset), changes, of=preset))


ash = MethodFactory(config=named, build=AshAvatar.from_capture)
ash_plus = MethodFactory(config=plus, build=AshAvatar.from_capture)
# An oracle: what the template's error costs.
ash_truth = ash.with_overrides({"template": TemplateConfig(kind="exact")})
