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
from helpers.fake_learner import STEPS, FakeLearner
from torch import Tensor

import ash.native.library
import ash.trained_avatar
from ash.avatar import AshAvatar
from ash.capture.dataset import Camera, Capture, Pose
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.texels import pose
from ash.mesh.drawing import MeshView
from ash.rotations import RigidTransforms
from ash.template.template import PosedTemplate, skinned_template
from ash.template_learning.refining import MotionRefinement, RefinedDeformation
from ash.textures import DecoderInputs, FrameInputs
from ash.training import loop
from ash.training.batches import Batch
from ash.training.losses import view_loss
from baselines.ddc import DdcAvatar, MeshInputs

TEXELS, CHANNELS, PIXELS = 40, 14, 32


def fingerprint(*values: Any) -> str:
    """Of tensors, arrays and plain values."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, Tensor | np.ndarray):
            array = np.ascontiguousarray(torch.as_tensor(value).detach().float().numpy())
            digest.update(repr(array.shape).encode() + array.tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def numbers(*shape: int, seed: int = 0) -> Tensor:
    """The same random numbers for the same shape."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


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
    def static(self) -> torch.nn.Parameter:
        """What the decoders add to."""
        made: torch.nn.Parameter = self.avatar.base
        return made

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
        """The avatar's own `fit`, with somebody else in its place."""
        made = FakeLearner()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ash.trained_avatar, "Trainer", made.trainer)
            patch.setattr(loop, "time", SimpleNamespace(process_time=made.clock, monotonic=made.clock))
            patch.setattr(loop, "draw_step", made.draw_step)
            patch.setattr(loop, "write_atomic", made.write)
            self.avatar.fit(self.capture.training_only(), folder=self.folder)
        return made

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

    @property
    def first_decoded(self) -> int:
        """The first step after the warm-up."""
        return int(self.avatar.config.training.static_steps)


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


def template(s: Subject) -> str:
    return fingerprint(*(s.avatar.template.pose(Pose(s.capture.motion, f)).vertices for f in (0, 3)))


def skinning(s: Subject) -> str:
    made = s.avatar.template.pose(Pose(s.capture.motion, 3)).transforms
    return fingerprint(made.quats, made.translations)


def deformation(s: Subject) -> str:
    """What of the template can be learned before the avatar: structure alone."""
    made: Any = s.avatar.template.deformation
    made = made.inner if isinstance(made, RefinedDeformation) else made
    if not isinstance(made, torch.nn.Module):
        return fingerprint(type(made))
    shapes = [(name, tuple(value.shape)) for name, value in made.state_dict().items()]
    return fingerprint(type(made), shapes, made.graph.nodes)


def refinement(s: Subject) -> str:
    """What of the template is learned with the avatar: what it makes of the motion with fixed weights."""
    made = s.avatar.module.refinement
    if made is None:
        return fingerprint("none")
    let_be_known(dict(made.named_parameters()))
    window = [made.window(Pose(s.capture.motion, 3))] if isinstance(made, MotionRefinement) else []
    with torch.no_grad():
        return fingerprint(made(*window))


def pulls(s: Subject) -> str:
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
    return fingerprint(pulled)


def places(s: Subject) -> str:
    made = s.inputs(2)
    return fingerprint(made.canonical, made.normals, made.transforms.quats, made.transforms.translations)


def textures(s: Subject) -> str:
    """Of a pose that was learned from, and of one that was not."""
    drawer, last = s.avatar.module.textures, len(s.capture.motion.dofs) - 1
    unseen = None if drawer is None else drawer(s.avatar.template, Pose(s.capture.motion, last))
    return fingerprint(s.inputs(2).textures, unseen)


def weights(s: Subject) -> str:
    """With which the decoders start."""
    return fingerprint(*(part for name, p in sorted(s.nets.items()) for part in (name, p)))


def decoding(s: Subject) -> str:
    """Structure of the decoders, and what they make of fixed textures with fixed weights."""
    if not s.nets:
        return fingerprint("none")
    let_be_known(s.nets)
    decode = s.avatar.module.residual if s.is_mesh else s.avatar.module.decoders
    with torch.no_grad():
        return fingerprint(sorted(s.nets), decode([fixed_frame(s)])[0])


def start(s: Subject) -> str:
    """What is learned directly, of colours the part that no view changes."""
    return fingerprint(s.static if s.is_mesh else s.static[:, :CHANNELS], s.static.requires_grad)


def spread(s: Subject) -> str:
    """How the view changes colours: coefficients per Gaussian."""
    return fingerprint(s.static.shape[1])


def posing(s: Subject) -> str:
    raw = torch.zeros(s.static.shape)
    raw[:, :CHANNELS] = numbers(len(raw), CHANNELS, seed=6)
    made = pose(raw, fixed_frame(s), s.avatar.config.model, None)
    return fingerprint(made.means, made.quats, made.scales, made.opacities, made.sh[:, :1])


