"""One way to compare two methods, and the intervals that reports print.

The unit is the capture, a subject in an outfit: methods are compared in pairs over captures, and seeds within a capture
are averaged. On a single capture the unit is the seed, and a verdict holds for that capture alone. The unit is never
the image: images of one training share its random numbers, so that a test over images raises 30 % false alarms.
"""

import math
from bisect import bisect_left
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy.special import nctdtrinc, stdtr, stdtrit

Verdict = Literal["better", "worse", "equivalent", "unclear"]
Samples = Mapping[str, Sequence[float]]  # values by capture, one for each seed
Row = TypeVar("Row", bound=Hashable)  # a method, or a method at a severity

LEVEL, ALPHA, POWER = 0.95, 0.05, 0.8
MOST_PAIRS = 1000  # that are worth a search
ROUNDING = 1e-12  # as a share of the values: a smaller spread is none


class Interval(NamedTuple):
    """A mean with its 95 % confidence interval, which is NaN for a single value."""

    mean: float
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True, kw_only=True, slots=True)
class Comparison:
    """Mean of `a` minus mean of `b`. Everything but the mean is NaN where there is one value of each."""

    mean: float
    low: float = math.nan  # 95 % interval, or that of the level asked for
    high: float = math.nan
    p: float = math.nan  # two-sided
    spread: float = math.nan  # standard deviation: of the differences of pairs, or pooled of two samples
    detectable: float = math.nan  # the smallest difference that this design finds with 80 % power
    captures: int = 0  # that were compared in pairs; 0: seeds of a single capture
    margin: float = 0.0  # differences up to it do not count
    higher_is_better: bool = True
    tests: int = 1  # among which p is corrected

    @property
    def significant(self) -> bool:
        """Whether p is below 5 %."""
        return self.p < ALPHA

    @property
    def verdict(self) -> Verdict:
        """What is known of `a`: better or worse by more than the margin, equivalent within it, or unclear."""
        if self.significant and abs(self.mean) > self.margin:
            return "better" if (self.mean > 0) == self.higher_is_better else "worse"
        return "equivalent" if -self.margin <= self.low and self.high <= self.margin else "unclear"

    def captures_needed(self, beyond: float = 0.0) -> float:
        """How many captures would decide, were mean and spread those of all people: with 80 % power, corrected.

        A difference within the margin is decided once it is known to lie there. p is corrected as Bonferroni does, the
        hardest step of Holm's. `beyond`: what a larger difference must exceed. Infinite above a thousand; NaN where a
        single capture was compared, whose seeds say nothing of others.
        """
        if not self.captures:
            return math.nan
        size, level = abs(self.mean), 1 - ALPHA / self.tests
        distance = size - beyond if size > self.margin else self.margin - size
        counts = range(2, MOST_PAIRS + 1)
        index = bisect_left(counts, True, key=lambda count: detectable(self.spread, count, level) <= distance)
        return counts[index] if index < len(counts) else math.inf


def compare_samples(
    a: Samples, b: Samples, *, margin: float = 0.0, higher_is_better: bool = True, level: float = LEVEL
) -> Comparison | None:
    """Compare over the captures that both have: t test of the pairs; on a single capture Welch's test of the seeds.

    None without a common capture. Where nothing varies, what differs is significant.
    """
    shared = [capture for capture in a if capture in b]
    if not shared:
        return None
    if pairs := len(shared) > 1:
        first, second = ([float(np.mean(samples[capture])) for capture in shared] for samples in (a, b))
    else:
        first, second = list(a[shared[0]]), list(b[shared[0]])
    mean = float(np.mean(first) - np.mean(second))
    comparison = Comparison(
        mean=mean, captures=len(shared) if pairs else 0, margin=margin, higher_is_better=higher_is_better
    )
    if min(len(first), len(second)) < 2:
        return comparison
    if pairs:
        spread = float(np.std(np.subtract(first, second), ddof=1))
        error, freedom = spread / math.sqrt(len(first)), len(first) - 1.0
    else:
        variances = [float(np.var(values, ddof=1)) for values in (first, second)]
        parts = [variance / len(values) for variance, values in zip(variances, (first, second), strict=True)]
        spread, error = math.sqrt(sum(variances) / 2), math.sqrt(sum(parts))
        squares = sum(part**2 / (len(values) - 1) for part, values in zip(parts, (first, second), strict=True))
        freedom = error**4 / squares if squares else 1.0
    if spread <= ROUNDING * max(map(abs, [*first, *second])):
        return replace(comparison, low=mean, high=mean, p=float(mean == 0), spread=0.0, detectable=0.0)
    quantile = _quantile(level, freedom)
    return replace(
        comparison,
        low=mean - quantile * error,
        high=mean + quantile * error,
        p=float(2 * stdtr(freedom, -abs(mean) / error)),
        spread=spread,
        detectable=_noncentrality(freedom, quantile) * error,
    )


