"""Avatars taken apart: every part is fed with the same inputs, whatever the others do, and leaves a fingerprint."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import ash.native.library
import ash.trained_avatar
from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.texels import pose
from ash.mesh.drawing import MeshView
from ash.protocol import TrainingOutcome
from ash.rotations import RigidTransforms
from ash.template.template import PosedTemplate, skinned_template
from ash.template_learning.refining import MotionRefinement, RefinedDeformation
from ash.textures import DecoderInputs, FrameInputs
from ash.training import loop
from ash.training.batches import Batch, draw_step
from ash.training.losses import view_loss
from baselines.ddc import DdcAvatar, MeshInputs

STEPS, SECONDS_PER_STEP = 7, 20.0  # so many steps are looked at, by a clock on which each takes so long
TEXELS, CHANNELS, PIXELS = 40, 14, 32


def fingerprint(*values: Any) -> str:
    """Of tensors, arrays and plain values, in lists and tuples as well."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, Tensor | np.ndarray):
            array = np.ascontiguousarray(torch.as_tensor(value).detach().float().numpy())
            digest.update(repr(array.shape).encode() + array.tobytes())
        elif isinstance(value, list | tuple):
            digest.update(fingerprint(*value).encode())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def numbers(*shape: int, seed: int = 0) -> Tensor:
    """The same random numbers for the same shape."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


class FakeLearner:
    """Takes an avatar's place in the avatar's own `fit`: learns one number, and notes what the loop does and when."""

    def __init__(self, avatar: Any, capture: Capture, folder: Path) -> None:
        self.module = torch.nn.Linear(1, 1, bias=False)
        self.groups: list[dict[str, Any]] = [{"params": [self.module.weight], "lr": 1.0}]
        self.step = 0
        self.rates: list[float] = []
        self.shown: list[Batch] = []
        self.written: list[tuple[int, str]] = []
        self.outcome: TrainingOutcome
        self.images: Any
        self.before_start: Callable[[], None]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ash.trained_avatar, "Trainer", self.trainer)
            patch.setattr(loop, "time", SimpleNamespace(process_time=self.clock, monotonic=self.clock))
            patch.setattr(loop, "draw_step", self.draw_step)
            patch.setattr(loop, "write_atomic", self.write)
            avatar.fit(capture.training_only(), folder=folder)

    def trainer(self, learner: Any, config: Any, images: Any, **options: Any) -> Any:
        """In place of `Trainer`; what comes before the first step is left to who wants it."""
        self.images, trainer = images, loop.Trainer(self, config, images, **options)

        def fit(before_start: Callable[[], None]) -> TrainingOutcome:
            self.before_start, self.outcome = before_start, trainer.fit()
            return self.outcome

        return SimpleNamespace(fit=fit)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return self.groups

    def loss(self, batches: Sequence[Batch], step: int) -> Tensor:
        self.step = step
        self.rates.append(self.groups[0]["lr"])
        return self.module.weight.mean()

    def render_views(self, frame: int, cameras: list[Camera], background: Tensor) -> Tensor:
        return self.module.weight.reshape(()).expand(len(cameras), cameras[0].height, cameras[0].width, 3)

    def clock(self) -> float:
        return SECONDS_PER_STEP * self.step

    def draw_step(self, *arguments: Any) -> list[Batch]:
        batches = draw_step(*arguments)
        self.shown += batches if self.step < STEPS else []
        return batches

    def write(self, path: Path, content: bytes) -> None:
        self.written += [(self.step, path.name)] if self.step < STEPS else []


@dataclass(frozen=True)
class Subject:
    """An avatar taken apart, with the capture that it learns from, held-out frames included."""

    avatar: Any  # an AshAvatar or a DdcAvatar
    capture: Capture
    folder: Path

    @property
    def is_mesh(self) -> bool:
        return isinstance(self.avatar, DdcAvatar)

    @property
    def static(self) -> Any:
        """What the decoders add to."""
        return self.avatar.base

    @property
    def nets(self) -> dict[str, torch.nn.Parameter]:
        """Of the decoders; none without decoders."""
        of = ("network.", "phi.") if self.is_mesh else ("decoders.",)
        return {name: p for name, p in self.avatar.module.named_parameters() if name.startswith(of)}

    @torch.no_grad()
    def inputs(self, frame: int) -> Any:
        """What decoders take of a frame."""
        return self.avatar._inputs_of(frame)

    @cached_property
    def fake_learner(self) -> FakeLearner:
        return FakeLearner(self.avatar, self.capture, self.folder)

    def learned_in(self, step: int) -> tuple[Tensor, bool] | None:
        """What decoders see in a step, and whether in bfloat16 where tiles are there; None: they are left out."""
        learned: list[tuple[Tensor, bool]] = []

        def decode(frames: Sequence[DecoderInputs]) -> Tensor:
            learned.append((frames[0].textures, torch.is_autocast_enabled("cpu")))
            return self.static[None]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ash.native.library, "has_tiles", lambda: True)
            patch.setattr(self.avatar.module, "decode", decode)
            self.avatar._decode_step([self.inputs(2)], step)
        return learned[0] if learned else None

    @cached_property
    def first_learned(self) -> tuple[Tensor, bool] | None:
        """The same in the first step after the warm-up."""
        return self.learned_in(int(self.avatar.config.training.static_steps))


def fixed_frame(s: Subject) -> Any:
    """What decoders and posing are given, whatever Stg.1 and Stg.2 make of the motion."""
    model = s.avatar.config.model
    seen: dict[str, Any] = {
        "textures": numbers(6 * model.window, model.decoded_texels, model.decoded_texels, seed=1),
        "root_translation": numbers(3, seed=2),
    }
    if s.is_mesh:
        return MeshInputs(**seen, window=[], posed=s.inputs(0).posed)
    texels = len(s.avatar.lattice.texels)
    unit = torch.nn.functional.normalize(numbers(texels, 4), dim=1)
    return FrameInputs(
        **seen,
        motion=s.inputs(0).motion,
        canonical=0.1 * numbers(texels, 3, seed=3),
        normals=torch.nn.functional.normalize(numbers(texels, 3, seed=4), dim=1),
        transforms=RigidTransforms(quats=unit, translations=0.1 * numbers(texels, 3, seed=5)),
    )


@torch.no_grad()
def let_be_known(parameters: dict[str, torch.nn.Parameter]) -> None:
    for name, parameter in parameters.items():
        parameter.copy_(0.3 * numbers(*parameter.shape, seed=len(name)))


# --- the parts: what each makes of its inputs ------------------------------------------------------------------------


def template(s: Subject) -> Any:
    return [s.avatar.template.pose(Pose(s.capture.motion, frame)).vertices for frame in (0, 3)]


def skinning(s: Subject) -> Any:
    made = s.avatar.template.pose(Pose(s.capture.motion, 3)).transforms
    return made.quats, made.translations


def deformation(s: Subject) -> Any:
    """What of the template can be learned before the avatar: structure alone."""
    made: Any = s.avatar.template.deformation
    made = made.inner if isinstance(made, RefinedDeformation) else made
    if not isinstance(made, torch.nn.Module):
        return type(made)
    return type(made), [(name, tuple(value.shape)) for name, value in made.state_dict().items()], made.graph.nodes


def refinement(s: Subject) -> Any:
    """What of the template is learned with the avatar: what it makes of the motion with fixed weights."""
    made = s.avatar.module.refinement
    if made is None:
        return None
    let_be_known(dict(made.named_parameters()))
    window = [made.window(Pose(s.capture.motion, 3))] if isinstance(made, MotionRefinement) else []
    return made(*window)


def pulls(s: Subject) -> Any:
    """In which steps the images pull at the vertices."""
    pulled: list[bool] = []

    def see(posed: PosedTemplate, cameras: list[Camera]) -> list[MeshView]:
        pulled.append(posed.vertices.requires_grad)
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s.avatar.module, "see", see)
        patch.setattr(s.avatar.module, "rasterize", lambda *_: torch.zeros(0, 1, 1, 4))
        for step in range(STEPS):
            s.avatar._draw(s.static, s.inputs(0), [], torch.zeros(3), step)
    return pulled


def places(s: Subject) -> Any:
    made = s.inputs(2)
    return made.canonical, made.normals, made.transforms.quats, made.transforms.translations


def textures(s: Subject) -> Any:
    """Of a pose that was learned from, and of one that was not."""
    drawer, last = s.avatar.module.textures, len(s.capture.motion.dofs) - 1
    unseen = None if drawer is None else drawer(s.avatar.template, Pose(s.capture.motion, last))
    return s.inputs(2).textures, unseen


def weights(s: Subject) -> Any:
    """With which the decoders start."""
    return sorted(s.nets.items())


def decoding(s: Subject) -> Any:
    """Structure of the decoders, and what they make of fixed textures with fixed weights."""
    if not s.nets:
        return None
    let_be_known(s.nets)
    decode = s.avatar.module.residual if s.is_mesh else s.avatar.module.decoders
    return sorted(s.nets), decode([fixed_frame(s)])[0]


def start(s: Subject) -> Any:
    """What is learned directly, of colours the part that no view changes."""
    return s.static if s.is_mesh else s.static[:, :CHANNELS], s.static.requires_grad


def spread(s: Subject) -> Any:
    """How the view changes colours: coefficients per Gaussian."""
    return s.static.shape[1]


def posing(s: Subject) -> Any:
    raw = torch.zeros(s.static.shape)
    raw[:, :CHANNELS] = numbers(len(raw), CHANNELS, seed=6)
    made = pose(raw, fixed_frame(s), s.avatar.config.model, None)
    return made.means, made.quats, made.scales, made.opacities, made.sh[:, :1]


def light(s: Subject) -> Any:
    return getattr(s.avatar.module, "light", None) is None


def drawing(s: Subject) -> Any:
    """Fixed Gaussians, or a fixed texture on a fixed surface."""
    camera, module = s.capture.cameras["cam1"], s.avatar.module
    if s.is_mesh:
        posed, texture = skinned_template(s.capture).pose(Pose(s.capture.motion, 3)), numbers(3, PIXELS, PIXELS)
        return module.rasterize(texture, posed, module.see(posed, [camera]), torch.zeros(3))
    known = Gaussians(
        means=0.1 * numbers(TEXELS, 3, seed=7) + torch.tensor([0.0, 0.5, 0.0]),
        quats=numbers(TEXELS, 4, seed=8),
        scales=torch.full((TEXELS, 3), 0.02),
        opacities=torch.full((TEXELS,), 0.7),
        sh=numbers(TEXELS, 1, 3, seed=9),
    )
    return module.rasterize(known, [camera], None).rgb


def batches(s: Subject) -> Any:
    """What the first steps are shown."""
    return [(b.frame, [c.name for c in b.cameras], b.targets, b.background) for b in s.fake_learner.shown]


def loss(s: Subject) -> Any:
    drawn, target = (numbers(1, PIXELS, PIXELS, 3, seed=seed).sigmoid() for seed in (10, 11))
    batch = Batch(frame=0, cameras=[], targets=target, foreground=target[..., 0], background=torch.zeros(3))
    return view_loss([drawn], [batch], s.avatar.config.training)


def noise(s: Subject) -> Any:
    """Whether decoders see more while they learn than they are given."""
    return s.first_learned is not None and not torch.equal(s.first_learned[0], s.inputs(2).textures)


def precision(s: Subject) -> Any:
    """Whether decoders learn in bfloat16."""
    return s.first_learned is not None and s.first_learned[1]


def warm_up(s: Subject) -> Any:
    """What decoders are regressed to before the loop, and in which of its steps they are left out."""
    taught: list[Any] = []

    def teach(frames: Sequence[int], target: Callable[[int], Tensor], **weights: float) -> None:
        taught.extend((frames, target(frames[0]), weights))

    with pytest.MonkeyPatch.context() as patch:
        if not s.is_mesh:
            patch.setattr(s.avatar, "_fit_frame", lambda images, frame: torch.full((1,), float(frame)))
            patch.setattr(s.avatar, "_regress", teach)
        s.fake_learner.before_start()
    return taught, [s.learned_in(step) is None for step in range(STEPS)] if s.nets else []


def rates(s: Subject) -> Any:
    """What learns, and how fast."""
    kinds = {id(p): name.split(".")[0] for name, p in s.avatar.module.named_parameters()}
    return sorted({(kinds[id(p)], group["lr"]) for group in s.avatar.parameter_groups() for p in group["params"]})


def course(s: Subject) -> Any:
    """How the rates rise and fall, and when and why training ends."""
    return s.fake_learner.rates, s.fake_learner.outcome.steps, s.fake_learner.outcome.ended_by


def files(s: Subject) -> Any:
    """What is written, and after which step."""
    return s.fake_learner.written


def average(s: Subject) -> Any:
    run = loop.Trainer(s.avatar, s.avatar.config.training, s.fake_learner.images, folder=s.folder, seed=0)
    return bool(run.average)


# Those that give weights away come first, and those that set them last.
SHARED = (
    weights, template, skinning, deformation, textures, start, light, drawing, batches, loss, noise, precision, warm_up,
    rates, course, files, average, decoding, refinement,
)  # fmt: skip


def fingerprints(avatar: AshAvatar | DdcAvatar, capture: Capture, folder: Path) -> dict[str, str]:
    """The fingerprints of all parts of an avatar, by their names."""
    subject = Subject(avatar, capture, folder)
    own = (pulls,) if subject.is_mesh else (places, spread, posing)
    return {part.__name__: fingerprint(part(subject)) for part in (*own, *SHARED)}


def differing(one: dict[str, str], other: dict[str, str]) -> set[str]:
    """The parts in which two avatars differ."""
    assert one.keys() == other.keys()
    return {name for name in one if one[name] != other[name]}
