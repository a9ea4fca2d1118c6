"""Planted defects are told by the layer that is about them, and harmless changes by none."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from helpers.captures import tiny_plus, write_tube_capture
from helpers.planted_defects import DEFECTS, HARMLESS, Defect

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import AshConfig
from ash.files import write_image
from ash.protocol import StageClock
from benchmarks.cell import metrics
from benchmarks.cell.evaluation import evaluated_views, image_summary, scored_views
from benchmarks.cell.schema import CHECKPOINT, Cell, CellConfig, CellResult, prediction_path
from benchmarks.gate.baseline import Entry
from benchmarks.gate.checks import FAILING, Check
from benchmarks.gate.exact import equal_seeds, first_steps_check, protocol_check, rendering_checks, worst_picture
from benchmarks.gate.statistical import judge_quality

TINY = tiny_plus(steps=16, warmup_steps=4)


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube"))


def cell_of(config: AshConfig, capture: Capture, folder: Path, *, trained: Path | None = None) -> Entry:
    """Train in this process, or load what was trained; draw and score."""
    avatar = AshAvatar.from_capture(config, capture.training_only())
    if trained is None:
        folder.mkdir(parents=True)
        avatar.fit(capture.training_only(), folder=folder)
        avatar.save(folder / CHECKPOINT)
    else:
        avatar.load(trained / CHECKPOINT)
    told = CellConfig(
        scene="tube", size="ci", capture_seed=0, capture="c", method="ash", preset="ci", seed=config.seed, code="0"
    )
    cell, views = Cell(config=told, folder=folder), evaluated_views(capture)[::3]
    for view in views:
        picture = avatar.render(Pose(capture.motion, view.frame), capture.cameras[view.camera], clock=StageClock())
        write_image(prediction_path(folder, view), metrics.quantise(picture))
    scored = scored_views(cell, capture, views)
    result = CellResult(config=told, status="done", views=tuple(scored), summary=image_summary(scored))
    return Entry(cell=cell, result=result)


@pytest.fixture(scope="module")
def sound(tube: Capture, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Defect], list[Entry]]:
    """Two seeds of what a defect is compared with, trained once for all that have the same."""

    @cache
    def trained(config: AshConfig) -> list[Entry]:
        folder = tmp_path_factory.mktemp("sound")
        return [cell_of(replace(config, seed=seed), tube, folder / str(seed)) for seed in range(2)]

    return lambda defect: trained(defect.sound(TINY))


def layers_of(defect: Defect, before: list[Entry], capture: Capture, folder: Path) -> Iterator[list[Check]]:
    """What each layer says of a change, in the order in which the gate asks them, and as it asks them."""
    config = defect.config(defect.sound(TINY))
    with pytest.MonkeyPatch.context() as patch:
        defect.plant(patch)
        yield [protocol_check("tube", before[0], capture)]
        frozen = cell_of(config, capture, folder / "frozen", trained=before[0].cell.folder)
        worst = worst_picture(before[0].cell, frozen.cell, before[0].result, capture)
        yield rendering_checks("tube", before[0].result, frozen.result, worst)
        after = [cell_of(replace(config, seed=seed), capture, folder / str(seed)) for seed in range(2)]
        logs = (each[0].cell.folder / "log.jsonl" for each in (before, after))
        yield [check for check in (first_steps_check("tube", *logs), equal_seeds("tube", after)) if check]
        yield list(judge_quality({"tube": (before, after)}, looks=1).checks)


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_told_by_the_layer_that_is_about_it(
    name: str, tube: Capture, sound: Callable[[Defect], list[Entry]], tmp_path: Path
) -> None:
    defect = DEFECTS[name]
    layers = layers_of(defect, sound(defect), tube, tmp_path)
    changed = ([check for check in checks if check.verdict != "unchanged"] for checks in layers)
    first = next(filter(None, changed))
    assert {check.layer for check in first} == {defect.layer}, first
    assert any(defect.reason in check.detail for check in first), first


@pytest.mark.parametrize("name", HARMLESS)
def test_a_harmless_change_fails_nowhere(
    name: str, tube: Capture, sound: Callable[[Defect], list[Entry]], tmp_path: Path
) -> None:
    defect = HARMLESS[name]
    checks = [check for layer in layers_of(defect, sound(defect), tube, tmp_path) for check in layer]
    assert not [check for check in checks if check.verdict in FAILING]
    assert {check.verdict for check in checks if check.layer in ("protocol", "rendering")} == {"unchanged"}
