"""The rows of the suites `switches` and `template`; what a switch changes is checked by `test_switch_parts`."""

from functools import partial
from pathlib import Path

import pytest
import torch
from helpers.captures import tiny_preset

from ash import presets
from ash.capture.dataset import Capture
from baselines.mlp import mlp
from benchmarks.cell.registry import configured, find_method, is_oracle
from benchmarks.suites.files import find_suite


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=4, warmup_steps=2))


SWITCHES = [row for row in find_suite("switches").methods if row.changes]
LEARNED = [row for row in find_suite("template").methods if row.changes and row.of == "ash"]


def test_the_mlp_tells_frames_apart_and_learns_no_texels_beneath(capture: Capture, tmp_path: Path) -> None:
    """All that it draws comes out of its decoder."""
    changes = {"training.learning_rate": 2e-3, "training.steps": 24, "training.fitted_steps": 4}
    avatar = mlp(capture.training_only(), seed=0, preset="ci", config=mlp.with_overrides(changes).config("ci"))
    started = avatar.module.base_texels.clone()
    learned = {id(p) for g in avatar.parameter_groups() for p in g["params"]}
    avatar.fit(capture.training_only(), folder=tmp_path)
    outcome = avatar.outcome()
    assert outcome is not None and not outcome.carries_nothing and outcome.correction_spread > 0
    assert not avatar.module.base_texels.requires_grad
    assert id(avatar.module.base_texels) not in learned and torch.equal(avatar.module.base_texels, started)
    assert (started == started[0]).all(), "grey texels, all alike"
    assert {id(p) for p in avatar.module.decoders.parameters()} <= learned


def test_the_suites_have_them_as_rows() -> None:
    assert len(SWITCHES) == 14 and len(LEARNED) == 4
    methods = [row.of or row.name for suite in ("switches", "template") for row in find_suite(suite).methods]
    assert all(find_method(method).is_ours and callable(find_method(method).load()) for method in methods)
    assert not is_oracle("by_scans")
    ways = [configured(row.of, "ci", row.changes) for row in LEARNED]
    assert len({(way.template, way.model.refine) for way in ways}) == 4
