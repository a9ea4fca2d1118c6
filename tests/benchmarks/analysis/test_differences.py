"""Differences over captures: their false alarms, and how they are shown."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from helpers.cells import cell, people
from scipy import stats

from benchmarks.analysis.differences import differences
from benchmarks.analysis.pareto import candidates
from benchmarks.analysis.results import COLUMNS, RunTables, compare, foreground, load
from benchmarks.cell.schema import failed_result
from benchmarks.report.content import Table
from benchmarks.report.scene import difference_tables

ROUNDS, TABLES = 300, 80


def null_rows(rng: np.random.Generator, *, captures: int, seeds: int, methods: tuple[str, ...]) -> pd.DataFrame:
    """A scene on which no method is better: captures differ by 3 dB, methods on a capture by chance."""
    rows = [
        ("scene", method, seed, *foreground(), value, "dB", "up", "2", subject, str(subject))
        for subject, level in enumerate(rng.normal(25, 3, captures))
        for method in methods
        for luck in [rng.normal(0, 0.2)]
        for seed, value in enumerate(level + luck + rng.normal(0, 0.15, seeds))
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS)).assign(axis="", severity=0.0, status="done")


@pytest.mark.parametrize(("captures", "seeds"), [(8, 1), (4, 2)])
def test_false_alarms_are_at_most_five_percent(captures: int, seeds: int) -> None:
    rng = np.random.default_rng(captures)
    runs = (null_rows(rng, captures=captures, seeds=seeds, methods=("ash", "ddc")) for _ in range(ROUNDS))
    tests = [compare(rows, "ash", "ddc", foreground()) for rows in runs]
    alarms = sum(test is not None and test.significant for test in tests)
    assert stats.binomtest(alarms, ROUNDS, 0.05, alternative="greater").pvalue > 0.01, alarms / ROUNDS
    assert alarms / ROUNDS > 0.02, "a test that never alarms is none"


def test_a_table_of_differences_keeps_the_level_over_all_its_rows() -> None:
    rng = np.random.default_rng(9)
    alarms = 0
    for _ in range(TABLES):
        captures = rng.normal(25, 3, 8)
        levels = {m: captures + rng.normal(0, 0.2, 8) for m in ("ash", "ddc", "mlp", "static", "wo_mot")}
        results = people({m: own.tolist() for m, own in levels.items()})
        tables = RunTables([replace(result, summary=result.summary[:2]) for result in results])  # of PSNR alone
        alarms += bool((differences(tables.rows)["p"] < 0.05).any())
    assert stats.binomtest(alarms, TABLES, 0.05, alternative="greater").pvalue > 0.01, alarms / TABLES


def test_a_method_is_compared_on_the_captures_that_both_have() -> None:
    tables = RunTables(people({"ash": (20.0, 25.0, 31.0, 40.0), "ddc": (19.5, 24.7, 30.6)}, seeds=(0.0, 0.2)))
    found = compare(tables.of("loose"), "ash", "ddc", foreground())
    assert found is not None and found.captures == 3 and found.mean == pytest.approx(0.4)
    assert found.p == pytest.approx(stats.ttest_rel([20.1, 25.1, 31.1], [19.6, 24.8, 30.7]).pvalue)


def test_a_failed_method_is_compared_with_nobody() -> None:
    results = people({"ash": (20.0, 25.0), "ddc": (19.5, 24.7)})
    results[-1] = failed_result(results[-1].config, "crashed", "boom")
    assert not len(differences(load(results)))


def test_methods_compete_on_the_captures_that_all_have() -> None:
    tables = RunTables(people({"ash": (20.0, 25.0, 40.0), "ddc": (19.5, 24.7)}))
    assert [c.psnr for c in candidates(tables, "loose", "novel_view")] == [22.5, pytest.approx(22.1)]


def test_a_report_says_what_was_compared_and_what_could_be_found() -> None:
    many = RunTables(people({"ash": (20.0, 25.0, 30.0), "ddc": (19.0, 24.2, 29.2)}))
    ranked = differences(many.rows)
    (main,) = (b for b in difference_tables(many, "loose", ranked, title="") if isinstance(b, Table))
    assert list(main.frame.columns)[1:4] == ["verdict", "difference [dB]", "95 % interval [people, paired t]"]
    assert main.frame.index[0] == "DDC" and main.frame["verdict"].tolist() == ["better", "better"]
    assert "people needed" not in main.frame
    apart = RunTables(people({"ash": (20.0, 25.0, 30.0), "ddc": (19.0, 24.2, 29.2), "mlp": (18.0, 25.5, 29.0)}))
    (main,) = (b for b in difference_tables(apart, "loose", differences(apart.rows), title="") if isinstance(b, Table))
    unclear = main.frame["verdict"] == "unclear"
    assert unclear.any() and (main.frame["people needed"].ne("") == unclear).all()
    assert main.frame.loc[unclear, "people needed"].astype(int).ge(4).all()
    one = RunTables(people({"ash": (20.0,), "ddc": (19.0,)}, seeds=(0.0, 0.1, 0.3)))
    (main,) = (b for b in difference_tables(one, "loose", differences(one.rows), title="") if isinstance(b, Table))
    assert list(main.frame.columns)[3] == "95 % interval [seeds, Welch]"
    single = RunTables([cell("ash", 20.0), cell("ddc", 19.0)])
    assert difference_tables(single, "loose", differences(single.rows), title="") == []
