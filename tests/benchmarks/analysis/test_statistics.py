import numpy as np
import pytest
from scipy import optimize, stats

from benchmarks.analysis.statistics import (
    Difference,
    compared,
    detectable,
    hierarchical_bootstrap,
    holm,
    independent,
    intervals,
    kendall,
    mean_interval,
    moderated,
    noncentrality,
    paired,
    redrawn,
    spreads,
    welch,
    wilson,
)


@pytest.fixture
def samples() -> tuple[list[float], list[float]]:
    rng = np.random.default_rng(0)
    return list(rng.normal(27.3, 0.2, 5)), list(rng.normal(27.0, 0.5, 4))


def test_welch_agrees_with_scipy(samples) -> None:
    expected = stats.ttest_ind(*samples, equal_var=False)
    interval = expected.confidence_interval()
    found = welch(*samples)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-10)
    assert (found.low, found.high) == pytest.approx((interval.low, interval.high), rel=1e-10)
    assert welch(*samples[::-1]).mean == -found.mean


def test_paired_agrees_with_scipy(samples) -> None:
    a, b = samples[0][:4], samples[1]
    expected = stats.ttest_rel(a, b)
    interval = expected.confidence_interval()
    found = paired(a, b)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-10)
    assert (found.low, found.high) == pytest.approx((interval.low, interval.high), rel=1e-10)


def test_mean_interval_agrees_with_scipy(samples) -> None:
    a = samples[0]
    expected = stats.t.interval(0.95, len(a) - 1, loc=np.mean(a), scale=stats.sem(a))
    found = mean_interval(a)
    assert (found.low, found.high) == pytest.approx(expected, rel=1e-10)
    assert mean_interval([3.0]).low is None


def test_kendall_is_scipys_without_ties_and_counts_ties_as_neither() -> None:
    a, b = [1.0, 4.0, 2.0, 3.0], [2.0, 3.0, 1.0, 4.0]
    assert kendall(a, b) == pytest.approx(stats.kendalltau(a, b).statistic)
    assert kendall([1.0, 1.0, 2.0], [1.0, 2.0, 3.0]) == pytest.approx(2 / 3)


def test_holms_correction_by_hand() -> None:
    p = [0.01, 0.04, 0.03, 0.005, 0.8]
    assert holm(p) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.8])


def test_wilson_agrees_with_scipy() -> None:
    for failures, trials in ((0, 5), (3, 7), (10, 10)):
        expected = stats.binomtest(failures, trials).proportion_ci(method="wilson")
        assert wilson(failures, trials) == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_false_alarms_and_power_on_our_design() -> None:
    """Images on three seeds each: the test on seed means keeps its level, and finds what it says it can find."""
    rng = np.random.default_rng(1)
    alarms = found = 0
    rounds, seed_db, image_db = 1000, 0.15, 0.3
    for _ in range(rounds):
        a, b = (rng.normal(0, seed_db, (3, 1)) + rng.normal(0, image_db, (3, 40)) for _ in range(2))
        test = welch(list(a.mean(1)), list(b.mean(1)))
        alarms += test.p < 0.05
    assert alarms / rounds == pytest.approx(0.05, abs=0.02)
    sigma = np.hypot(seed_db, image_db / np.sqrt(40))
    effect = noncentrality(4.0, float(stats.t.ppf(0.975, 4))) * sigma * np.sqrt(2 / 3)
    assert effect == pytest.approx(power_of_80_percent(4) * sigma * np.sqrt(2 / 3), rel=1e-6)
    for _ in range(rounds):
        test = welch(list(rng.normal(effect, sigma, 3)), list(rng.normal(0, sigma, 3)))
        found += test.p < 0.05
    assert 0.65 < found / rounds < 0.88


# Standard deviations of losses over people, dB, as far apart as those that the ladder shows.
SPREADS = (
    0.04,
    0.31,
    0.18,
    0.64,
    0.93,
    0.96,
    0.30,
    0.25,
    0.64,
    0.03,
    0.05,
    0.16,
    0.12,
    0.13,
    0.28,
    0.28,
    0.09,
    0.20,
    0.37,
)


def null_losses(rng: np.random.Generator, *, mean: float = 0.0, captures: int = 3) -> list[Difference]:
    return [paired(list(rng.normal(mean, spread, captures)), [0.0] * captures) for spread in SPREADS]


def test_variances_that_cells_lend_each_other_raise_no_more_alarms_and_find_more() -> None:
    rng, rounds = np.random.default_rng(5), 150
    nothing = [null_losses(rng) for _ in range(rounds)]
    alarms = sum(each.p < 0.05 for losses in nothing for each in moderated(losses))
    trials = rounds * len(SPREADS)
    assert stats.binomtest(alarms, trials, 0.05, alternative="greater").pvalue > 0.01, alarms / trials
    assert alarms / trials > 0.03, "a test that never alarms is none"
    something = [null_losses(rng, mean=0.5) for _ in range(rounds)]
    plain = sum(each.p < 0.05 for losses in something for each in losses)
    assert sum(each.p < 0.05 for losses in something for each in moderated(losses)) > 1.1 * plain


