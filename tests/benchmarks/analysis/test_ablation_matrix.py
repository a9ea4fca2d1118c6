"""Scenes by components: verdicts, surprises and strengths on known numbers, and the charts of them."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pandas as pd
import pytest
from helpers.cells import people

from benchmarks.analysis.ablation_matrix import (
    COMPONENTS,
    CONTROL_SCENES,
    EXPECTED,
    matrix,
    more_than_without,
    strength_curves,
    surprises,
    undecided,
)
from benchmarks.analysis.differences import differences
from benchmarks.analysis.results import RunTables, load
from benchmarks.cell.registry import configured
from benchmarks.cell.schema import CellResult, failed_result
from benchmarks.report import sections
from benchmarks.report.content import Bullets, Section, Table, Text
from benchmarks.report.vega import Figure
from benchmarks.suites.captures import described
from benchmarks.suites.files import find_suite
from synth.presets import FACTORS

DITHER = (0.0, 0.003, -0.002)  # what a method loses differs a little from one subject to the next


def run(scene: str, levels: dict[str, float], *, dither: tuple[float, ...] = DITHER) -> list[CellResult]:
    """Three subjects, 2 dB apart."""
    return people(
        {
            method: tuple(level + 2 * k + (shift if index else 0.0) for k, shift in enumerate(dither))
            for index, (method, level) in enumerate(levels.items())
        },
        scene=scene,
    )


@pytest.fixture(scope="module")
def factors() -> RunTables:
    """Motion is needed on `wrinkles` and `skinned`, not on `swing`; `turning` is worse off with a heading."""
    base = {"ash": 27.0, "wo_mot": 27.0, "plus_heading": 27.0, "sh_0": 27.0, "sh_1": 27.0, "ash_truth": 30.0}
    results = run("skinned", base | {"wo_mot": 26.0})
    results += run("wrinkles_half", base | {"wo_mot": 26.4}) + run("wrinkles", base | {"wo_mot": 25.5})
    results += run("wrinkles_twice", base | {"wo_mot": 24.0}) + run("swing", base)
    results += run("turning", base | {"plus_heading": 26.5}) + run("glossy", base | {"sh_0": 26.0, "sh_1": 26.1})
    return RunTables(results)


def verdicts(tables: RunTables) -> dict[tuple[str, str], str]:
    found = matrix(tables, differences(tables.rows), "novel_view")
    return {(effect.scene, effect.row): effect.verdict for effect in found}


def test_the_matrix_has_the_verdicts_of_the_differences(factors: RunTables) -> None:
    found = verdicts(factors)
    assert found["wrinkles", "wo_mot"] == "better" and found["swing", "wo_mot"] == "equivalent"
    assert found["turning", "plus_heading"] == "worse"
    assert (found["glossy", "sh_0"], found["glossy", "sh_1"]) == ("better", "better")
    assert len(found) == 4 * 5 and {scene for scene, _ in found}.isdisjoint({"wrinkles_half", "wrinkles_twice"})
    effects = matrix(factors, differences(factors.rows), "novel_view")
    assert list(dict.fromkeys(effect.component for effect in effects)) == [
        "w/o mot.",
        "SH 0",
        "SH 1",
        "w/o heading normalised",
    ]
    noisy = run("wrinkles", {"ash": 27.0, "wo_mot": 26.0}, dither=(1.5, -1.5, 0.5))
    noisy += run("swing", {"ash": 27.0, "wo_mot": 26.0}, dither=(0.0,))
    assert set(verdicts(RunTables(noisy)).values()) == {"unclear"}


def test_one_scene_or_no_component_makes_no_matrix() -> None:
    assert verdicts(RunTables(run("still", {"ash": 27.0, "wo_mot": 26.0}))) == {}
    for other in ("ash_truth", "static", "ddc"):
        results = run("still", {"ash": 27.0, other: 30.0}) + run("swing", {"ash": 27.0, other: 20.0})
        assert verdicts(RunTables(results)) == {}


def test_surprises_are_what_contradicts_the_expectation(factors: RunTables) -> None:
    said = surprises(matrix(factors, differences(factors.rows), "novel_view"))
    assert [text.partition(":")[0] for text in said] == [
        "skinned, w/o mot.",
        "swing, w/o mot.",
        "turning, w/o heading normalised",
    ]
    assert said[0].endswith("better, although the scene should not need it.")
    assert said[1].endswith("equivalent, although the scene should need it.")
    assert said[2].endswith("worse, although the scene should need it.")


def test_a_scene_of_all_phenomena_may_need_components_that_are_not_expected_of_it() -> None:
    loose = run("loose", {"ash": 27.0, "unlearned": 27.0, "wo_disp": 25.0})
    tables = RunTables(loose + run("skinned", {"ash": 27.0, "wo_disp": 27.0}))
    (said,) = surprises(matrix(tables, differences(tables.rows), "novel_view"))
    assert said.startswith("loose, skinned template") and said.endswith("although the scene should need it.")


def test_a_surprise_names_the_control_scene_where_it_was_run() -> None:
    base = {"ash": 27.0, "wo_mot": 26.0, "wo_disp": 27.0}
    shown = run("skinned", base) + run("wrinkles", base)
    tables = RunTables([*shown, *run("overcast", base | {"wo_mot": 26.9})])
    said = surprises(matrix(tables, differences(tables.rows), "novel_view"))
    assert "Control scene overcast, under an even sky, where no lamp casts shadows: +0.10 dB" in said[0]


def test_what_a_scene_should_need_and_is_unclear_says_how_many_people_would_decide() -> None:
    unclear = people({"ash": (27.0, 29.0, 31.0), "wo_mot": (26.8, 28.1, 31.2)}, scene="wrinkles")
    tables = RunTables(unclear + run("swing", {"ash": 27.0, "wo_mot": 26.0}))
    (sentence,) = undecided(matrix(tables, differences(tables.rows), "novel_view"))
    assert sentence.startswith("wrinkles, w/o mot.: +0.30 dB [") and sentence.endswith(" people would decide.")
    said = [item for bullets in blocks_of(sections.ablations(tables), Bullets) for item in bullets.items]
    assert sentence in said
    seeds = people({"ash": (27.0,), "wo_mot": (26.9,)}, (0.0, 0.5, -0.5), scene="wrinkles")
    single = RunTables(seeds + run("swing", {"ash": 27.0, "wo_mot": 26.0}))
    assert undecided(matrix(single, differences(single.rows), "novel_view")) == [], (
        "seeds of one person say nothing of others"
    )


def test_what_a_scene_needs_more_than_the_one_without_its_phenomenon_is_paired_by_person() -> None:
    """People differ by more than the scenes do: 0.5, 0.6 and 0.7 dB more on `wrinkles` than on `skinned`."""
    ash = (27.0, 29.0, 31.0)
    results = people({"ash": ash, "wo_disp": (26.0, 25.0, 31.0)}, scene="skinned")
    results += people({"ash": ash, "wo_disp": (25.5, 24.4, 30.3)}, scene="wrinkles")
    found = more_than_without(load(results), "wrinkles", "wo_disp", "novel_view")
    half = 4.303 * 0.1 / 3**0.5  # t(2) is 4.303
    assert found == f"+0.60 dB [+{0.6 - half:.2f}, +{0.6 + half:.2f}]"
    broken = [*results[:-1], failed_result(results[-1].config, "crashed", "boom")]
    assert more_than_without(load(broken), "wrinkles", "wo_disp", "novel_view") == ""
    assert more_than_without(load(results), "skinned", "wo_disp", "novel_view") == ""
    assert more_than_without(load(results), "wrinkles", "wo_mot", "novel_view") == ""
    page = sections.ablations(RunTables(results))
    (sentence,) = [s for bullets in blocks_of(page, Bullets) for s in bullets.items if "More than at 0" in s][:1]
    assert sentence.endswith(f" More than at 0, on the people of both: {found} at 1.")


def test_an_addition_is_missed_more_where_it_gains_more() -> None:
    results = people({"ash": (27.0, 29.0), "plus_light": (27.0, 29.2)}, scene="skinned")
    results += people({"ash": (27.0, 29.0), "plus_light": (28.0, 30.2)}, scene="lit")
    assert more_than_without(load(results), "lit", "plus_light", "novel_view") == "+1.00 dB [+1.00, +1.00]"


def test_loss_by_strength(factors: RunTables) -> None:
    table = strength_curves(factors.rows, "novel_view")
    wrinkles = table[table["scene"] == "wrinkles"]
    assert wrinkles["strength"].tolist() == [0.0, 0.5, 1.0, 2.0]
    assert wrinkles["mean"].tolist() == pytest.approx([1.0, 0.6, 1.5, 3.0], abs=0.01)
    assert set(table["scene"]) == {"wrinkles", "swing", "turning", "glossy"}
    rows, levels = factors.rows, {"ash": 27.0, "wo_mot": 26.4}
    fewer = pd.concat([rows[rows["scene"] != "wrinkles_half"], load(run("wrinkles_half", levels, dither=DITHER[:2]))])
    on_all = [27.0 - level - sum(DITHER[:2]) / 2 for level in (26.0, 26.4, 25.5, 24.0)]
    of_wrinkles = strength_curves(fewer, "novel_view").query("scene == 'wrinkles'")
    assert of_wrinkles["mean"].tolist() == pytest.approx(on_all, abs=1e-4), "of the two people who are on all four"


def blocks_of(found: list[Section], kind: type) -> list:
    return [block for section in found for block in section.blocks if isinstance(block, kind)]


def test_the_report_shows_the_matrix_its_surprises_and_the_strengths(factors: RunTables) -> None:
    found = sections.ablations(factors)
    figures = {figure.name: figure for figure in blocks_of(found, Figure)}
    assert list(figures) == ["needs_novel_view", "needs_novel_pose", "strength_novel_view", "strength_novel_pose"]
    drawn = ElementTree.fromstring(figures["needs_novel_view"].svg())
    text = "".join(drawn.itertext())
    assert "+1.50" in text and "1.5 to 1.5" in text and "SH 0" in text
    framed = [path for path in drawn.iter("{http://www.w3.org/2000/svg}path") if path.get("stroke-width") == "2.5"]
    assert len(framed) == 5 and "Framed" in figures["needs_novel_view"].caption
    assert "wrinkles" in "".join(ElementTree.fromstring(figures["strength_novel_view"].svg()).itertext())
    said = [item for bullets in blocks_of(found, Bullets) for item in bullets.items]
    assert any(item.startswith("swing, w/o mot.: +0.00 dB [") for item in said)
    assert any("at 2; the loss does not rise with every step of strength." in item for item in said)


def test_without_an_interval_there_is_no_matrix_but_a_sentence() -> None:
    levels = {"ash": 27.0, "wo_mot": 26.0}
    single = run("still", levels, dither=(0.0,)) + run("swing", levels, dither=(0.0,))
    (section,) = sections.ablations(RunTables(single))
    assert section.title == "Components by scene" and section.blocks == (Text(text=sections.ONE_VALUE),)
    one_interval = run("still", levels) + run("swing", levels, dither=(0.0,))
    assert len(blocks_of(sections.ablations(RunTables(one_interval)), Figure)) == 2
    fallen = [failed_result(r.config, "crashed", "") if r.config.method == "wo_mot" else r for r in single]
    assert sections.ablations(RunTables(fallen)) == []


def test_the_smallest_sufficient_row_and_one_that_other_subjects_chose() -> None:
    levels = {"ash": 27.0, "wo_mot": 26.95, "mlp": 26.9, "ddc": 24.0, "ash_truth": 30.0}
    there = RunTables(run("tight", levels))
    assert sections.ablations(there) == [], "of a single scene its opening says it"
    (section,) = sections.ablations(there, there)
    assert isinstance(table := section.blocks[0], Table)
    assert list(table.frame.index) == ["tight", "tight"]
    assert table.frame.iloc[0].tolist()[:4] == ["Novel view", "ASH", "12.0", "2M"], "of equal costs the first"
    judged = {table.title: table for table in blocks_of(sections.ablations(there, there), Table)}
    texts = judged["Chosen on subjects for validation"].frame.iloc[0].tolist()
    assert texts[:3] == ["Novel view", "ASH", "ASH"] and texts[4] == "equivalent"
    (section,) = sections.ablations(there, RunTables(run("loose", levels)))
    assert section.blocks[-1] == Text(text=sections.NOT_CHOSEN)


def test_the_suite_has_a_row_for_every_expected_component() -> None:
    suite = find_suite("factors")
    rows = {row.name for row in suite.methods}
    assert {row for name in FACTORS for row in EXPECTED[name] if not row.startswith("sh_")} <= rows
    assert set(EXPECTED) - {"loose"} <= {scene.name for scene in suite.scenes}
    ran = {scene.name: scene.methods for scene in suite.scenes}
    assert all("ash" in ran[name] for name in (*FACTORS, "skinned", "still", "splats"))
    assert all({row, "ash"} <= {*ran[control]} for (_, row), (control, _) in CONTROL_SCENES.items())
    others = {row for row in COMPONENTS if not row.startswith("sh_")}
    assert others <= set(ran["skinned"]), "where no component should be needed, all are removed"
    captures = {capture.scene: described(capture) for capture in suite.captures if capture.subject == 0}
    for name, scene in captures.items():
        assert scene.rig.cameras - scene.rig.held_out >= 16 and min(scene.rig.width, scene.rig.height) >= 192, name
    assert {f"{factor}_half" for factor in FACTORS} <= set(captures)


@pytest.mark.parametrize(("mlp", "decoders"), [("mlp_6_min", "ash_6_min"), ("mlp_base_6_min", "plus_base_6_min")])
def test_the_mlp_is_trained_as_the_decoders_and_as_long(mlp: str, decoders: str) -> None:
    suite = find_suite("mlp")
    rows = {row.name: configured(row.of, suite.preset, row.changes) for row in suite.methods}
    assert rows[decoders].training.seconds == 360 and rows[decoders].model.base == ("base" in mlp)
    half = replace(rows[decoders].training, precision="bfloat16")
    assert rows[mlp] == replace(rows[decoders], training=half)
