"""What defines a run of ASH: frozen dataclasses, checked when they are made. Presets are functions in `ash.presets`."""

import math
import re
from dataclasses import dataclass

from ash.files import InputError

MAX_WINDOW = 16  # frames of motion history that a template may depend on


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuse a value that is not among those that exist."""
    if value not in allowed:
        raise InputError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")


def check_device(name: str) -> None:
    """Refuse what names no device."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise InputError(f"device: expected cpu, cuda or cuda:N, got {name!r}")


@dataclass(frozen=True, kw_only=True, slots=True)
class AtlasConfig:
    """What ASH and the mesh avatar share: U-Nets in the template's atlas, and what they see. Light included."""

    texels: int  # resolution of the texel lattice, per side
    window: int  # frames in the motion-aware textures (k)
    yaw_normalise: bool = False  # turn what networks see into the root's heading; not in the paper
    width: int = 64  # channels of the U-Nets' first level
    levels: int = 4  # halvings of the U-Nets
    norm: str = "none"  # of the U-Nets: "batch-as-released" (always on the statistics of its batch of 1), or "instance"
    shuffle: int = 1  # decode at 1/shuffle of the lattice's resolution and shuffle pixels up; not in the paper
    standardise: bool = False  # decoders see deviations from the mean training texture, in its units; not in the paper
    light: bool = False  # colour times exp(SH2 of the posed normal), 27 numbers; not in the paper
    base: bool = False  # learned static texels with the decoders as residual; not in the paper
    global_features: bool = True  # Phi, from the root translation, at the bottleneck of the U-Net that makes colours
    global_mlp: str = "paper"  # Phi's layers: 32, 32, 16 wide; "released": 64, 32, 16 on the translation over 1.2

    @property
    def decoded_texels(self) -> int:
        """Resolution at which the motion-aware textures are drawn and decoded."""
        return self.texels // self.shuffle

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        one_of("norm", self.norm, ("none", "batch-as-released", "instance"))
        one_of("global_mlp", self.global_mlp, ("paper", "released"))
        if self.shuffle < 1 or self.texels < 4 or self.texels % (self.shuffle * 2**self.levels):
            unit = f"shuffle {self.shuffle} times 2^levels {2**self.levels}"
            raise InputError(f"texels: expected a multiple of {unit}, got {self.texels}")
        if min(self.window, self.width) < 1:
            raise InputError(f"window and width: expected at least 1, got {self.window} and {self.width}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelConfig(AtlasConfig):
    """The avatar. Fields that the paper does not have say so."""

    motion: bool = True  # False: one static set of Gaussians, skinned only (w/o mot.)
    offset: bool = True  # False: no learned canonical offset d (w/o disp.)
    shared_trunk: bool = False  # one U-Net for E_geo and E_app together; not in the paper
    sh_degree: int = 3
    offset_unit_m: float = 0.01  # metres per unit of a decoded offset; the release decodes metres
    quat_frame: str = "canonical"  # "canonical": rotations and SH turn with the surface; "world": as released
    refine: bool = False  # what is drawn also trains networks of Stg.1 on top of the template; the paper's future work
    dilation: float = 0.3  # px^2 added to the projected covariance

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        AtlasConfig.__post_init__(self)  # `super()` does not know a class that slots made anew.
        one_of("quat_frame", self.quat_frame, ("canonical", "world"))
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if self.dilation < 0 or self.offset_unit_m <= 0:
            raise InputError("dilation must be at least 0, offset_unit_m positive")
        if not (self.motion or self.base):
            raise InputError("without motion the Gaussians are the static base: motion=False needs base=True")


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingConfig:
    """The loop: Adam, a warm-up, then L1 + SSIM (ASH Eq. 9)."""

    steps: int  # at most: training ends where it has nothing more to gain, see `ash.training.stopping`
    views_per_step: int  # images of one frame that share one decoding
    warmup: str  # "static": the base alone first; "analytic": as released; "fitted": the paper's per-frame fits; "none"
    warmup_steps: int  # of a static warm-up, which are among `steps`; else of the regression before them
    l1_weight: float  # lambda_pix
    ssim_weight: float  # lambda_str
    learning_rate: float  # of the networks
    base_learning_rate: float = 1e-2  # of the static texels
    # "random": a new colour every step, so that opacity is learned; "black": the paper's; "studio": as random, but
    # inside the mask the camera's picture of the empty studio, for masks that are too large
    background: str = "random"
    frames_per_step: int = 1  # decoded together, each shown in `views_per_step` images: fewer kernels on a GPU
    schedule: str = "open"  # learning rates fall once a plateau or a limit is near; "constant": never, as released
    crop: bool = True  # draw only around the subject; the release draws whole frames
    # of the decoders while they learn; "bfloat16": autocast on a GPU, convolutions on a CPU that has tiles for it (AMX)
    precision: str = "float32"
    ema: float = 0.0  # decay of an average of the weights, which is then the result; 0: none
    texture_noise: float = 0.0  # in the standardised motion-aware textures while decoders learn; not in the paper
    camera_share: float = 1.0  # of the training cameras, evenly spread
    footage_s: float = math.inf  # seconds of training motion that are learned from, from its start
    fitted_steps: int = 2000  # at most, in which the paper's warm-up fits a frame alone: less where no more is gained
    seconds: float = math.inf  # of CPU time, at most
    score_from: int = 0  # steps before which reserved views are not scored: a field takes a minute to draw them
    snapshots: bool = False  # keep the weights of half a minute, of 42 s, of a minute, ... of half an hour

    @property
    def static_steps(self) -> int:
        """Steps in which the static parameters learn alone."""
        return self.warmup_steps if self.warmup == "static" else 0

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        one_of("warmup", self.warmup, ("static", "analytic", "fitted", "none"))
        one_of("background", self.background, ("random", "black", "studio"))
        one_of("schedule", self.schedule, ("open", "constant"))
        one_of("precision", self.precision, ("float32", "bfloat16"))
        if not 0 <= self.ema < 1:
            raise InputError(f"ema: expected a decay of at least 0 and below 1, got {self.ema}")
        if not self.seconds > 0:
            raise InputError(f"seconds: expected more than 0, got {self.seconds}")
        if not 0 <= self.texture_noise < math.inf:
            raise InputError(f"texture_noise: expected a finite standard deviation, got {self.texture_noise}")
        if not 0 < self.camera_share <= 1:
            raise InputError(f"camera_share: expected more than 0 and at most 1, got {self.camera_share}")
        if not self.footage_s > 0:
            raise InputError(f"footage_s: expected more than 0 seconds, got {self.footage_s}")
        if self.fitted_steps < 1:
            raise InputError(f"fitted_steps: expected at least 1, got {self.fitted_steps}")
        if min(self.steps, self.views_per_step) < 1 or self.warmup_steps < 0:
            raise InputError("expected steps >= 1, views_per_step >= 1 and warmup_steps >= 0")
        if self.static_steps > self.steps:
            raise InputError(f"warmup_steps: a static warm-up is part of {self.steps} steps, got {self.warmup_steps}")
        if self.frames_per_step < 1:
            raise InputError(f"frames_per_step: expected at least 1, got {self.frames_per_step}")

    def check_norm(self, norm: str) -> None:
        """Refuse U-Nets whose norm would mix the frames of a step."""
        if self.frames_per_step > 1 and norm == "batch-as-released":
            raise InputError(f"frames_per_step: norm {norm!r} mixes what is decoded together; expected 1")


SUPERVISIONS = ("images", "scans")


@dataclass(frozen=True, kw_only=True, slots=True)
class TemplateConfig:
    """Which template a method stands on (Stg.1). Equal configs give equal templates, whichever method asks."""

    kind: str = "skinned"  # "skinned": rest mesh, skinned; "learned": deformed as training frames were; "exact"
    error_mm: float = 0.0  # rms of a smooth error that is planted in the exact surface
    supervision: str = "images"  # nothing but the videos; "scans": of a scanner
    network: str = "linear"  # a map per node of the embedded graph; "graph": the paper's graph convolutions
    nodes: int = 400  # of the embedded graph
    window: int = 3  # frames of motion that are seen
    yaw_normalise: bool = False  # in the heading of the root; not in the paper
    blocks: int = 2  # of the graph convolutions
    steps: int = 300  # of their training
    # as the release: convolutions with weights per node, a full matrix over the vertices in the displacement network,
    # and skinning by the nodes' blended transforms
    released: bool = False

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        one_of("template", self.kind, ("skinned", "learned", "exact"))
        one_of("template supervision", self.supervision, SUPERVISIONS)
        one_of("template network", self.network, ("linear", "graph"))
        if not 0 <= self.error_mm < 1000:
            raise InputError(f"template error_mm: expected 0 to 1000 mm, got {self.error_mm}")
        if self.error_mm > 0 and self.kind != "exact":
            raise InputError(f"template error_mm: a planted error needs the exact surface, got {self.kind!r}")
        if min(self.nodes, self.window, self.blocks, self.steps) < 1:
            raise InputError("template: nodes, window, blocks and steps must be at least 1")
        if self.window > MAX_WINDOW:
            raise InputError(f"template window: expected 1 to {MAX_WINDOW} frames, got {self.window}")


@dataclass(frozen=True, kw_only=True, slots=True)
class AshConfig:
    """A whole run, seed and template included."""

    model: ModelConfig
    training: TrainingConfig
    template: TemplateConfig = TemplateConfig()
    seed: int = 0
    device: str = "cpu"  # or "cuda", "cuda:1": where it learns and draws, its template included

    def __post_init__(self) -> None:
        """Refuse training that the model cannot take."""
        check_device(self.device)
        if self.training.warmup == "static" and not self.model.base:
            raise InputError("warmup='static' trains the base alone and needs base=True")
        if self.training.warmup in ("analytic", "fitted") and not self.model.motion:
            raise InputError(f"warmup={self.training.warmup!r} trains the decoders and needs motion=True")
        model = self.model
        self.training.check_norm(model.norm)
        if self.training.texture_noise > 0 and not (model.motion and model.standardise):
            raise InputError("texture_noise is for U-Nets that see standardised textures (standardise=True)")
