import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from benchmarks.analysis.statistics import (
    Comparison,
    Samples,
    compare_samples,
    corrected,
    detectable,
    holm,
    independent,
    intervals,
    mean_interval,
    on_all_captures,
    spreads,
    wilson,
)


def seeds(*values: float) -> Samples:
    """Values of one capture."""
    return {"a": values}


def captures(*values: float) -> Samples:
    """A value for each capture."""
    return {f"{k}": (value,) for k, value in enumerate(values)}


def compared(a: Samples, b: Samples, **options: float) -> Comparison:
    found = compare_samples(a, b, **options)
    assert found is not None
    return found


def power_of_80_percent(freedom: int) -> float:
    critical = stats.t.ppf(0.975, freedom)
    return float(optimize.brentq(lambda d: stats.nct.sf(critical, freedom, d) - 0.8, 0.1, 20))


def test_seeds_of_one_capture_are_compared_by_welchs_test_and_captures_in_pairs_as_by_scipy() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(27.3, 0.2, 4), rng.normal(27.0, 0.5, 4)
    for found, expected in (
        (compared(seeds(*a), seeds(*b)), stats.ttest_ind(a, b, equal_var=False)),
        (compared(captures(*a), captures(*b)), stats.ttest_rel(a, b)),
    ):
        interval = expected.confidence_interval()
        assert (found.p, found.low, found.high) == pytest.approx((expected.pvalue, *interval), rel=1e-10)
    assert compared(captures(*a), captures(*b)).captures == 4 and compared(seeds(*a), seeds(*b)).captures == 0
    narrow = compared(captures(*a), captures(*b), level=0.9)
    assert narrow.low == pytest.approx(stats.ttest_rel(a, b).confidence_interval(0.9).low)


def test_captures_that_both_have_are_compared_and_their_seeds_are_averaged() -> None:
    a = {"x": [24.0, 26.0], "y": [30.0, 32.0], "z": [28.0, 28.0], "only a": [99.0]}
    b = {"z": [27.5], "y": [30.0], "x": [24.6]}
    found, by_hand = compared(a, b), stats.ttest_rel([25.0, 31.0, 28.0], [24.6, 30.0, 27.5])
    assert found.captures == 3 and (found.mean, found.p) == pytest.approx((1.9 / 3, by_hand.pvalue))
    assert found.spread == pytest.approx(np.std([0.4, 1.0, 0.5], ddof=1))
    assert found.detectable == pytest.approx(detectable(found.spread, 3))
    assert independent(a)[:3] == [25.0, 31.0, 28.0] and independent({"x": [1.0, 2.0]}) == [1.0, 2.0]


def test_one_value_has_no_interval_and_no_common_capture_no_comparison() -> None:
    single = compared(seeds(24.0), seeds(23.0, 23.5))
    assert single.mean == 0.75 and np.isnan([single.low, single.p, single.detectable]).all()
    assert single.verdict == "unclear" and not single.significant
    assert compare_samples({"x": [1.0]}, {"y": [1.0]}) is None


def test_without_any_spread_what_differs_is_significant() -> None:
    assert compared(seeds(1.0, 1.0), seeds(1.0, 1.0)).verdict == "equivalent"
    assert compared(seeds(2.0, 2.0), seeds(1.0, 1.0)).p == 0
    assert compared(captures(2.0, 3.0), captures(1.0, 2.0)).low == 1
    constant = compared(seeds(1.0, 1.0, 1.0), seeds(2.0, 2.1, 2.3))
    assert constant.p == pytest.approx(stats.ttest_1samp([2.0, 2.1, 2.3], 1.0).pvalue), "one side does not vary"
    rounded = compared(seeds(0.1 + 0.2, 0.3), seeds(1.1 + 2.2, 3.3))
    assert (rounded.low, rounded.p) == (rounded.mean, 0.0), "what differs by rounding does not vary"


