"""Every switch and every row changes what it names, and nothing else.

An avatar is taken apart: each part is fed with the same inputs, whatever the others do, and leaves a fingerprint. What
a switch may change is written down here, by hand; all other fingerprints must be those of ASH as it stands.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.captures import tiny_preset, write_tube_capture
from helpers.learning import training_views

from ash import presets
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose, fewer_views
from ash.gaussians.gaussians import Gaussians
from ash.gaussians.texels import pose
from ash.rotations import RigidTransforms
from ash.textures import Conditions
from ash.training.batches import draw_batch
from ash.training.images import TrainingImages, load_training_images
from ash.training.loop import _Run, view_loss
from benchmarks.cell.methods import configured, find_method
from benchmarks.suites.files import find_suite

TEXELS, CHANNELS = 40, 14


def fingerprint(*values: Any) -> str:
    """Of tensors, arrays and plain values."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, torch.Tensor | np.ndarray):
            array = np.ascontiguousarray(torch.as_tensor(value).detach().float().numpy())
            digest.update(repr(array.shape).encode() + array.tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Subject:
    """An avatar taken apart, with the views that it learns from."""

    avatar: AshAvatar
    capture: Capture
    folder: Path

    @property
    def images(self) -> TrainingImages:
        training = self.avatar.config.training
        return load_training_images(
            fewer_views(self.capture, cameras=training.camera_share, frames=training.frame_share)
        )


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    """The same random numbers for the same shape."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def fixed_conditions(avatar: AshAvatar) -> Conditions:
    """What decoders and posing are given, whatever Stg.1 and Stg.2 make of the motion."""
    model = avatar.config.model
    texels = len(avatar.lattice.texels)
    unit = torch.nn.functional.normalize(numbers(texels, 4), dim=1)
    return Conditions(
        textures=numbers(6 * model.window, model.decoded_texels, model.decoded_texels, seed=1),
        trust=1.0,
        motion=avatar._conditions_of(0).motion,
        root_translation=numbers(3, seed=2),
        canonical=0.1 * numbers(texels, 3, seed=3),
        normals=torch.nn.functional.normalize(numbers(texels, 3, seed=4), dim=1),
        transforms=RigidTransforms(quats=unit, translations=0.1 * numbers(texels, 3, seed=5)),
    )


def template(s: Subject) -> str:
    return fingerprint(*(s.avatar.template.pose(Pose(s.capture.motion, f)).vertices for f in (0, 3)))


def places(s: Subject) -> str:
    made = s.avatar._conditions_of(2)
    return fingerprint(made.canonical, made.normals, made.transforms.quats, made.transforms.translations)


def textures(s: Subject) -> str:
    """Of a pose that was learned from, and of one that was not."""
    drawer, last = s.avatar.module.textures, len(s.capture.motion.dofs) - 1
    unseen = None if drawer is None else drawer(s.avatar.template, Pose(s.capture.motion, last))
    return fingerprint(s.avatar._conditions_of(2).textures, unseen)


def trust(s: Subject) -> str:
    drawer = s.avatar.module.textures
    return fingerprint(None if drawer is None else drawer.fade)


def decoding(s: Subject) -> str:
    """Structure of the decoders, and what they make of fixed textures with fixed weights."""
    decoders = s.avatar.module.decoders
    if decoders is None:
        return fingerprint("none")
    weights = {name: 0.3 * numbers(*p.shape, seed=len(name)) for name, p in decoders.named_parameters()}
    with torch.no_grad():
        for name, parameter in decoders.named_parameters():
            parameter.copy_(weights[name])
        return fingerprint(sorted(weights), decoders(fixed_conditions(s.avatar)))


def counting(s: Subject) -> str:
    """What of the decoders' output counts."""
    return fingerprint(s.avatar.module.corrections(numbers(TEXELS, CHANNELS))[:, :CHANNELS])


def start(s: Subject) -> str:
    module = s.avatar.module
    return fingerprint(module.base[:, :CHANNELS], module.base.requires_grad)


def spread(s: Subject) -> str:
    """How the view changes colours: coefficients per Gaussian."""
    return fingerprint(s.avatar.module.base.shape[1])


def posing(s: Subject) -> str:
    avatar, conditions = s.avatar, fixed_conditions(s.avatar)
    raw = torch.zeros(len(conditions.canonical), avatar.module.base.shape[1])
    raw[:, :CHANNELS] = numbers(len(raw), CHANNELS, seed=6)
    made = pose(raw, conditions, avatar.config.model, None)
    return fingerprint(made.means, made.quats, made.scales, made.opacities, made.sh[:, :1])


def light(s: Subject) -> str:
    return fingerprint(s.avatar.module.light is None)


def drawing(s: Subject) -> str:
    camera = s.capture.cameras["cam1"]
    means = 0.1 * numbers(TEXELS, 3, seed=7) + torch.tensor([0.0, 0.5, 0.0])
    known = Gaussians(
        means=means,
        quats=numbers(TEXELS, 4, seed=8),
        scales=torch.full((TEXELS, 3), 0.02),
        opacities=torch.full((TEXELS,), 0.7),
        sh=numbers(TEXELS, 1, 3, seed=9),
    )
    return fingerprint(s.avatar.module.draw(known, [camera], None).rgb)


def batches(s: Subject) -> str:
    made = [draw_batch(s.images, s.avatar.config.training, 0, step) for step in range(6)]
    return fingerprint(*(value for b in made for value in (b.frame, b.targets, b.background)))


def loss(s: Subject) -> str:
    training = s.avatar.config.training
    batch = draw_batch(load_training_images(s.capture), presets.named("ci").training, 0, 0)
    return fingerprint(view_loss([numbers(*batch.targets.shape, seed=10).sigmoid()], [batch], training))


def noise(s: Subject) -> str:
    """What decoders see while they learn, beyond what they are given."""
    avatar, seen = s.avatar, []
    decode, avatar._decode = avatar._decode, lambda c: (seen.append(c[0].textures), decode(c))[1]
    step = avatar.config.training.static_steps + 1
    training_views(avatar, 2, [s.capture.cameras["cam1"]], torch.zeros(3), step)
    avatar._decode = decode
    return fingerprint(not torch.equal(seen[0], avatar._conditions_of(2).textures))


def warm_up(s: Subject) -> str:
    """What is done before or beside the loop: steps of the static texels alone, and what decoders are regressed to."""
    avatar = s.avatar
    kind = avatar.config.training.warmup if avatar.module.decoders is not None else "none"
    return fingerprint(kind, avatar.config.training.static_steps if avatar.module.decoders is not None else 0)


def average(s: Subject) -> str:
    return fingerprint(bool(_Run(s.avatar, s.avatar.config.training, s.images, s.folder).average))


PARTS: dict[str, Callable[[Subject], str]] = {
    part.__name__: part
    for part in (
        template, places, textures, trust, counting, start, spread, posing, light, drawing, batches, loss, noise,
        warm_up, average, decoding,
    )
}  # fmt: skip


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


@pytest.fixture(autouse=True, scope="module")
def tiny() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=20, warmup_steps=8))
        yield