def test_variances_that_are_alike_count_as_known() -> None:
    """A variance of two degrees of freedom is exp(gamma) times too small in the mean of its logarithm."""
    alike = [paired([mean - 0.1, mean, mean + 0.1], [0.0, 0.0, 0.0]) for mean in np.linspace(-1, 1, 10)]
    half = 1.96 * 0.1 * np.exp(np.euler_gamma / 2) / np.sqrt(3)
    for before, after in zip(alike, moderated(alike), strict=True):
        assert (after.low, after.high) == pytest.approx((before.mean - half, before.mean + half), abs=2e-4)
        assert (after.mean, after.spread, after.pairs) == (before.mean, before.spread, 3)


def test_what_is_too_few_or_no_pairs_keeps_its_variance() -> None:
    losses = null_losses(np.random.default_rng(6))
    assert moderated(losses[:9]) == losses[:9]
    seeds, same = welch([1.0, 1.1], [2.0, 2.3]), paired([1.0, 1.0], [0.0, 0.0])
    found = moderated([seeds, *losses, same])
    assert (found[0], found[-1]) == (seeds, same) and found[1:-1] == moderated(losses)
    assert sum(after.low > before.low for before, after in zip(losses, found[1:-1], strict=True)) > len(losses) / 2


def power_of_80_percent(freedom: int) -> float:
    critical = stats.t.ppf(0.975, freedom)
    return float(optimize.brentq(lambda d: stats.nct.sf(critical, freedom, d) - 0.8, 0.1, 20))


def test_a_test_over_images_alone_would_cry_wolf() -> None:
    rng = np.random.default_rng(2)
    alarms = 0
    for _ in range(500):
        a, b = (rng.normal(0, 0.15) + rng.normal(0, 0.3, 40) for _ in range(2))
        alarms += welch(list(a), list(b)).p < 0.05
    assert alarms / 500 > 0.2


def test_hierarchical_bootstrap_covers_and_is_wider_than_images_alone() -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(150):
        a, b = (rng.normal(0, 0.15, (5, 1)) + rng.normal(0, 0.3, (5, 40)) for _ in range(2))
        low, high = hierarchical_bootstrap(a, b, rng=rng, resamples=200)
        covered += low <= 0 <= high
    assert 0.84 < covered / 150 <= 1
    a = np.tile([[1.0], [2.0], [3.0]], 4)
    assert hierarchical_bootstrap(a, np.zeros((3, 4)), rng=np.random.default_rng(0)) == (1.0, 3.0)


def test_methods_on_the_same_captures_are_drawn_in_pairs() -> None:
    """Captures differ by far more than the methods do; the pairs know it, the others cannot."""
    rng = np.random.default_rng(4)
    covered, widths = 0, []
    for _ in range(100):
        captures = rng.normal(0, 3.0, (8, 1))
        b = captures + rng.normal(0, 0.3, (8, 40))
        a = captures + 0.5 + rng.normal(0, 0.2, (8, 1)) + rng.normal(0, 0.3, (8, 40))
        low, high = hierarchical_bootstrap(a, b, rng=rng, pairs=True, resamples=200)
        covered += low <= 0.5 <= high
        widths.append(high - low)
    assert 0.8 < covered / 100 <= 1 and np.mean(widths) < 0.5
    low, high = hierarchical_bootstrap(a, b, rng=rng, resamples=200)
    assert high - low > 2
    with pytest.raises(ValueError, match="with the same images"):
        hierarchical_bootstrap(a, b[:3], rng=rng, pairs=True)


def test_no_spread_and_too_few() -> None:
    assert welch([1.0, 1.0], [1.0, 1.0]).p == 1
    assert welch([2.0, 2.0], [1.0, 1.0]).p == 0
    assert paired([2.0, 3.0], [1.0, 2.0]).low == 1
    for wrong in (lambda: welch([1.0], [1.0, 2.0]), lambda: paired([1.0, 2.0], [1.0, 2.0, 3.0]), lambda: wilson(3, 2)):
        with pytest.raises(ValueError, match="expected"):
            wrong()


def test_captures_are_compared_in_pairs_and_their_seeds_are_averaged() -> None:
    a = {"x": [24.0, 26.0], "y": [30.0, 32.0], "z": [28.0, 28.0], "of a alone": [99.0]}
    b = {"z": [27.5], "y": [30.0], "x": [24.6]}
    found, by_hand = compared(a, b), stats.ttest_rel([25.0, 31.0, 28.0], [24.6, 30.0, 27.5])
    assert found is not None and found.pairs == 3
    assert (found.mean, found.p) == pytest.approx((1.9 / 3, by_hand.pvalue))
    assert found.spread == pytest.approx(np.std([0.4, 1.0, 0.5], ddof=1))
    assert found.detectable == pytest.approx(detectable(found.spread, 3))
    assert independent(a)[:3] == [25.0, 31.0, 28.0] and independent({"x": [1.0, 2.0]}) == [1.0, 2.0]


