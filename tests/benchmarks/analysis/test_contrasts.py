"""Differences over captures: how often they cry wolf, and what they could have found."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers.cells import cell
from scipy import stats

from benchmarks.analysis.contrasts import candidates, contrasts, detectable_effects, difference
from benchmarks.analysis.scores import COLUMNS, Scores, scores_of
from benchmarks.analysis.statistics import detectable
from benchmarks.cell.cells import CellResult, Summary
from benchmarks.report import differences
from benchmarks.report.content import Table, Text

ROUNDS, TABLES = 600, 200
PSNR = ("novel_view", "foreground", "psnr")


def people(levels: dict[str, tuple[float, ...]], seeds: tuple[float, ...] = (0.0,)) -> list[CellResult]:
    """A cell per method, subject and seed; `seeds` are what each adds to the subject's level."""
    found = []
    for method, own in levels.items():
        for subject, level in enumerate(own):
            for seed, luck in enumerate(seeds):
                result = cell(method, level + luck, seed=seed)
                found.append(replace(result, config=replace(result.config, subject=subject)))
    return found


def null_run(rng: np.random.Generator, *, captures: int, seeds: int, methods: tuple[str, ...], rounds: int) -> Scores:
    """Scenes on which no method is better than another: captures differ by 3 dB, methods on a capture by chance."""
    rows = [
        (f"scene{index}", method, seed, *PSNR, value, "dB", "up", "2", subject, str(subject))
        for index in range(rounds)
        for subject, level in enumerate(rng.normal(25, 3, captures))
        for method in methods
        for luck in [rng.normal(0, 0.2)]
        for seed, value in enumerate(level + luck + rng.normal(0, 0.15, seeds))
    ]
    return Scores(pd.DataFrame(rows, columns=list(COLUMNS)).assign(axis="", severity=0.0, status="done"))


@pytest.mark.parametrize(("captures", "seeds"), [(8, 1), (4, 2), (1, 3)])
def test_false_alarms_are_at_most_five_percent(captures: int, seeds: int) -> None:
    """On one capture a method's own luck there is part of the truth: seeds alone may differ."""
    scores = null_run(
        np.random.default_rng(captures), captures=captures, seeds=seeds, methods=("ash", "ddc"), rounds=ROUNDS
    )
    tests = [difference(scores, scene, "ash", "ddc", "novel_view") for scene in scores.scenes]
    alarms = sum(test is not None and test.p < 0.05 for test in tests)
    if captures == 1:
        assert alarms / ROUNDS > 0.2, "seeds of one capture say nothing about the next: the reason for several"
    else:
        assert stats.binomtest(alarms, ROUNDS, 0.05, alternative="greater").pvalue > 0.01, alarms / ROUNDS
        assert alarms / ROUNDS > 0.02, "a test that never alarms is none"


def test_a_table_of_contrasts_keeps_the_level_over_all_its_rows() -> None:
    methods = ("ash", "ddc", "mlp", "static", "wo_mot")
    scores = null_run(np.random.default_rng(9), captures=8, seeds=1, methods=methods, rounds=TABLES)
    wolves = sum(any(c.significant for c in contrasts(scores, scene)) for scene in scores.scenes)
    assert stats.binomtest(wolves, TABLES, 0.05, alternative="greater").pvalue > 0.01, wolves / TABLES


def test_a_method_is_compared_on_the_captures_that_both_have() -> None:
    results = people({"ash": (20.0, 25.0, 31.0, 40.0), "ddc": (19.5, 24.7, 30.6)}, seeds=(0.0, 0.2))
    found = difference(scores_of(results), "loose", "ash", "ddc", "novel_view")
    assert found is not None and found.pairs == 3 and found.mean == pytest.approx(0.4)
    by_hand = stats.ttest_rel([20.1, 25.1, 31.1], [19.6, 24.8, 30.7])
    assert found.p == pytest.approx(by_hand.pvalue)


def test_methods_compete_on_the_captures_that_all_have() -> None:
    results = people({"ash": (20.0, 25.0, 40.0), "ddc": (19.5, 24.7)})
    frame = Summary(split="speed", region="", metric="frame_ms", value=5.0)
    scores = scores_of([replace(result, summary=(*result.summary, frame)) for result in results])
    assert [c.quality for c in candidates(scores, "loose", "novel_view")] == [22.5, pytest.approx(22.1)]


def test_what_more_captures_would_show_follows_from_the_spread_over_captures() -> None:
    levels = {"ash": (20.0, 25.0, 30.0, 35.0), "ddc": (19.0, 24.2, 29.2, 34.0), "mlp": (18.0, 25.0, 27.0, 30.0)}
    found = contrasts(scores_of(people(levels)), "loose")
    seen = detectable_effects(found, "novel_view")
    assert [effect.captures for effect in seen] == [1, 2, 4, 8, 16] and math.isinf(seen[0].middle)
    assert seen[2].worst == pytest.approx(found[1].test.detectable)
    spreads = [np.std(np.subtract(levels["ash"], levels[name]), ddof=1) for name in ("ddc", "mlp")]
    assert seen[3].middle == pytest.approx(detectable(float(np.mean(spreads)), 8))


def test_a_report_says_what_was_compared_and_what_could_be_seen() -> None:
    many = scores_of(people({"ash": (20.0, 25.0, 30.0), "ddc": (19.0, 24.2, 29.2)}))
    (section,) = differences.sections(many, "loose", contrasts(many, "loose"))
    tables = [block for block in section.blocks if isinstance(block, Table)]
    assert tables[0].columns[2].unit == "captures, paired t"
    assert tables[1].rows[0].entries[0].text == "none"
    assert "Smallest detectable difference to ASH, middle row: 0." in differences.note(
        many, "loose", contrasts(many, "loose")
    )
    assert "3 captures, compared in pairs" in differences.note(many, "loose", contrasts(many, "loose"))
    one = scores_of(people({"ash": (20.0,), "ddc": (19.0,)}, seeds=(0.0, 0.1, 0.3)))
    (section,) = differences.sections(one, "loose", contrasts(one, "loose"))
    (table,) = (block for block in section.blocks if isinstance(block, Table))
    assert table.columns[2].unit == "seeds, Welch" and isinstance(section.blocks[-1], Text)
    assert "nothing about other people" in differences.note(one, "loose", contrasts(one, "loose"))
    alone = scores_of(people({"ash": (20.0,), "ddc": (19.0,)}))
    assert differences.sections(alone, "loose", contrasts(alone, "loose")) == [], "so few rows are read in their table"
    levels = {"ash": (20.0,), "ddc": (19.0,), "mlp": (17.5,), "wo_mot": (19.8,), "res_128": (20.1,), "res_64": (18.0,)}
    (section,) = differences.sections(scores_of(people(levels)), "loose", ())
    (chart,) = section.blocks
    drawn = chart.figure.svg()
    assert chart.figure.name == "effects_loose" and "one seed: no interval" in drawn
    assert drawn.index("w/ MLP") < drawn.index("DDC") < drawn.index("w/o mot."), "by what ASH is ahead"
    assert (
        differences.note(alone, "loose", contrasts(alone, "loose"))
        == "One value per row: no difference between rows is established."
    )