def corrected(comparisons: Sequence[Comparison], planned: int = 0) -> list[Comparison]:
    """With p adjusted so that the chance of any false alarm among all of them is at most 5 % (Holm 1979).

    `planned`: how many tests there are with those still to be made, so that making them raises no p of these.
    """
    p_values = [each.p for each in comparisons if not math.isnan(each.p)]
    tests = max(planned, len(p_values))
    adjusted = iter(holm([*p_values, *[1.0] * (tests - len(p_values))]))
    return [each if math.isnan(each.p) else replace(each, p=next(adjusted), tests=tests) for each in comparisons]


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjusted p values, in the order given."""
    order = np.argsort(p_values)
    steps = np.minimum(1.0, (len(p_values) - np.arange(len(p_values))) * np.asarray(p_values)[order])
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.maximum.accumulate(steps)
    return [float(p) for p in adjusted]


def detectable(spread: float, pairs: int, level: float = LEVEL) -> float:
    """The smallest difference that so many pairs show with 80 % power; `spread`: deviation of their differences.

    Infinite for a single pair.
    """
    if pairs < 2:
        return math.inf
    return _noncentrality(pairs - 1.0, _quantile(level, pairs - 1)) * spread / math.sqrt(pairs)


def mean_interval(values: Sequence[float]) -> Interval:
    """Student's interval of a mean."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return Interval(mean)
    half = _quantile(LEVEL, len(values) - 1) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return Interval(mean, mean - half, mean + half)


def independent(samples: Samples) -> list[float]:
    """The values that intervals are taken over: means of captures, or the seeds of a single capture."""
    if len(samples) > 1:
        return [float(np.mean(seeds)) for seeds in samples.values()]
    return [*next(iter(samples.values()), ())]


def intervals(samples: Mapping[Row, Samples]) -> dict[Row, Interval]:
    """Every method's mean with its interval, for a chart in which methods stand beside each other.

    The effect of a capture, by the methods that have all captures, is removed first (Cousineau 2005, with the
    correction of Morey 2008), because subjects differ by more than methods do. A method of fewer captures has its
    adjusted mean: what it would have over all, by its difference to those methods. Where fewer than two methods have
    all, each has its plain mean and Student's interval over the captures that all of them have, nothing if there is
    none.
    """
    if not (whole := on_all_captures(samples)):
        return {method: mean_interval(independent(seeds)) for method, seeds in on_shared_captures(samples).items()}
    captures = list(samples[whole[0]])
    values = np.array([[np.mean(samples[method][capture]) for capture in captures] for method in whole])
    effects = dict(zip(captures, values.mean(0) - values.mean(), strict=True))
    of_methods = {}
    for method, seeds in samples.items():
        each = mean_interval([float(np.mean(seeds[capture])) - effects[capture] for capture in seeds])
        correction = math.sqrt(len(whole) / (len(whole) - 1)) if method in whole else 1.0
        half = (each.high - each.mean) * correction
        of_methods[method] = Interval(each.mean, each.mean - half, each.mean + half)
    return of_methods


def on_all_captures(samples: Mapping[Row, Samples]) -> list[Row]:
    """The methods that have every capture that any has; none where that is one method, or one capture."""
    captures = {capture for seeds in samples.values() for capture in seeds}
    whole = [method for method, seeds in samples.items() if seeds.keys() == captures]
    return whole if len(whole) > 1 and len(captures) > 1 else []


def on_shared_captures(samples: Mapping[Row, Samples]) -> dict[Row, Samples]:
    """All methods on the captures that every one of them has, in their order; empty where there is none."""
    shared = set.intersection(*(set(seeds) for seeds in samples.values())) if samples else set()
    if not shared:
        return {}
    return {method: {key: seeds[key] for key in seeds if key in shared} for method, seeds in samples.items()}


def spreads(samples: Samples) -> tuple[float | None, float | None]:
    """Standard deviations between captures and between the seeds of a capture, by analysis of variance.

    None where unknown: of fewer than two captures, or where no capture has two seeds. In the latter case the spread
    between captures contains that of the seeds.
    """
    freedom = sum(len(seeds) - 1 for seeds in samples.values())
    squares = sum(float(np.var(seeds)) * len(seeds) for seeds in samples.values())
    variance = squares / freedom if freedom else 0.0
    between_seeds = math.sqrt(variance) if freedom else None
    if len(samples) < 2:
        return None, between_seeds
    means = float(np.var([np.mean(seeds) for seeds in samples.values()], ddof=1))
    of_seeds = variance * float(np.mean([1 / len(seeds) for seeds in samples.values()]))
    return math.sqrt(max(0.0, means - of_seeds)), between_seeds


def wilson(failures: int, trials: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927); also right for 0 of 5."""
    if not 0 <= failures <= trials or trials == 0:
        raise ValueError(f"expected 0 <= failures <= trials and a trial, got {failures} of {trials}")
    from scipy.stats import binomtest  # A second of imports that stability alone needs.

    interval = binomtest(failures, trials).proportion_ci(LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def _quantile(level: float, freedom: float) -> float:
    """Half the width of Student's interval, in standard errors."""
    return float(stdtrit(freedom, (1 + level) / 2))


def _noncentrality(freedom: float, quantile: float) -> float:
    """The true difference, in standard errors, at which a t test has the power wanted."""
    return float(nctdtrinc(freedom, 1 - POWER, quantile))