def test_on_one_capture_seeds_are_samples_and_one_value_knows_no_interval() -> None:
    a, b = {"x": [24.0, 24.2, 24.4]}, {"x": [23.0, 23.3], "y": [50.0, 51.0]}
    assert compared(a, b) == welch(a["x"], b["x"])
    single = compared({"x": [24.0]}, {"x": [23.0, 23.5]})
    assert single is not None and single.mean == 0.75 and np.isnan([single.low, single.p, single.detectable]).all()
    assert compared({"x": [1.0]}, {"y": [1.0]}) is None


def test_what_is_detectable_falls_with_the_number_of_captures() -> None:
    found = [detectable(0.3, captures) for captures in (1, 2, 4, 8, 16)]
    assert found[0] == np.inf and found == sorted(found, reverse=True)
    assert found[3] == pytest.approx(power_of_80_percent(7) * 0.3 / np.sqrt(8))
    rng = np.random.default_rng(5)
    shown = sum(paired(list(rng.normal(found[2], 0.3, 4)), [0.0] * 4).p < 0.05 for _ in range(1000))
    assert shown / 1000 == pytest.approx(0.8, abs=0.04)


def test_evidence_is_drawn_anew_by_captures_for_all_methods_alike() -> None:
    rng = np.random.default_rng(6)
    levels = {"x": [20.0], "y": [25.0], "z": [30.0]}
    drawn = [
        redrawn([levels, {name: [v + 1 for v in own] for name, own in levels.items()}], rng=rng) for _ in range(50)
    ]
    assert {round(b - a, 9) for a, b in drawn} == {1.0} and len({a for a, _ in drawn}) > 3
    seeds = [redrawn([{"x": [1.0, 2.0]}, {"x": [1.0, 2.0]}], rng=rng) for _ in range(50)]
    assert {a == b for a, b in seeds} == {True, False}, "seeds of two methods have nothing to do with each other"
    with pytest.raises(ValueError, match="a capture in common"):
        redrawn([{"x": [1.0]}, {"y": [1.0]}], rng=rng)


def test_spreads_finds_what_varies_between_captures_and_what_between_seeds() -> None:
    rng = np.random.default_rng(0)
    people = rng.normal(25.0, 1.5, 2000)
    samples = {f"{k}": list(rng.normal(person, 0.4, 1 + k % 3)) for k, person in enumerate(people)}
    found = spreads(samples)
    assert found.captures == pytest.approx(1.5, rel=0.05)
    assert found.seeds == pytest.approx(0.4, rel=0.05)


def test_spreads_says_what_it_cannot_know() -> None:
    single = spreads({"a": [25.0], "b": [27.0]})
    assert (single.captures, single.seeds) == (pytest.approx(2**0.5), None)
    one = spreads({"a": [25.0, 27.0]})
    assert (one.captures, one.seeds) == (None, pytest.approx(2**0.5))
    assert spreads({"a": [25.0, 29.0], "b": [26.0, 28.0]}).captures == 0.0


def test_intervals_over_shared_captures_leave_out_what_a_capture_adds_to_all_methods() -> None:
    rng = np.random.default_rng(0)
    people = rng.normal(25.0, 5.0, 12)
    gain = rng.normal(1.0, 0.3, 12)
    samples = {
        "ash": {f"{k}": [person + own] for k, (person, own) in enumerate(zip(people, gain, strict=True))},
        "ddc": {f"{k}": [person] for k, person in enumerate(people)},
    }
    found = intervals(samples)
    tested = paired(list(people + gain), list(people))
    assert found["ash"].mean - found["ddc"].mean == pytest.approx(tested.mean)
    for each in found.values():  # Of two methods, the paired interval by the square root of two.
        assert each.high - each.mean == pytest.approx((tested.high - tested.mean) / 2**0.5)


def test_intervals_of_methods_that_share_no_two_captures_are_students() -> None:
    one = {"ash": {"a": [25.0, 26.0, 27.0]}, "ddc": {"a": [24.0, 24.5, 25.0]}}
    assert intervals(one)["ash"] == mean_interval([25.0, 26.0, 27.0])
    apart = {"ash": {"a": [25.0], "b": [27.0]}, "ddc": {"b": [24.0], "c": [25.0]}}
    assert intervals(apart)["ddc"] == mean_interval([24.0, 25.0])
    assert intervals({"ash": {"a": [25.0], "b": [27.0]}})["ash"] == mean_interval([25.0, 27.0])
