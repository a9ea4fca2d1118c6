"""One code path for every device, proved without a GPU: see `helpers.devices`.

The other way round, a step on the CPU runs while `meta` is the device of every tensor that does not say its own.
"""

import re
from dataclasses import replace

import pytest
import torch
from helpers.devices import META, as_if_averaged, learning_without_numbers, step_of, tiny, without_numbers

import ash.trained_avatar
from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import AshConfig, TemplateConfig
from ash.devices import CPU, cuda_error, device_named, moved
from ash.files import InputError
from ash.presets import named, plus
from ash.template.graph import NeighbourMean
from ash.template.template import Template
from ash.template_learning.deforming import LinearDeformation
from ash.template_learning.graph_nets import GraphDeformation
from ash.template_learning.learning import _learn, learned_template
from ash.textures import TexelLattice, build_lattice
from baselines.ddc import DdcAvatar, ddc


def refining() -> AshConfig:
    """Vertices that learn with the avatar."""
    config = plus("ci")
    return replace(config, model=replace(config.model, refine=True))


VARIANTS = {
    "refining": (refining(), {}),
    **{name: (named(name), {}) for name in ("ci", "paper", "official")},  # The others are `ci` of other lengths.
    "exact": (plus("ci"), {"kind": "exact"}),
    "planted_error": (plus("ci"), {"kind": "exact", "error_mm": 4.0}),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_training_step_stays_on_its_device(variant: str, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    without_numbers(monkeypatch)
    config, template = VARIANTS[variant]
    avatar = AshAvatar.from_capture(tiny(config, **template), capture)
    learned = step_of(avatar, capture, META)
    assert learned and all(parameter.device == META for parameter in learned)
    assert {tensor.device for tensor in (*avatar.module.buffers(), *avatar.module.parameters())} == {META}


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_of_a_step_is_made_on_the_default_device(variant: str, capture: Capture) -> None:
    config, template = VARIANTS[variant]
    avatar = AshAvatar.from_capture(tiny(config, **template), capture)
    with META:
        learned = step_of(avatar, capture, CPU)
    assert learned and all(bool(torch.isfinite(parameter).all()) for parameter in learned)


@pytest.mark.parametrize("kind", [LinearDeformation, GraphDeformation])
def test_a_learned_template_is_posed_on_its_device(
    kind: type, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny(plus("ci")).template
    template = Template(capture.template, capture.skeleton, kind(config, capture.template, capture.skeleton))
    monkeypatch.setattr(NeighbourMean, "__call__", as_if_averaged)  # `meta` has no sparse product.
    posed = template.to(META).pose(Pose(capture.motion, 2))
    assert {posed.vertices.device, posed.normals.device, posed.transforms.quats.device} == {META}


LEARNED = [("linear", "images"), ("linear", "scans"), ("graph", "scans")]


def learning(network: str, supervision: str) -> TemplateConfig:
    """A small template, through all that a larger one is learned by."""
    small = {"nodes": 30, "blocks": 1, "steps": 3}
    return TemplateConfig(kind="learned", network=network, supervision=supervision, released=True, **small)


def with_few_views(capture: Capture) -> Capture:
    """Two frames of two cameras: every frame and view goes the same way."""
    train = capture.splits["train"]
    return replace(capture, splits={"train": train.only(cameras=train.cameras[::2], frames=train.frames[:2])})


def unlearned(config: TemplateConfig, capture: Capture) -> LinearDeformation | GraphDeformation:
    kind = LinearDeformation if config.network == "linear" else GraphDeformation
    return kind(config, capture.template, capture.skeleton)


@pytest.mark.parametrize(("network", "supervision"), LEARNED)
def test_a_template_is_learned_on_its_device(
    network: str, supervision: str, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    learning_without_numbers(monkeypatch)
    config = learning(network, supervision)
    deformation = unlearned(config, capture)
    _learn(deformation, config, with_few_views(capture), 0, META)
    assert {value.device for value in deformation.state_dict().values()} == {META}


@pytest.mark.parametrize(("network", "supervision"), LEARNED)
def test_nothing_of_learning_a_template_is_made_on_the_default_device(
    network: str, supervision: str, capture: Capture
) -> None:
    config, seen = learning(network, supervision), with_few_views(capture)
    deformation, expected = unlearned(config, capture), learned_template(config, seen, seed=0).deformation
    deformation.load_state_dict(started(config, capture))
    with META:
        _learn(deformation, config, seen, 0, CPU)
    for found, wanted in zip(deformation.parameters(), expected.parameters(), strict=True):
        assert torch.equal(found, wanted)


def started(config: TemplateConfig, capture: Capture) -> dict[str, torch.Tensor]:
    """What `learned_template` starts from."""
    torch.manual_seed(0)
    return unlearned(config, capture).state_dict()


@pytest.mark.parametrize("kind", [AshAvatar, DdcAvatar])
def test_an_avatar_learns_its_template_on_its_own_device(
    kind: type, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Asked(Exception):
        """For a template, on a device."""

    def ask(*_: object, device: torch.device, **__: object) -> None:
        raise Asked(device)

    monkeypatch.setattr(ash.trained_avatar, "device_named", lambda name: META)
    monkeypatch.setattr(ash.trained_avatar, "template_of", ask)
    config = plus("ci") if kind is AshAvatar else ddc.config("ci")
    with pytest.raises(Asked, match="meta"):
        kind.from_capture(config, capture)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize(("network", "supervision"), LEARNED)
def test_a_gpu_learns_the_template_that_the_cpu_learns(network: str, supervision: str, capture: Capture) -> None:
    config = learning(network, supervision)
    there, here = (learned_template(config, capture, seed=0, device=torch.device(name)) for name in ("cuda", "cpu"))
    a, b = (template.pose(Pose(capture.motion, 3)).vertices for template in (there, here))
    assert a.device == CPU
    torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def test_moving_nothing_copies_nothing(capture: Capture) -> None:
    lattice = build_lattice(capture.template, 16)
    assert moved(lattice, CPU) is lattice
    there = moved((lattice, [lattice.texels], None, "text"), META)
    assert isinstance(there[0], TexelLattice) and there[0].corners.device == there[1][0].device == META
    assert there[0].resolution == 16 and there[2:] == (None, "text")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused_with_the_reason(capture: Capture) -> None:
    assert device_named("cpu") == CPU
    with pytest.raises(InputError, match=re.escape(f"device cuda:1: {cuda_error('cuda:1')}")):
        device_named("cuda:1")
    with pytest.raises(InputError, match=r"^device cuda: torch"):
        AshAvatar.from_capture(replace(tiny(plus("ci")), device="cuda"), capture)
    with pytest.raises(InputError, match="expected cpu, cuda or cuda:N, got 'gpu'"):
        replace(plus("ci"), device="gpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("preset", ["ci", "paper", "official"])
def test_a_gpu_learns_what_the_cpu_learns(preset: str, capture: Capture) -> None:
    there, here = (
        AshAvatar.from_capture(replace(tiny(named(preset)), device=name), capture) for name in ("cuda", "cpu")
    )
    for learned, expected in zip(
        step_of(there, capture, torch.device("cuda")), step_of(here, capture, CPU), strict=True
    ):
        torch.testing.assert_close(learned.grad.cpu(), expected.grad, rtol=1e-2, atol=1e-2 * expected.grad.abs().max())