@pytest.mark.parametrize(
    ("difference", "spread", "margin", "up", "verdict"),
    [
        (1.0, 0.1, 0.1, True, "better"),
        (1.0, 0.1, 0.1, False, "worse"),
        (-1.0, 0.1, 0.1, True, "worse"),
        (1.0, 0.1, 2.0, True, "equivalent"),
        (0.0, 0.1, 0.5, True, "equivalent"),
        (0.0, 0.1, 0.1, True, "unclear"),
        (0.3, 1.0, 0.1, True, "unclear"),
    ],
)
def test_the_verdict_needs_significance_and_the_margin(
    difference: float, spread: float, margin: float, up: bool, verdict: str
) -> None:
    base = np.array([25.0, 30.0, 28.0, 27.0])
    noise = spread * np.array([1.0, -1.0, 0.5, -0.5])
    found = compared(captures(*base + difference + noise), captures(*base), margin=margin, higher_is_better=up)
    assert found.verdict == verdict


def test_holms_correction_by_hand_leaves_out_what_has_no_p() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005, 0.8]) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.8])
    tests = [Comparison(mean=1.0, low=0.5, high=1.5, p=p) for p in (0.04, 0.01, float("nan"), 0.9)]
    found = corrected(tests)
    assert [each.p for each in (*found[:2], found[3])] == pytest.approx([0.08, 0.03, 0.9]) and np.isnan(found[2].p)
    assert [each.verdict for each in found] == ["unclear", "better", "unclear", "unclear"]
    assert [each.tests for each in found] == [3, 3, 1, 3]
    assert [each.p for each in corrected(tests[:2], 5)] == pytest.approx([0.16, 0.05])


def test_false_alarms_and_power_on_our_design() -> None:
    """Images on three seeds each: the test on seed means keeps its level, and finds what it says that it can find."""
    rng = np.random.default_rng(1)
    alarms = found = 0
    rounds, seed_db, image_db = 1000, 0.15, 0.3
    for _ in range(rounds):
        a, b = (rng.normal(0, seed_db, (3, 1)) + rng.normal(0, image_db, (3, 40)) for _ in range(2))
        alarms += compared(seeds(*a.mean(1)), seeds(*b.mean(1))).significant
    assert alarms / rounds == pytest.approx(0.05, abs=0.02)
    sigma = np.hypot(seed_db, image_db / np.sqrt(40))
    effect = power_of_80_percent(4) * sigma * np.sqrt(2 / 3)
    for _ in range(rounds):
        found += compared(seeds(*rng.normal(effect, sigma, 3)), seeds(*rng.normal(0, sigma, 3))).significant
    assert 0.65 < found / rounds < 0.88


def test_what_is_detectable_falls_with_the_number_of_captures() -> None:
    found = [detectable(0.3, count) for count in (1, 2, 4, 8, 16)]
    assert found[0] == np.inf and found == sorted(found, reverse=True)
    assert found[3] == pytest.approx(power_of_80_percent(7) * 0.3 / np.sqrt(8))
    rng = np.random.default_rng(5)
    shown = sum(
        compared(captures(*rng.normal(found[2], 0.3, 4)), captures(*[0.0] * 4)).significant for _ in range(1000)
    )
    assert shown / 1000 == pytest.approx(0.8, abs=0.04)


def test_so_many_captures_would_decide() -> None:
    unclear = compared(captures(0.1, 0.9, 0.2), captures(0.0, 0.0, 0.0))
    needed = unclear.captures_needed()
    assert unclear.verdict == "unclear" and isinstance(needed, int)
    assert detectable(unclear.spread, needed) <= unclear.mean < detectable(unclear.spread, needed - 1)
    rng = np.random.default_rng(6)
    draws = rng.normal(unclear.mean, unclear.spread, (1000, needed))
    shown = sum(compared(captures(*draw), captures(*[0.0] * needed)).significant for draw in draws)
    assert shown / 1000 == pytest.approx(0.8, abs=0.08)
    assert np.inf > replace(unclear, tests=20).captures_needed() > needed  # corrected over more comparisons
    assert np.inf > unclear.captures_needed(beyond=0.2) > needed
    inside = replace(unclear, mean=0.05, margin=0.1)
    assert inside.captures_needed() == replace(inside, mean=-0.05).captures_needed() < np.inf
    assert replace(inside, mean=0.1).captures_needed() == np.inf  # on the margin
    assert replace(unclear, mean=1e-4).captures_needed() == np.inf  # more than a thousand
    assert np.isnan(compared(seeds(1.0, 2.0), seeds(1.5, 1.9)).captures_needed())  # a single capture


