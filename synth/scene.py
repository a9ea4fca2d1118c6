"""What a scene is: one frozen description from which every byte of a capture follows."""

from dataclasses import asdict, dataclass, field
from typing import Any

from ash.files import InputError, hash_of

BODIES = ("mannequin", "anny")
MOTIONS = (
    "walk",
    "reach",
    "turn",
    "squat",
    "dance",
    "stand",
    "run",
    "jump",
    "spin",
    "arms_up",
    "deep_squat",
    "twist",
    "wave",
    "bow",
    "clap",
)  # as in `motion/generators.py`
GIVEN = "given"  # the kind of a clip whose motion comes from a user's file
UPS = ("auto", "x", "y", "z", "-x", "-y", "-z")
RIGS = ("dome", "ring", "cap", "studio", "given")


@dataclass(frozen=True, kw_only=True, slots=True)
class Take:
    """Which part of a motion file is taken, and how the file is read."""

    up: str = "auto"  # the axis that is up in the file: auto, x, y, z, -x, -y, -z
    start: float = 0.0  # seconds of the file that are left out at its start
    length: float | None = None  # seconds of the file that are taken; none: up to its end
    stride: int = 1  # every so many-th frame is taken: the motion goes so many times as fast
    joints: tuple[tuple[str, str], ...] = ()  # joints of ours, each with the file's name for it
    fps: float | None = None  # frames per second of the file, where it does not say or is wrong
    rest_frame: int | None = None  # the frame of a BVH file in which the person stands as in a rest pose

    def __post_init__(self) -> None:
        if self.up not in UPS:
            raise InputError(f"up axis {self.up!r}, expected one of {', '.join(UPS)}")
        if not 0 <= self.start < 1e6 or (self.length is not None and not 0 < self.length < 1e6):
            raise InputError(f"a take from {self.start} s, {self.length} s long, expected 0 or more, and more than 0")
        if not 1 <= self.stride <= 10_000:
            raise InputError(f"a stride of {self.stride} frames, expected 1 to 10000")
        if self.fps is not None and not 0.1 <= self.fps <= 10_000:
            raise InputError(f"a motion of {self.fps} frames per second, expected 0.1 to 10000")
        if self.rest_frame is not None and not 0 <= self.rest_frame < 10**6:
            raise InputError(f"rest frame {self.rest_frame}, expected 0 to 999999")


