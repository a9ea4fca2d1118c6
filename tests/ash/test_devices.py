"""One code path for every device and every method, proved without a GPU: see `helpers.devices`.

The other way round, a step on the CPU runs while `meta` is the device of every tensor that does not say its own.
"""

import re
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.devices import META, as_if_averaged, learning_without_numbers, step_of, tiny, without_numbers

import ash.trained_avatar
from ash import presets
from ash.capture.dataset import Capture, Pose
from ash.config import TemplateConfig
from ash.devices import CPU, cuda_error, device_named, moved
from ash.files import InputError
from ash.presets import MethodFactory
from ash.template.graph import NeighbourMean
from ash.template.template import Template
from ash.template_learning.deforming import LinearDeformation
from ash.template_learning.graph_nets import GraphDeformation
from ash.template_learning.learning import _learn, learned_template
from ash.textures import TexelLattice, build_lattice
from baselines import ablations, ddc, field, mlp, oracle_texture, static

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
OF_ASH: dict[str, tuple[str, dict[str, Any]]] = {  # preset and template; the other presets are `ci` of other lengths
    "ci": ("ci", {}),
    "paper": ("paper", {}),
    "official": ("official", {}),
    "exact": ("ci", {"kind": "exact"}),
    "planted_error": ("ci", {"kind": "exact", "error_mm": 4.0}),
}
OTHERS: dict[str, MethodFactory[Any]] = {
    "refining": presets.ash_plus.with_overrides({"model.refine": True}),  # Vertices that learn with the avatar.
    "ddc": ddc.ddc,
    "ddc_plus": ddc.ddc_plus,
    "ddc_moves": ddc.ddc.with_overrides({"refine": "motion"}),
    "ddc_still": ddc.ddc.with_overrides({"refine": "none"}),
    "oracle_texture": oracle_texture.oracle_texture,
    "static": static.static,
    "wo_mot": ablations.wo_mot,
    "wo_disp": ablations.wo_disp,
    "wo_mot_plus": ablations.wo_mot_plus,
    "mlp": mlp.mlp,
    "mlp_base": mlp.mlp_base,
}
FIELDS: dict[str, MethodFactory[Any]] = {  # Their step on `meta` is that of the published size, in `test_field.py`.
    "tava": field.tava,
    "neural_actor": field.neural_actor.with_overrides({"field.surface": "template"}),
    "hdhumans": field.hdhumans,
}


def avatar_of(name: str, capture: Capture, device: str = "cpu") -> Any:
    factory = (OTHERS | FIELDS).get(name, presets.ash)
    preset, template = OF_ASH.get(name, ("ci", {}))
    return factory.build(replace(tiny(factory.config(preset), **template), device=device), capture)


@pytest.mark.parametrize("name", OF_ASH | OTHERS)
def test_a_training_step_stays_on_its_device(name: str, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    without_numbers(monkeypatch)
    avatar = avatar_of(name, capture)
    learned = step_of(avatar, capture, META)
    assert learned and all(parameter.device == META for parameter in learned)
    assert {tensor.device for tensor in (*avatar.module.buffers(), *avatar.module.parameters())} == {META}


@pytest.mark.parametrize("name", ["ci", "refining", "ddc", "ddc_moves", *FIELDS])
def test_nothing_of_a_step_is_made_on_the_default_device(name: str, capture: Capture) -> None:
    """Nor of what `without_numbers` replaces: drawing, outlines and graph networks."""
    avatar = avatar_of(name, capture)
    with META:
        learned = step_of(avatar, capture, CPU)
    assert learned and all(bool(torch.isfinite(parameter).all()) for parameter in learned)


@on_gpu
@pytest.mark.parametrize("name", OF_ASH | OTHERS | FIELDS)
def test_a_gpu_learns_what_the_cpu_learns(name: str, capture: Capture) -> None:
    there = step_of(avatar_of(name, capture, "cuda"), capture, torch.device("cuda"))
    for learned, expected in zip(there, step_of(avatar_of(name, capture), capture, CPU), strict=True):
        torch.testing.assert_close(learned.grad.cpu(), expected.grad, rtol=1e-2, atol=1e-2 * expected.grad.abs().max())


LEARNED = pytest.mark.parametrize(
    ("network", "supervision"), [("linear", "images"), ("linear", "scans"), ("graph", "scans")]
)


def learning(network: str, supervision: str) -> TemplateConfig:
    """A small template, through all that a larger one is learned by."""
    small = {"nodes": 30, "blocks": 1, "steps": 3}
    return TemplateConfig(kind="learned", network=network, supervision=supervision, released=True, **small)


def with_few_views(capture: Capture) -> Capture:
    """Two frames of two cameras: every frame and view goes the same way."""
    train = capture.splits["train"]
    return replace(capture, splits={"train": train.only(cameras=train.cameras[::2], frames=train.frames[:2])})


def unlearned(config: TemplateConfig, capture: Capture) -> LinearDeformation | GraphDeformation:
    """What `learned_template` starts from with the seed 0."""
    torch.manual_seed(0)
    kind = LinearDeformation if config.network == "linear" else GraphDeformation
    return kind(config, capture.template, capture.skeleton)


@pytest.mark.parametrize("network", ["linear", "graph"])
def test_a_learned_template_is_posed_on_its_device(
    network: str, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    template = Template(capture.template, capture.skeleton, unlearned(learning(network, "scans"), capture))
    monkeypatch.setattr(NeighbourMean, "__call__", as_if_averaged)  # `meta` has no sparse product.
    posed = template.to(META).pose(Pose(capture.motion, 2))
    assert {posed.vertices.device, posed.normals.device, posed.transforms.quats.device} == {META}


@LEARNED
def test_a_template_is_learned_on_its_device(
    network: str, supervision: str, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    learning_without_numbers(monkeypatch)
    config = learning(network, supervision)
    deformation = unlearned(config, capture)
    _learn(deformation, config, with_few_views(capture), 0, META)
    assert {value.device for value in deformation.state_dict().values()} == {META}


@LEARNED
def test_nothing_of_learning_a_template_is_made_on_the_default_device(
    network: str, supervision: str, capture: Capture
) -> None:
    config, seen = learning(network, supervision), with_few_views(capture)
    expected, deformation = learned_template(config, seen, seed=0).deformation, unlearned(config, capture)
    with META:
        _learn(deformation, config, seen, 0, CPU)
    for found, wanted in zip(deformation.parameters(), expected.parameters(), strict=True):
        assert torch.equal(found, wanted)


@pytest.mark.parametrize("factory", [presets.ash_plus, ddc.ddc], ids=["ash_plus", "ddc"])
def test_an_avatar_learns_its_template_on_its_own_device(
    factory: MethodFactory[Any], capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Asked(Exception):
        """For a template, on a device."""

    def ask(*_: object, device: torch.device, **__: object) -> None:
        raise Asked(device)

    monkeypatch.setattr(ash.trained_avatar, "device_named", lambda name: META)
    monkeypatch.setattr(ash.trained_avatar, "template_of", ask)
    with pytest.raises(Asked, match="meta"):
        factory(capture, seed=0, preset="ci")


@on_gpu
@LEARNED
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
        avatar_of("ci", capture, "cuda")
    with pytest.raises(InputError, match="expected cpu, cuda or cuda:N, got 'gpu'"):
        replace(presets.ci(), device="gpu")