def taken_apart(avatar: AshAvatar, capture: Capture, folder: Path) -> dict[str, str]:
    return {name: part(Subject(avatar, capture, folder)) for name, part in PARTS.items()}


@pytest.fixture(scope="module")
def plain(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """ASH as it stands."""
    avatar = presets.ash(capture.training_only(), seed=0, preset="ci")
    return taken_apart(avatar, capture, tmp_path_factory.mktemp("plain"))


SWITCHES = {row.name: row for row in find_suite("switches").methods if row.changes}
CHANGED_BY_SWITCH = {
    "warm_up_paper": {"warm_up"},
    "warm_up_released": {"warm_up"},
    "warm_up_none": {"warm_up"},
    "loss_paper": {"loss"},
    "loss_released": {"loss"},
    "norm_released": {"decoding"},
    "norm_instance": {"decoding"},
    "world_rotations": {"posing"},
    "released_phi": {"decoding"},
    "wo_phi": {"decoding"},
    "sh_3": {"decoding", "spread"},
    "wide_dilation": {"drawing"},
    "wo_base": {"start", "trust", "warm_up"},  # Without static texels nothing could take over far from training.
    "blended_anchor": {"places"},
    "wo_light": {"light"},
    "wo_light_and_motion": {"light", "decoding", "textures", "trust", "warm_up"},  # No motion: no decoders at all.
    "wo_standardise": {"textures", "trust"},  # Novelty is told in units of the standardised textures.
    "wo_bound": {"textures"},
    "wo_heading": {"textures"},
    "two_trunks": {"decoding"},
    "noisy_textures": {"noise"},
    "last_weights": {"average"},
    "blendshapes": {"decoding", "textures", "trust"},  # They see no textures.
    "learned_template": {"template", "places", "start", "textures"},  # All that is drawn from it.
}


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_changes_what_it_names_and_nothing_else(
    name: str, capture: Capture, tmp_path: Path, plain: dict[str, str]
) -> None:
    row = SWITCHES[name]
    factory = find_method(row.of or row.name).load()
    avatar = factory(capture.training_only(), seed=0, preset="ci", config=configured(row.of, "ci", row.changes))
    made = taken_apart(avatar, capture, tmp_path)
    assert {part for part in PARTS if made[part] != plain[part]} == CHANGED_BY_SWITCH[name]


CAMERAS = {"batches", "start"}  # The first colours are means over the cameras.
DECODERS = {"decoding", "textures", "trust", "warm_up"}  # No motion: no decoders, nothing that they would see.
LATTICE = {"places", "start", "textures", "decoding", "posing"}  # Other texels: all that is one per texel.
CHANGED_BY_ROW = {
    "wo_disp": {"counting"},
    "wo_motion_offset": {"counting"},
    "wo_offset": {"posing"},
    "wo_mot": DECODERS,
    "wo_mot_truncated": DECODERS | {"batches", "start"},
    "ash_wo_base": {"start", "trust", "warm_up"},
    "mlp": {"decoding", "start", "trust", "warm_up"},
    "mlp_base": {"decoding"},
    "res_128": LATTICE,
    "res_512": LATTICE,
    "cams_12": CAMERAS,
    "cams_30": CAMERAS,
    "cams_60": CAMERAS,
    "ash_truth": {"template", "places", "start", "textures"},
    "ash_frugal": LATTICE | {"trust"},
}


@pytest.mark.parametrize("name", CHANGED_BY_ROW)
def test_a_row_changes_what_it_names_and_nothing_else(
    name: str, capture: Capture, tmp_path: Path, plain: dict[str, str]
) -> None:
    seen = capture if name == "ash_truth" else capture.training_only()
    made = taken_apart(find_method(name).load()(seen, seed=0, preset="ci"), capture, tmp_path)
    assert {part for part in PARTS if made[part] != plain[part]} == CHANGED_BY_ROW[name]
