"""What defines a run of ASH: frozen dataclasses, checked when they are made. Presets are functions in `ash.presets`."""

from dataclasses import dataclass

from ash.files import InputError


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuse a value that is not among those that exist."""
    if value not in allowed:
        raise InputError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelConfig:
    """The avatar. Fields that the paper does not have say so."""

    texels: int  # resolution of the texel lattice, per side
    window: int  # frames in the motion-aware textures (k)
    yaw_normalise: bool  # turn the textures into the root's heading; the release does not
    motion: bool = True  # False: one static set of Gaussians, skinned only (w/o mot.)
    offset: bool = True  # False: no learned canonical offset d (w/o disp.)
    width: int = 64  # channels of the U-Nets' first level
    levels: int = 4  # halvings of the U-Nets
    norm: str = "instance"  # "instance" (what the release's BatchNorm at batch 1 computes) or "none"
    shared_trunk: bool = False  # one U-Net for E_geo and E_app together; not in the paper
    shuffle: int = 1  # decode at 1/shuffle of the lattice's resolution and shuffle pixels up; not in the paper
    sh_degree: int = 3
    global_features: bool = True  # Phi, from the root translation, at the bottleneck of E_app
    quat_frame: str = "canonical"  # "canonical": rotations and SH turn with the surface; "world": as released
    standardise: bool = False  # decoders see deviations from the mean training texture, in its units; not in the paper
    base: bool = False  # learned static texels with the decoders as residual; not in the paper
    light: bool = False  # colour times exp(SH2 of the posed normal), 27 numbers; not in the paper
    dilation: float = 0.3  # px^2 added to the projected covariance

    @property
    def decoded_texels(self) -> int:
        """Resolution at which the motion-aware textures are drawn and decoded."""
        return self.texels // self.shuffle

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        one_of("norm", self.norm, ("instance", "none"))
        one_of("quat_frame", self.quat_frame, ("canonical", "world"))
        if self.shuffle < 1 or self.texels < 4 or self.texels % (self.shuffle * 2**self.levels):
            unit = f"shuffle {self.shuffle} times 2^levels {2**self.levels}"
            raise InputError(f"texels: expected a multiple of {unit}, got {self.texels}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if self.window < 1 or self.width < 1 or self.dilation < 0:
            raise InputError("window and width must be at least 1 and dilation at least 0")
        if not (self.motion or self.base):
            raise InputError("without motion the Gaussians are the static base: motion=False needs base=True")


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingConfig:
    """The loop: Adam with a cosine schedule, a warm-up, then L1 + SSIM (ASH Eq. 9)."""

    steps: int
    views_per_step: int  # images of one frame that share one decoding
    warmup: str  # "static": the base alone first; "analytic": as released; "fitted": the paper's per-frame fits; "none"
    warmup_steps: int
    l1_weight: float  # lambda_pix
    ssim_weight: float  # lambda_str
    learning_rate: float  # of the networks
    base_learning_rate: float = 1e-2  # of the static texels
    background: str = "random"  # "random": a new colour every step, so that opacity is learned; "black": the paper's
    camera_share: float = 1.0  # of the training cameras, evenly spread
    checkpoint_seconds: float = 60.0

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        one_of("warmup", self.warmup, ("static", "analytic", "fitted", "none"))
        one_of("background", self.background, ("random", "black"))
        if not 0 < self.camera_share <= 1:
            raise InputError(f"camera_share: expected more than 0 and at most 1, got {self.camera_share}")
        if self.steps < 1 or self.views_per_step < 1 or not 0 <= self.warmup_steps <= self.steps:
            raise InputError("expected steps >= 1, views_per_step >= 1 and 0 <= warmup_steps <= steps")


@dataclass(frozen=True, kw_only=True, slots=True)
class AshConfig:
    """A whole run, seed and template included."""

    model: ModelConfig
    training: TrainingConfig
    template: str = "skinned"  # "skinned": rest mesh, skinned; "exact": the oracle's
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse an unknown template and a warm-up that the model cannot take."""
        one_of("template", self.template, ("skinned", "exact"))
        if self.training.warmup == "static" and not self.model.base:
            raise InputError("warmup='static' trains the base alone and needs base=True")
        if self.training.warmup in ("analytic", "fitted") and not self.model.motion:
            raise InputError(f"warmup={self.training.warmup!r} trains the decoders and needs motion=True")
