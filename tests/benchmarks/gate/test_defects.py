"""Planted defects are told by the layer that is about them, and harmless changes by none."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from helpers.captures import tiny_plus, write_tube_capture
from helpers.planted_defects import DEFECTS, HARMLESS, Plant

from ash.avatar import AshAvatar
from ash.capture.dataset import Capture, Pose
from ash.config import AshConfig
from ash.files import write_image
from ash.protocol import StageClock
from benchmarks.cell import metrics
from benchmarks.cell.evaluation import evaluated_views, image_summary, scored_views
from benchmarks.cell.schema import CHECKPOINT, Cell, CellConfig, CellResult, prediction_path
from benchmarks.gate.baseline import Entry, stored_views
from benchmarks.gate.checks import FAILING, Check
from benchmarks.gate.exact import first_steps_check, protocol_check, rendering_checks, seeds_check
from benchmarks.gate.statistical import judge_quality

TINY = tiny_plus(steps=16, warmup_steps=4)
PSNR = "foreground", "psnr"


@pytest.fixture(scope="module")
def tube(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return write_tube_capture(tmp_path_factory.mktemp("tube"))


def trained(config: AshConfig, capture: Capture, folder: Path) -> AshAvatar:
    """Train in this process."""
    avatar = AshAvatar.from_capture(config, capture.training_only())
    folder.mkdir(parents=True)
    avatar.fit(capture.training_only(), folder=folder)
    avatar.save(folder / CHECKPOINT)
    return avatar


def drawn(avatar: AshAvatar, capture: Capture, folder: Path) -> Entry:
    """Draw and score."""
    told = CellConfig(
        scene="tube",
        size="ci",
        capture_seed=0,
        capture="c",
        method="ash",
        preset="ci",
        seed=avatar.config.seed,
        code="0",
    )
    cell, views = Cell(config=told, folder=folder), evaluated_views(capture)[::3]
    for view in views:
        picture = avatar.render(Pose(capture.motion, view.frame), capture.cameras[view.camera], clock=StageClock())
        write_image(prediction_path(folder, view), metrics.quantise(picture))
    scored = scored_views(cell, capture, views)
    result = CellResult(config=told, status="done", views=tuple(scored), summary=image_summary(scored))
    return Entry(cell, result)


@pytest.fixture(scope="module")
def seeds(tube: Capture, tmp_path_factory: pytest.TempPathFactory) -> Callable[[AshConfig, int], Entry]:
    """Of a configuration and a seed what changes of it are compared with, trained once for all of them."""

    @cache
    def made(config: AshConfig, seed: int) -> Entry:
        folder = tmp_path_factory.mktemp("sound") / "cell"
        return drawn(trained(replace(config, seed=seed), tube, folder), tube, folder)

    return made


def layers_of(
    config: AshConfig, before: Callable[[int], Entry], plant: Plant, capture: Capture, out: Path
) -> Iterator[list[Check]]:
    """What each layer says of a change, in the order in which the gate asks them, and as it asks them."""
    first = before(0)
    with pytest.MonkeyPatch.context() as patch:
        plant(patch)
        yield [protocol_check("tube", first, capture)]
        avatar = AshAvatar.from_capture(config, capture.training_only())
        avatar.load(first.cell.folder / CHECKPOINT)
        frozen = drawn(avatar, capture, out / "frozen")
        yield rendering_checks("tube", first, frozen, capture)[0]
        avatars = [trained(config, capture, out / "0")]
        logs = first.cell.folder / "log.jsonl", out / "0" / "log.jsonl"
        yield [check for check in (first_steps_check("tube", *logs),) if check]
        avatars.append(trained(replace(config, seed=1), capture, out / "1"))
        after = [drawn(each, capture, out / str(seed)) for seed, each in enumerate(avatars)]
    pair = [first, before(1)], after
    yield [check for check in (seeds_check("tube", *pair),) if check]
    yield judge_quality({"tube": pair}, looks=1)[0]


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_told_by_the_layer_that_is_about_it(
    name: str, tube: Capture, seeds: Callable[[AshConfig, int], Entry], tmp_path: Path
) -> None:
    defect = DEFECTS[name]
    sound = defect.sound(TINY)
    layers = layers_of(defect.config(sound), lambda seed: seeds(sound, seed), defect.plant, tube, tmp_path)
    changed = ([check for check in checks if check.verdict != "unchanged"] for checks in layers)
    first = next(filter(None, changed))
    assert {check.layer for check in first} == {defect.layer}, first
    assert any(defect.reason in check.detail for check in first), first


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_changes_fail_nowhere(
    name: str, tube: Capture, seeds: Callable[[AshConfig, int], Entry], tmp_path: Path
) -> None:
    layers = layers_of(TINY, lambda seed: seeds(TINY, seed), HARMLESS[name], tube, tmp_path)
    checks = [check for layer in layers for check in layer]
    assert not [check for check in checks if check.verdict in FAILING]
    exact = {check.verdict for check in checks if name == "the same bits" or check.layer in ("protocol", "rendering")}
    assert exact == {"unchanged"}


def test_a_picture_that_is_not_stored_is_judged_by_its_scores(
    tube: Capture, seeds: Callable[[AshConfig, int], Entry]
) -> None:
    before = seeds(TINY, 0)
    stored = {view.prediction for view in stored_views(before.result)}
    view = next(view for view in before.result.views if view.prediction not in stored)

    def verdicts(lost_db: float) -> set[str]:
        worse = replace(view, prediction="0", scores=view.scores | {PSNR: view.scores[PSNR] - lost_db})
        views = tuple(worse if each is view else each for each in before.result.views)
        result = replace(before.result, views=views, summary=image_summary(list(views)))
        return {check.verdict for check in rendering_checks("tube", before, replace(before, result=result), tube)[0]}

    assert verdicts(lost_db=0.0) == {"unchanged"}
    assert verdicts(lost_db=3.0) >= {"not worse", "worse"}