def test_mean_interval_and_wilson_agree_with_scipy() -> None:
    a = np.random.default_rng(0).normal(27.3, 0.2, 5).tolist()
    found = mean_interval(a)
    assert (found.low, found.high) == pytest.approx(stats.t.interval(0.95, 4, loc=np.mean(a), scale=stats.sem(a)))
    assert np.isnan(mean_interval([3.0])[1:]).all()
    for failures, trials in ((0, 5), (3, 7), (10, 10)):
        expected = stats.binomtest(failures, trials).proportion_ci(method="wilson")
        assert wilson(failures, trials) == pytest.approx((expected.low, expected.high), abs=1e-6)
    with pytest.raises(ValueError, match="expected"):
        wilson(3, 2)


def test_spreads_between_captures_and_between_seeds() -> None:
    rng = np.random.default_rng(0)
    levels = rng.normal(25.0, 1.5, 2000)
    samples = {f"{k}": list(rng.normal(level, 0.4, 1 + k % 3)) for k, level in enumerate(levels)}
    assert spreads(samples) == (pytest.approx(1.5, rel=0.05), pytest.approx(0.4, rel=0.05))
    assert spreads({"a": [25.0], "b": [27.0]}) == (pytest.approx(2**0.5), None)
    assert spreads({"a": [25.0, 27.0]}) == (None, pytest.approx(2**0.5))
    assert spreads({"a": [25.0, 29.0], "b": [26.0, 28.0]})[0] == 0.0


def test_intervals_over_shared_captures_leave_out_the_common_effect_of_a_capture() -> None:
    rng = np.random.default_rng(0)
    levels, gain = rng.normal(25.0, 5.0, 12), rng.normal(1.0, 0.3, 12)
    samples = {"ash": captures(*levels + gain), "ddc": captures(*levels)}
    found, tested = intervals(samples), compared(samples["ash"], samples["ddc"])
    assert found["ash"].mean - found["ddc"].mean == pytest.approx(tested.mean)
    for each in found.values():  # Of two methods, the paired interval by the square root of two.
        assert each.high - each.mean == pytest.approx((tested.high - tested.mean) / 2**0.5)
    apart = {"ash": {"a": [25.0], "b": [27.0]}, "ddc": {"b": [24.0], "c": [25.0]}}
    assert {method: span.mean for method, span in intervals(apart).items()} == {"ash": 27.0, "ddc": 24.0}, "of b alone"
    apart["ddc"].pop("b")
    assert intervals(apart) == {}, "people differ by more than methods do"
    assert intervals({"ash": {"a": [24.0], "b": [25.0]}})["ash"] == mean_interval([24.0, 25.0])


def test_a_method_of_fewer_captures_stands_at_its_adjusted_mean_and_widens_no_other_interval() -> None:
    both = {"ash": captures(30.0, 25.0, 20.0), "ddc": captures(29.1, 24.0, 18.9)}  # Effects: 5.05, 0, -5.05.
    easy, hard = {"0": (30.0,)}, {"2": (20.0,)}
    more = intervals(both | {"easy": easy, "hard": hard})
    assert {method: more[method] for method in both} == intervals(both)
    assert (more["easy"].mean, more["hard"].mean) == (pytest.approx(24.95), pytest.approx(25.05))
    assert math.isnan(more["easy"].high), "of one value"
    assert on_all_captures(both | {"easy": easy}) == ["ash", "ddc"] and on_all_captures({"ash": both["ash"]}) == []
