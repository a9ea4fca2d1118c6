"""What each scene needs: verdicts, surprises and doses on numbers that are known, and the picture of them."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from helpers.cells import cell
from scipy import stats

from benchmarks.analysis.ablation_matrix import (
    EXPECTED,
    EXPERIMENTS,
    ON_TRIAL,
    AblationEffect,
    Matrix,
    Part,
    corrected,
    doses,
    matrix,
)
from benchmarks.analysis.scores import Scores, scores_of
from benchmarks.analysis.statistics import Difference, paired
from benchmarks.cell.cells import CellResult, Summary, failed_result
from benchmarks.cell.methods import offered
from benchmarks.report import needs
from benchmarks.report.content import Bullets, Chart, Section, Table, Text
from benchmarks.suites.captures import described
from benchmarks.suites.files import find_suite
from synth.presets import RUNGS, rung

PART = Part(row="wo_mot", within="ash", without="wo_mot")
DITHER = (0.0, 0.03, -0.02)  # of three subjects


def people(scene: str, levels: dict[str, float], *, dither: tuple[float, ...] = DITHER) -> list[CellResult]:
    """Three subjects, 2 dB apart; what a method loses differs a little from one to the next."""
    costs = (("speed", "frame_ms", 12.0), ("memory", "params", 2e6))
    rows = tuple(Summary(split=split, region="", metric=metric, value=value) for split, metric, value in costs)
    found = []
    for index, (method, level) in enumerate(levels.items()):
        for subject, shift in enumerate(dither):
            result = cell(method, level + 2 * subject + (shift if index else 0.0))
            config = replace(result.config, scene=scene, subject=subject)
            found.append(replace(result, config=config, summary=(*result.summary, *rows)))
    return found


@pytest.fixture
def ladder() -> Scores:
    """Motion is needed on `wrinkles` and `skinned`, not on `swing`; without a heading `turning` is better off."""
    base = {"ash": 27.0, "wo_mot": 27.0, "wo_heading": 27.0, "sh_3": 27.0, "sh_1": 27.0, "ash_truth": 30.0}
    results = people("skinned", base | {"wo_mot": 26.0})
    results += people("wrinkles_half", base | {"wo_mot": 26.4}) + people("wrinkles", base | {"wo_mot": 25.5})
    results += people("wrinkles_twice", base | {"wo_mot": 24.0}) + people("swing", base)
    results += people("turning", base | {"wo_heading": 27.5}) + people("glossy", base | {"sh_3": 28.0, "sh_1": 27.9})
    return scores_of(results)


def view(scores: Scores) -> Matrix:
    found = matrix(scores, "novel_view")
    assert found is not None
    return found


def verdicts(scores: Scores) -> dict[tuple[str, str], str]:
    return {(effect.scene, effect.part.row): effect.verdict for effect in view(scores).effects}


def test_parts_are_the_rows_of_the_run_in_the_order_of_the_expected_diagonal(ladder: Scores) -> None:
    found = view(ladder)
    assert [part.row for part in found.parts] == ["wo_mot", "sh_3", "sh_1", "wo_heading"]
    assert [part.title for part in found.parts][1:3] == ["SH 0, not 3", "SH 1, not 3"]
    assert found.scenes == ("skinned", "wrinkles", "swing", "turning", "glossy"), "doses are no rungs"
    assert len(found.effects) == 4 * 5


def test_verdicts_are_what_the_numbers_allow(ladder: Scores) -> None:
    found = verdicts(ladder)
    assert found["wrinkles", "wo_mot"] == "needed" and found["swing", "wo_mot"] == "not needed"
    assert found["turning", "wo_heading"] == "harmful"
    assert (found["glossy", "sh_3"], found["glossy", "sh_1"]) == ("needed", "not needed"), "against degree 3"
    noisy = people("wrinkles", {"ash": 27.0, "wo_mot": 26.0}, dither=(1.5, -1.5, 0.5))
    noisy += people("swing", {"ash": 27.0, "wo_mot": 26.0})
    assert verdicts(scores_of(noisy))["wrinkles", "wo_mot"] == "unclear"
    single = people("wrinkles", {"ash": 27.0, "wo_mot": 20.0}, dither=(0.0,))
    single += people("swing", {"ash": 27.0, "wo_mot": 26.0}, dither=(0.0,))
    assert set(verdicts(scores_of(single)).values()) == {"unknown"}


def test_degrees_of_colour_are_told_against_the_highest_that_was_run() -> None:
    base = {"ash": 27.0, "sh_1": 27.9, "sh_2": 28.0}
    results = people("skinned", {"ash": 27.0, "wo_mot": 26.0}) + people("glossy", base)
    found = {effect.part.title: effect for effect in view(scores_of(results)).effects if effect.scene == "glossy"}
    assert [title for title in found if title.startswith("SH")] == ["SH 0, not 2", "SH 1, not 2"]
    assert found["SH 0, not 2"].expected and found["SH 0, not 2"].verdict == "needed"
    assert not found["SH 1, not 2"].expected and found["SH 1, not 2"].verdict == "not needed"
    alone = people("skinned", {"ash": 27.0, "wo_mot": 26.0}) + people("glossy", {"ash": 27.0, "sh_1": 27.9})
    told = {effect.part.title: effect for effect in view(scores_of(alone)).effects if effect.scene == "glossy"}
    assert told["SH 0, not 1"].expected and told["SH 0, not 1"].verdict == "needed"


def test_one_scene_or_no_part_makes_no_matrix() -> None:
    assert matrix(scores_of(people("still", {"ash": 27.0, "wo_mot": 26.0})), "novel_view") is None
    alone = people("still", {"ash": 27.0, "ash_truth": 30.0}) + people("swing", {"ash": 27.0, "static": 20.0})
    assert matrix(scores_of(alone), "novel_view") is None
    rivals = people("still", {"ash": 27.0, "ddc": 30.0}) + people("swing", {"ash": 27.0, "ddc": 20.0})
    assert matrix(scores_of(rivals), "novel_view") is None


def test_a_part_that_was_not_run_on_a_scene_is_unknown_there() -> None:
    results = people("still", {"ash": 27.0, "wo_mot": 26.0}) + people("swing", {"ash": 27.0, "wo_phi": 26.0})
    found = {(effect.scene, effect.part.row): effect for effect in view(scores_of(results)).effects}
    assert found["still", "wo_phi"].loss is None and found["still", "wo_phi"].verdict == "unknown"
    assert found["still", "wo_phi"].surprise == ""


def test_surprises_are_what_contradicts_the_expected_diagonal(ladder: Scores) -> None:
    told = [effect.surprise for effect in view(ladder).effects if effect.surprise]
    assert [text.partition(":")[0] for text in told] == ["skinned, w/o mot.", "swing, w/o mot.", "turning, w/o heading"]
    assert told[0].endswith("needed though nothing in the scene asks for it.")
    assert told[1].endswith("not needed where it should be needed.")
    assert told[2].endswith("harmful where it should be needed.")


def test_a_surprise_names_the_experiment_that_explains_it_where_it_was_run() -> None:
    base = {"ash": 27.0, "wo_mot": 26.0, "wo_disp": 27.0}
    shown = people("skinned", base) + people("wrinkles", base)
    run = [*shown, *people("overcast", base | {"wo_mot": 26.9}), *people("wrinkles_twice", base | {"wo_disp": 25.0})]
    told = {
        effect.surprise.partition(":")[0]: effect.surprise for effect in view(scores_of(run)).effects if effect.surprise
    }
    assert "asks for it. By experiment, under an even sky" in told["skinned, w/o mot."]
    assert "+0.10 dB" in told["skinned, w/o mot."].partition("(overcast)")[2]
    assert "+2.00 dB" in told["wrinkles, w/o disp."].partition("(wrinkles_twice)")[2]
    assert not any("experiment" in effect.surprise for effect in view(scores_of(shown)).effects)
    ladder = {scene.name: set(scene.methods) for scene in find_suite("ladder").scenes}
    assert all({part, "ash"} <= ladder[place] for (_, part), (place, _) in EXPERIMENTS.items()), "our suite runs them"


def test_significance_is_corrected_over_all_cells_as_by_hand() -> None:
    def need(p: float) -> AblationEffect:
        loss = Difference(mean=1.0, low=0.5, high=1.5, p=p, spread=1.0, effect=1.0, detectable=1.0)
        return AblationEffect(scene="wrinkles", part=PART, loss=loss)

    empty = AblationEffect(scene="swing", part=PART, loss=None)
    found = corrected([need(0.04), empty, need(0.01), need(math.nan), need(0.9)])
    assert [each.p_adjusted for each in found[::2]] == pytest.approx([0.06, 0.03, 0.9])
    assert math.isnan(found[1].p_adjusted) and math.isnan(found[3].p_adjusted)
    assert [each.verdict for each in found[::2]] == ["unclear", "needed", "unclear"]


def test_a_matrix_of_chance_cries_wolf_in_one_of_twenty_cases_at_most() -> None:
    rng, rounds, wolves = np.random.default_rng(7), 120, 0
    for _ in range(rounds):
        losses = [paired(list(rng.normal(0, 0.6, 4)), [0.0] * 4) for _ in range(30)]
        cells = corrected([AblationEffect(scene="still", part=PART, loss=loss) for loss in losses])
        wolves += any(each.verdict in ("needed", "harmful") for each in cells)
    assert stats.binomtest(wolves, rounds, 0.05, alternative="greater").pvalue > 0.01, wolves / rounds


def test_a_part_is_needed_more_where_there_is_more_of_its_phenomenon(ladder: Scores) -> None:
    (course,) = [dose for dose in doses(ladder, "novel_view") if dose.scene == "wrinkles"]
    assert [strength for strength, _ in course.losses] == [0.0, 0.5, 1.0, 2.0]
    assert [loss.mean for _, loss in course.losses] == pytest.approx([1.0, 0.6, 1.5, 3.0], abs=0.01)
    assert not course.rises and replace(course, losses=course.losses[1:]).rises
    assert {dose.scene for dose in doses(ladder, "novel_view")} == {"wrinkles", "swing", "turning", "glossy"}
    assert doses(scores_of(people("loose", {"ash": 27.0, "unlearned": 26.0})), "novel_view") == ()


def blocks_of(sections: list[Section], kind: type) -> list:
    return [block for section in sections for block in section.blocks if isinstance(block, kind)]


def test_the_matrix_is_a_picture_with_the_expected_cells_framed(ladder: Scores) -> None:
    sections = needs.sections(ladder)
    figures = {chart.figure.name: chart.figure for chart in blocks_of(sections, Chart)}
    assert list(figures) == ["needs_novel_view", "needs_novel_pose", "doses_novel_view", "doses_novel_pose"]
    drawn = ElementTree.fromstring(figures["needs_novel_view"].svg())
    text = "".join(drawn.itertext())
    assert "+1.50" in text and "1.5 to 1.5" in text and "SH 0, not 3" in text
    framed = [path for path in drawn.iter("{http://www.w3.org/2000/svg}path") if path.get("stroke-width") == "2.5"]
    expected = sum(effect.expected for effect in view(ladder).effects)
    assert len(framed) == expected == 5 - 1
    assert "Framed" in figures["needs_novel_view"].caption
    assert figures["needs_novel_view"].specs()[0]["width"] == "container"
    assert "wrinkles" in "".join(ElementTree.fromstring(figures["doses_novel_view"].svg()).itertext())


def test_where_nothing_is_expected_no_frame_is_told_of() -> None:
    levels = {"ash": 27.0, "wo_mot": 26.0, "wo_offset": 25.0}
    scores = scores_of(people("tight", levels) + people("loose", levels))
    captions = [chart.figure.caption for chart in blocks_of(needs.sections(scores), Chart)]
    assert captions and not any("Framed" in caption for caption in captions)


def test_without_an_interval_there_is_no_matrix_but_a_sentence() -> None:
    levels = {"ash": 27.0, "wo_mot": 26.0}
    single = people("still", levels, dither=(0.0,)) + people("swing", levels, dither=(0.0,))
    (section,) = needs.sections(scores_of(single))
    (told,) = section.blocks
    words = "One seed on one capture: what is needed cannot be told; --seeds 3 or --subjects 8 can."
    assert section.title == "What each scene needs" and told == Text(text=words)
    one_interval = people("still", levels) + people("swing", levels, dither=(0.0,))
    assert len(blocks_of(needs.sections(scores_of(one_interval)), Chart)) == 2
    rivals = people("still", {"ash": 27.0, "ddc": 26.0}, dither=(0.0,)) + people("swing", levels, dither=(0.0,))[:1]
    assert needs.sections(scores_of(rivals)) == [], "no part to judge"
    fallen = [failed_result(r.config, "crashed", "") if r.config.method == "wo_mot" else r for r in single]
    assert needs.sections(scores_of(fallen)) == [], "no loss to judge"


def test_the_report_tells_surprises_and_doses_in_words(ladder: Scores) -> None:
    sections = needs.sections(ladder)
    said = [item for bullets in blocks_of(sections, Bullets) for item in bullets.items]
    assert any(item.startswith("swing, w/o mot.: +0.00 dB [") for item in said)
    assert any("at 2; it does not rise with every dose." in item for item in said)
    texts = [text.text for text in blocks_of(sections, Text)]
    tried = (
        "On held-out views, of 4 parts that were tried where they should be needed, 2 are needed, 2 are not, and of 0"
    )
    assert any(text.startswith(tried) and text.endswith("Surprises:") for text in texts)
    table = next(table for table in blocks_of(sections, Table) if table.title == "Novel view")
    assert table.rows[1].name == "wrinkles" and table.rows[1].entries[0].mark == "best"
    assert table.rows[1].entries[0].text.endswith("needed")


def test_the_smallest_that_suffices_is_told_where_there_is_a_choice() -> None:
    levels = {
        "ash": 27.0,
        "wo_mot": 26.95,
        "mlp": 26.9,
        "ddc": 24.0,
        "res_128": 26.0,
        "wo_phi": 26.9,
        "ash_truth": 30.0,
    }
    frames = {"wo_mot": 5.0, "ddc": 2.0}
    results = people("tight", levels)

    def timed(result: CellResult) -> CellResult:
        rows = tuple(
            replace(row, value=frames.get(result.config.method, row.value)) if row.metric == "frame_ms" else row
            for row in result.summary
        )
        return replace(result, summary=rows)

    scores = scores_of(list(map(timed, results)))
    (section,) = needs.sections(scores)
    table = section.blocks[0]
    assert isinstance(table, Table) and [row.name for row in table.rows] == ["tight", "tight"]
    texts = [entry.text for entry in table.rows[0].entries]
    assert texts[:4] == ["Novel view", "w/o mot.", "5.0", "2M"] and texts[5:7] == ["ASH", "12.0"]
    assert texts[7] == "0.05, 3 of 3", "what w/o mot. lacks, on each person left out"
    assert 0.04 < float(texts[4]) < 0.2
    assert needs.sections(scores_of(people("tight", {"ash": 27.0, "wo_mot": 26.9}))) == []
    here = scores_of(list(map(timed, people("tight", levels | {"wo_mot": 26.0}))))
    judged = {table.title: table for table in blocks_of(needs.sections(here, scores), Table)}
    texts = [entry.text for entry in judged["Chosen on people for validation"].rows[0].entries]
    assert texts[:3] == ["Novel view", "w/o mot.", "ASH"] and texts[3].startswith("1.00 [") and texts[4] == "too little"
    (section,) = needs.sections(scores, scores_of(people("loose", levels)))
    assert section.blocks[:-1] == needs.sections(scores)[0].blocks and "nothing was chosen" in section.blocks[-1].text


def test_the_ladder_has_a_row_for_every_expected_part_and_doses_of_known_strength() -> None:
    suite = find_suite("ladder")
    rows = {row.name for row in suite.methods}
    assert {row for name in ("splats", "skinned", *RUNGS) for row in EXPECTED[name]} <= rows
    assert set(EXPECTED) - {"loose"} <= {scene.name for scene in suite.scenes}
    captures = {capture.scene: described(capture) for capture in suite.captures if capture.subject == 0}
    for name, scene in captures.items():
        assert scene.rig.cameras - scene.rig.held_out >= 16 and min(scene.rig.width, scene.rig.height) >= 192, name
    for of, ending, strength in [(of, *dose) for of in RUNGS for dose in (("_half", 0.5), ("_twice", 2.0))]:
        if f"{of}{ending}" in captures:
            expected = rung(of, size="rung", strength=strength)
            assert replace(captures[f"{of}{ending}"], name=of) == expected
            (dose,) = [scene for scene in suite.scenes if scene.name == f"{of}{ending}"]
            assert dose.methods == ("ash", *EXPECTED[of]), "what the doses of its report ask for, and no more"
    ran = {scene.name: scene.methods for scene in suite.scenes}
    assert all({"ash", *EXPECTED[name]} <= set(ran[name]) for name in (*RUNGS, "skinned", "still", "splats"))
    assert set(ON_TRIAL) <= set(ran["skinned"]), "where no part should be needed, all are tried"
    assert {f"{of}_half" for of in RUNGS} <= set(captures)


def test_the_mlp_with_a_learned_base_is_ash_but_for_its_decoders() -> None:
    suite = find_suite("table")
    (mlp,) = [row for row in suite.methods if row.name == "mlp_base"]
    assert not mlp.changes and offered(mlp.name, suite.preset) == offered("ash", suite.preset)
