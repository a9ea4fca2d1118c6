"""One code path for every device: the mesh and the other baselines, as `tests/ash/test_devices.py` has ASH."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.devices import META, step_of, tiny, without_numbers

from ash.capture.dataset import Capture
from ash.devices import CPU
from ash.presets import MethodFactory
from baselines.ablations import wo_disp, wo_mot, wo_mot_plus
from baselines.ddc import ddc, ddc_plus
from baselines.field import hdhumans, neural_actor, tava
from baselines.mlp import mlp, mlp_base
from baselines.oracle_texture import oracle_texture
from baselines.static import static

RECIPES: dict[str, MethodFactory[Any]] = {
    "ddc": ddc,
    "ddc_plus": ddc_plus,
    "ddc_moves": ddc.with_overrides({"refine": "motion"}),
    "ddc_still": ddc.with_overrides({"refine": "none"}),
    "oracle_texture": oracle_texture,
    "static": static,
    "wo_mot": wo_mot,
    "wo_disp": wo_disp,
    "wo_mot_plus": wo_mot_plus,
    "mlp": mlp,
    "mlp_base": mlp_base,
}
FIELDS: dict[str, MethodFactory[Any]] = {  # Their step on `meta` is that of the published size, in `test_field.py`.
    "tava": tava,
    "neural_actor": neural_actor.with_overrides({"field.surface": "template"}),
    "hdhumans": hdhumans,
}


def avatar_of(name: str, capture: Capture) -> Any:
    recipe = (RECIPES | FIELDS)[name]
    return recipe.build(tiny(recipe.config("ci")), capture)


@pytest.mark.parametrize("name", RECIPES)
def test_a_training_step_stays_on_its_device(name: str, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    without_numbers(monkeypatch)
    if name.startswith("mlp"):  # `meta` has no autocast; its half precision is of no account here.
        monkeypatch.setattr(torch, "autocast", lambda *_, **__: torch.enable_grad())
    learned = step_of(avatar_of(name, capture), capture, META)
    assert learned and all(parameter.device == META for parameter in learned)


@pytest.mark.parametrize("name", RECIPES | FIELDS)
def test_nothing_of_a_step_is_made_on_the_default_device(name: str, capture: Capture) -> None:
    avatar = avatar_of(name, capture)
    with META:
        learned = step_of(avatar, capture, CPU)
    assert learned and all(bool(torch.isfinite(parameter).all()) for parameter in learned)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("name", RECIPES | FIELDS)
def test_a_gpu_learns_what_the_cpu_learns(name: str, capture: Capture) -> None:
    recipe = (RECIPES | FIELDS)[name]
    config = tiny(recipe.config("ci"))
    there, here = (recipe.build(replace(config, device=device), capture) for device in ("cuda", "cpu"))
    for learned, expected in zip(
        step_of(there, capture, torch.device("cuda")), step_of(here, capture, CPU), strict=True
    ):
        torch.testing.assert_close(learned.grad.cpu(), expected.grad, rtol=1e-2, atol=1e-2 * expected.grad.abs().max())