def light(s: Subject) -> str:
    return fingerprint(getattr(s.avatar.module, "light", None) is None)


def drawing(s: Subject) -> str:
    """Fixed Gaussians, or a fixed texture on a fixed surface."""
    camera, module = s.capture.cameras["cam1"], s.avatar.module
    if s.is_mesh:
        posed, texture = skinned_template(s.capture).pose(Pose(s.capture.motion, 3)), numbers(3, PIXELS, PIXELS)
        return fingerprint(module.rasterize(texture, posed, module.see(posed, [camera]), torch.zeros(3)))
    known = Gaussians(
        means=0.1 * numbers(TEXELS, 3, seed=7) + torch.tensor([0.0, 0.5, 0.0]),
        quats=numbers(TEXELS, 4, seed=8),
        scales=torch.full((TEXELS, 3), 0.02),
        opacities=torch.full((TEXELS,), 0.7),
        sh=numbers(TEXELS, 1, 3, seed=9),
    )
    return fingerprint(module.rasterize(known, [camera], None).rgb)


def batches(s: Subject) -> str:
    """What the first steps are shown."""
    return fingerprint(
        *(
            value
            for b in s.fake_learner.shown
            for value in (b.frame, [c.name for c in b.cameras], b.targets, b.background)
        )
    )


def loss(s: Subject) -> str:
    drawn, target = (numbers(1, PIXELS, PIXELS, 3, seed=seed).sigmoid() for seed in (10, 11))
    batch = Batch(frame=0, cameras=[], targets=target, foreground=target[..., 0], background=torch.zeros(3))
    return fingerprint(view_loss([drawn], [batch], s.fake_learner.config))


def noise(s: Subject) -> str:
    """Whether decoders see more while they learn than they are given."""
    learned = s.learned_in(s.first_decoded)
    return fingerprint(learned is not None and not torch.equal(learned[0], s.inputs(2).textures))


def precision(s: Subject) -> str:
    """Whether decoders learn in bfloat16."""
    learned = s.learned_in(s.first_decoded)
    return fingerprint(learned is not None and learned[1])


def warm_up(s: Subject) -> str:
    """What decoders are regressed to before the loop, and in which of its steps they are left out."""
    taught: list[Any] = []

    def teach(frames: Sequence[int], target: Callable[[int], Tensor], **weights: float) -> None:
        taught.extend((frames, target(frames[0]), weights))

    with pytest.MonkeyPatch.context() as patch:
        if not s.is_mesh:
            patch.setattr(s.avatar, "_fit_frame", lambda images, frame: torch.full((1,), float(frame)))
            patch.setattr(s.avatar, "_regress", teach)
        s.fake_learner.before_start()
    left_out = [s.learned_in(step) is None for step in range(STEPS)] if s.nets else []
    return fingerprint(*taught, left_out)


def rates(s: Subject) -> str:
    """What learns, and how fast."""
    kinds = {id(p): name.split(".")[0] for name, p in s.avatar.module.named_parameters()}
    return fingerprint(
        sorted({(kinds[id(p)], group["lr"]) for group in s.avatar.parameter_groups() for p in group["params"]})
    )


def course(s: Subject) -> str:
    """How the rates rise and fall, and when and why training ends."""
    outcome = s.fake_learner.outcome
    return fingerprint(s.fake_learner.rates, outcome.steps, outcome.ended_by)


def files(s: Subject) -> str:
    """What is written, and after which step."""
    return fingerprint(s.fake_learner.written)


def average(s: Subject) -> str:
    run = loop.Trainer(s.avatar, s.avatar.config.training, s.fake_learner.images, folder=s.folder, seed=0)
    return fingerprint(bool(run.average))


# Those that give weights away come first, and those that set them last.
SHARED = (
    weights, template, skinning, deformation, textures, start, light, drawing, batches, loss, noise,
    precision,
    warm_up, rates, course, files, average, decoding, refinement,
)  # fmt: skip
PARTS = {
    False: {part.__name__: part for part in (places, spread, posing, *SHARED)},
    True: {part.__name__: part for part in (pulls, *SHARED)},
}  # by whether it is a mesh


def fingerprints(avatar: AshAvatar | DdcAvatar, capture: Capture, folder: Path) -> dict[str, str]:
    """The fingerprints of all parts of an avatar, by their names."""
    subject = Subject(avatar, capture, folder)
    return {name: part(subject) for name, part in PARTS[subject.is_mesh].items()}


def differing(one: dict[str, str], other: dict[str, str]) -> set[str]:
    """The parts in which two avatars differ."""
    assert one.keys() == other.keys()
    return {name for name in one if one[name] != other[name]}
