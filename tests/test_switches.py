"""Every switch of the suite `switches` builds, learns and draws, and differs from ASH as it stands."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from captures import tiny_preset, write_tube_capture

from ash import presets
from ash.config import TemplateConfig
from ash.dataset import Capture
from ash.protocol import StageClock
from baselines import switches
from benchmarks.experiments import LEARNED, ORACLES, SUITES, SWITCHES, find_method


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(presets.PRESETS, "ci", partial(tiny_preset, steps=4, warmup_steps=2))


@pytest.fixture(scope="module")
def plain_images() -> dict[str, np.ndarray]:
    """What ASH as it stands draws; filled by the first test."""
    return {}


def drawn(factory: switches.Factory, capture: Capture, folder: Path) -> np.ndarray:
    avatar = factory(capture.training_only(), seed=0, preset="ci")
    avatar.fit(capture.training_only(), folder=folder)
    return avatar.render(capture.motion, 3, next(iter(capture.cameras.values())), clock=StageClock())


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_learns_draws_and_matters(
    name: str, capture: Capture, tmp_path: Path, plain_images: dict[str, np.ndarray]
) -> None:
    if not plain_images:
        plain_images["ash"] = drawn(presets.ash, capture, tmp_path / "ash")
    plain = plain_images["ash"]
    image = drawn(getattr(switches, name), capture, tmp_path / name)
    assert np.isfinite(image).all()
    # The tube's template is exact: there is nothing that a learned one could add.
    assert np.array_equal(image, plain) == name.endswith("_template")


@pytest.mark.parametrize("name", LEARNED)
def test_a_way_to_the_template_is_learned_and_draws(name: str, capture: Capture, tmp_path: Path) -> None:
    avatar = getattr(switches, name)(capture, seed=0, preset="ci")
    assert (avatar.template.learned is None) == (name == "unlearned")
    avatar.fit(capture, folder=tmp_path / name)
    assert np.isfinite(avatar.render(capture.motion, 3, capture.cameras["cam0"], clock=StageClock())).all()
    assert (avatar.config.template, avatar.config.model.refine) != (TemplateConfig(kind="learned"), False)


def test_the_suites_name_them_by_their_path() -> None:
    methods = SUITES["switches"].methods
    assert methods[0] == "ash" and len(methods) == 1 + len(SWITCHES)
    learned = [method for method in SUITES["template"].methods if ":" in method]
    assert len(learned) == len(LEARNED)
    assert all(find_method(m).is_ours and callable(find_method(m).load()) for m in (*methods, *learned))
    assert [method for method in learned if method in ORACLES] == ["baselines.switches:by_vertices"]