@dataclass(frozen=True, kw_only=True, slots=True)
class Clip:
    """A motion, which frames of it are taken, which of these have images, and where on the floor and facing where.

    A clip is one run of consecutive frames, or several runs that are spread over a longer motion. Each run is a
    sequence of its own: its motion window and its cloth know nothing of the others. Held-out clips have images of the
    frames `history`, `history + stride`, ... of every run; training clips have images of all frames.
    """

    generator: str  # one of MOTIONS, or "given" for a motion from a file
    frames: int  # of a run
    runs: int = 1
    span: int = 0  # frames of the whole motion, over which runs are spread evenly (one: its middle); 0: those taken
    history: int = 0  # frames at the start of a run that have no images: what came before
    stride: int = 1
    yaw: float = 0.0  # radians that the whole clip is turned by about the vertical
    shift: tuple[float, float] = (0.0, 0.0)  # metres, x and z, that it is then moved by
    given: str = ""  # SHA-256 of a user's motion file, for "given"
    take: Take = Take()  # what is taken of that file
    path: str = field(default="", compare=False)  # where that file lies; no part of what the clip is

    def __post_init__(self) -> None:
        if self.generator not in (*MOTIONS, GIVEN):
            raise InputError(f"unknown motion {self.generator!r}, expected one of {', '.join(MOTIONS)}")
        if (self.generator == GIVEN) != bool(self.given):
            raise InputError("a clip of kind 'given' needs the SHA-256 of a motion file, and only such a clip has one")
        if not 2 <= self.frames <= 100_000:
            raise InputError(f"a clip of {self.frames} frames, expected 2 to 100000")
        if not 0 <= self.history < self.frames or not 1 <= self.stride <= 100_000:
            got = f"{self.history} frames of history and a stride of {self.stride}"
            raise InputError(f"a clip with {got}, expected 0 to {self.frames - 1}, and 1 or more")
        if not 1 <= self.runs <= 1000 or (self.runs > 1 and not self.span):
            raise InputError(f"{self.runs} runs over {self.span} frames, expected one, or several with a span")
        if self.span and (self.generator == GIVEN or not self.runs * self.frames <= self.span <= 100_000):
            raise InputError(f"{self.runs} runs of {self.frames} frames do not fit into {self.span}, or are of a file")

    @property
    def count(self) -> int:
        """Frames of all runs."""
        return self.runs * self.frames

    @property
    def starts(self) -> tuple[int, ...]:
        """The frame of the whole motion at which each run starts."""
        last = max(0, self.span - self.frames)
        return tuple(round(run * last / (self.runs - 1)) for run in range(self.runs)) if self.runs > 1 else (last // 2,)

    @property
    def shown(self) -> tuple[int, ...]:
        """Which of its frames, counted over all runs, have images where the clip is held out."""
        own = range(self.history, self.frames, self.stride)
        return tuple(run * self.frames + frame for run in range(self.runs) for frame in own)


@dataclass(frozen=True, kw_only=True, slots=True)
class Outfit:
    """How the truth departs from the skinned template. Every strength at zero leaves exactly the skinned template."""

    skirt: bool = False  # wear a skirt; alone it changes the garment, not how it moves
    folds_mm: float = 0.0  # amplitude of pose-dependent folds
    slack_mm: float = 0.0  # how far loose cloth sags and lags over the body
    swing: float = 0.0  # 0..1: 1 hangs the skirt from its waistband, simulated; 0: rigidly skinned
    scan_mm: float = 0.0  # rms of a smooth error of the template's rest shape on clothes, as of a scan

    def __post_init__(self) -> None:
        for name, most in (("folds_mm", 100), ("slack_mm", 100), ("swing", 1), ("scan_mm", 100)):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"outfit: {name} is {getattr(self, name)}, expected 0 to {most}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Light:
    """Light fixed in the world: a constant sky and soft area lights."""

    sky: float = 0.6  # radiance of the constant environment
    area: float = 1.0  # strength of the area lights
    falloff: float = 0.0  # 0: equal everywhere; 1: a lamp close to the floor that lights one side of it only
    gloss: float = 0.0  # 0: diffuse cloth; 1: satin

    def __post_init__(self) -> None:
        if min(self.sky, self.area, self.falloff, self.gloss) < 0 or self.gloss > 1:
            raise InputError(f"light: {self}, expected no strength below 0 and gloss up to 1")


@dataclass(frozen=True, kw_only=True, slots=True)
class Rig:
    """Calibrated cameras around the capture volume, framed so that the person never leaves the picture."""

    kind: str = "dome"  # dome, ring, cap (in front only), studio (rings of a hall), given
    given: str = ""  # the text of a user's cameras.json, for kind "given"
    cameras: int = 16
    held_out: int = 4
    cameras_per_frame: int = 0  # so many training cameras see each training frame, by turns; 0: all
    width: int = 256
    height: int = 256
    radius: float = 3.4  # metres
    pixel_aspect: float = 1.0  # fy / fx: 1 for square pixels
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2 of every lens

    def __post_init__(self) -> None:
        if self.kind not in RIGS:
            raise InputError(f"unknown rig {self.kind!r}, expected one of {', '.join(RIGS)}")
        if (self.kind == "given") != bool(self.given):
            raise InputError("a rig of kind 'given' needs the text of a cameras.json, and only such a rig has one")
        if not 0 < self.held_out < self.cameras <= 1000:
            raise InputError(f"rig: {self.held_out} of {self.cameras} cameras held out, expected 1 to all but one")
        if self.cameras_per_frame < 0:
            raise InputError(f"rig.cameras_per_frame: expected 1 or more, or 0 for all, got {self.cameras_per_frame}")
        if not (16 <= self.width <= 8192 and 16 <= self.height <= 8192):
            raise InputError(f"rig: images of {self.width}x{self.height}, expected 16 to 8192 pixels")
        if not 0.1 <= self.pixel_aspect <= 10:
            raise InputError(f"rig: pixel aspect {self.pixel_aspect}, expected 0.1 to 10")
        if self.kind == "given" and (self.pixel_aspect != 1 or any(self.distortion)):
            raise InputError("a rig of kind 'given' has its own lenses, expected no other pixel aspect or distortion")


@dataclass(frozen=True, kw_only=True, slots=True)
class Scanner:
    """How well the studio reconstructs the surface of each training frame."""

    rms_mm: float = 1.0  # of its error along the normal; 0: there are no scans
    bump_share: float = 0.5  # of the error's square that is smooth over the surface; the rest is grain
    bump_mm: float = 60.0  # points nearer than this are off alike

    def __post_init__(self) -> None:
        if not (0 <= self.rms_mm <= 100 and 0 <= self.bump_share <= 1 and 1 <= self.bump_mm <= 10_000):
            raise InputError(f"scanner: {self}, expected 0 to 100 mm, a share of 0 to 1, bumps of 1 to 10000 mm")


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene:
    """A whole scene. Equal scenes make equal captures."""

    name: str
    size: str
    seed: int
    body: str
    outfit: Outfit
    light: Light
    rig: Rig
    train: tuple[Clip, ...]
    test: tuple[Clip, ...]  # novel poses: kinds of motion that training does not have
    novel_view_stride: int  # novel views are judged on every so many training frames
    near: tuple[Clip, ...] = ()  # near novel poses: other takes of training's kinds
    far: tuple[Clip, ...] = ()  # far novel poses: unlike anything in training
    scanner: Scanner = Scanner()
    fps: float = 12.0
    samples: int = 48  # per pixel, in two halves
    depth: int = 2  # of light paths: 2 is direct light, 3 adds a bounce
    texture: int = 2048  # side of the texture in texels
    subject: int = 0  # who it is: body, skin, hair, clothes and prints follow, see `synth.person.cast`

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise InputError(f"unknown body {self.body!r}, expected one of {', '.join(BODIES)}")
        if not self.train or not self.test:
            raise InputError("a scene needs at least one training and one test clip")
        if any(clip.span or clip.history or clip.stride > 1 for clip in self.train):
            raise InputError("training clips: expected one run, no history and a stride of 1")
        if self.frames > 1_000_000:
            raise InputError("a scene of more than a million frames")
        if not 2 <= self.samples <= 65536 or self.samples % 2:
            raise InputError(f"{self.samples} samples per pixel, expected an even number from 2 to 65536")
        if not 0 <= self.subject < 2**31:
            raise InputError(f"subject {self.subject}, expected 0 to 2^31 - 1")

    @property
    def clips(self) -> tuple[Clip, ...]:
        """All motion, in the order of its frames."""
        return self.train + self.test + self.near + self.far

    @property
    def frames(self) -> int:
        """Number of frames, training and held out."""
        return sum(clip.count for clip in self.clips)

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything, as JSON. Where a user's files lie is no part of what a scene is; their contents are."""
        parameters = asdict(self)
        if not self.subject:
            del parameters["subject"]
        if per_frame := parameters["rig"].pop("cameras_per_frame"):
            parameters["rig"]["part"] = per_frame  # Its name in manifests: identities stay.
        parameters["rig"]["shutter"] = 0.0  # Of earlier versions, which had motion blur: the identity stays.
        for name in ("near", "far"):
            if not parameters[name]:
                del parameters[name]
        for clip in (clip for name in ("train", "test", "near", "far") for clip in parameters.get(name, ())):
            del clip["path"]
            for name, default in (("runs", 1), ("span", 0), ("history", 0), ("stride", 1)):
                if clip[name] == default:
                    del clip[name]
            if clip["take"] == asdict(Take()):
                del clip["take"]
                continue
            for name in ("fps", "rest_frame"):  # Captures of earlier versions do not have them.
                if clip["take"][name] is None:
                    del clip["take"][name]
        return parameters

    @property
    def identity(self) -> str:
        """SHA-256 over every parameter."""
        return hash_of(self.parameters)


def stream(scene: Scene, *purpose: str | int) -> int:
    """Seed of a random stream: the hash of the root seed, the subject and what the stream is for, in any order."""
    who = [scene.seed, "subject", scene.subject] if scene.subject else [scene.seed]
    return int(hash_of([*who, *purpose])[:8], 16)
