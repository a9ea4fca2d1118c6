"""The statistics of the suite: SciPy's, read as differences with intervals, and what SciPy lacks.

The unit of evidence is the capture, a subject in an outfit: methods are compared in pairs over captures, seeds within
one are averaged. Where there is one capture, it is the seed, and a verdict holds for that capture alone. It is never
the image: images of one training share its luck, so a test over images alone cries wolf in a third of all cases. The
hierarchical bootstrap is reported beside the verdicts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import brentq
from scipy.special import digamma, nctdtrinc, polygamma

LEVEL = 0.95
EXACT = 1e-12  # A spread of this share of the difference is rounding.
ALIKE = 1e4  # Half of the degrees of freedom of variances that differ by chance alone: as good as infinite.
LENDERS = 10  # Fewer variances say too little about what they have in common: 7 % false alarms of five.


@dataclass(frozen=True, kw_only=True, slots=True)
class Interval:
    """A mean with its confidence interval; for a single value the interval is unknown (None)."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Difference:
    """Mean of `a` minus mean of `b`: interval, two-sided p, and size in standard deviations (Cohen's d).

    Everything but the mean is NaN where there is one value of each.
    """

    mean: float
    low: float
    high: float
    p: float
    spread: float  # standard deviation: of the pairs' differences, or pooled of two samples
    effect: float
    detectable: float  # the smallest difference that this design finds with 80 % power
    pairs: int = 0  # captures on which both were run; 0: samples that are no pairs


def mean_interval(values: Sequence[float], *, level: float = LEVEL) -> Interval:
    """Student's interval of a mean."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return Interval(mean=mean, low=None, high=None)
    half = float(stats.t.ppf((1 + level) / 2, len(values) - 1) * stats.sem(values))
    return Interval(mean=mean, low=mean - half, high=mean + half)


Samples = Mapping[str, Sequence[float]]  # values by capture, one for each seed


def compared(a: Samples, b: Samples, *, level: float = LEVEL) -> Difference | None:
    """Mean of `a` minus that of `b` over the captures that both have, in pairs; None without any.

    On a single capture seeds are independent samples (Welch).
    """
    shared = [capture for capture in a if capture in b]
    if len(shared) > 1:
        return paired(
            [np.mean(a[capture]) for capture in shared], [np.mean(b[capture]) for capture in shared], level=level
        )
    if not shared:
        return None
    ours, theirs = a[shared[0]], b[shared[0]]
    if min(len(ours), len(theirs)) > 1:
        return welch(ours, theirs, level=level)
    mean, nan = float(np.mean(ours) - np.mean(theirs)), math.nan
    return Difference(mean=mean, low=nan, high=nan, p=nan, spread=nan, effect=nan, detectable=nan)


def welch(a: Sequence[float], b: Sequence[float], *, level: float = LEVEL) -> Difference:
    """Independent samples of unequal variance: different methods, each with its own seeds.

    Raises:
        ValueError: a sample has fewer than two values.
    """
    _require(a, b)
    spread = math.sqrt((float(np.var(a, ddof=1)) + float(np.var(b, ddof=1))) / 2)
    return _difference(float(np.mean(a) - np.mean(b)), spread, lambda: stats.ttest_ind(a, b, equal_var=False), level)


def paired(a: Sequence[float], b: Sequence[float], *, level: float = LEVEL) -> Difference:
    """Paired samples: two methods on the same captures.

    Raises:
        ValueError: the samples differ in length, or have fewer than two values.
    """
    _require(a, b)
    if len(a) != len(b):
        raise ValueError(f"expected pairs, got {len(a)} and {len(b)} values")
    differences = np.subtract(a, b)
    spread = float(np.std(differences, ddof=1))
    found = _difference(float(differences.mean()), spread, lambda: stats.ttest_rel(a, b), level)
    return replace(found, pairs=len(a))


def independent(samples: Samples) -> list[float]:
    """The values that know nothing of each other: the means of captures, or where there is one, its seeds."""
    return (
        [float(np.mean(own)) for own in samples.values()] if len(samples) > 1 else [*next(iter(samples.values()), ())]
    )


def intervals(samples: Mapping[str, Samples]) -> dict[str, Interval]:
    """Every method's mean with its interval, for a chart in which methods stand beside each other.

    Over several captures that all methods share, what a capture adds to all of them is taken out first (Cousineau 2005,
    with the correction of Morey 2008): people differ by more than methods do. Else Student's, over seeds or captures.
    """
    found = {method: mean_interval(independent(own)) for method, own in samples.items()}
    first, *others = samples.values()
    shared = [capture for capture in first if all(capture in own for own in others)]
    if not others or len(shared) < 2:
        return found
    values = np.array([[np.mean(own[capture]) for capture in shared] for own in samples.values()])
    own_part = (values - values.mean(0)).var(1, ddof=1) * len(samples) / len(others)
    halves = stats.t.ppf((1 + LEVEL) / 2, len(shared) - 1) * np.sqrt(own_part / len(shared))
    return {
        method: Interval(mean=each.mean, low=each.mean - float(half), high=each.mean + float(half))
        for (method, each), half in zip(found.items(), halves, strict=True)
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class Spreads:
    """Standard deviations of a method's scores: between captures, and between the seeds of one capture.

    None: unknown, of fewer than two captures, or where no capture has two seeds. Without the seeds' spread that between
    captures holds theirs too.
    """

    captures: float | None
    seeds: float | None


def spreads(samples: Samples) -> Spreads:
    """The two components of variance by analysis of variance (one way, captures at random)."""
    repeated = [own for own in samples.values() if len(own) > 1]
    freedom = sum(len(own) - 1 for own in repeated)
    variance = sum((len(own) - 1) * float(np.var(own, ddof=1)) for own in repeated) / freedom if freedom else 0.0
    seeds = math.sqrt(variance) if freedom else None
    if len(samples) < 2:
        return Spreads(captures=None, seeds=seeds)
    means = float(np.var([np.mean(own) for own in samples.values()], ddof=1))
    of_seeds = variance * float(np.mean([1 / len(own) for own in samples.values()]))
    return Spreads(captures=math.sqrt(max(0.0, means - of_seeds)), seeds=seeds)


def redrawn(samples: Sequence[Samples], *, rng: np.random.Generator) -> list[float]:
    """The means of several methods when what they rest on is drawn anew.

    Captures are drawn the same for all, on a single one seeds, for each method by itself.

    Raises:
        ValueError: they have no capture in common.
    """
    shared = [capture for capture in samples[0] if all(capture in other for other in samples)]
    if not shared:
        raise ValueError("expected methods with a capture in common")
    if len(shared) > 1:
        drawn = [shared[index] for index in rng.integers(len(shared), size=len(shared))]
        return [float(np.mean([np.mean(own[capture]) for capture in drawn])) for own in samples]
    return [float(rng.choice(own[shared[0]], len(own[shared[0]])).mean()) for own in samples]


def hierarchical_bootstrap(
    a: np.ndarray,
    b: np.ndarray,
    *,
    rng: np.random.Generator,
    pairs: bool = False,
    resamples: int = 2000,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Interval of mean(a) - mean(b) for scores `[seeds, images]`: seeds are drawn anew, and images, the same for both.

    Of `pairs`, two methods on the same captures `[captures, images]`, the rows are drawn the same for both as well.
    With three seeds it is a little too narrow (8-11 % false alarms at nominal 5): report it, do not gate on it.
    """
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1] or (pairs and len(a) != len(b)):
        raise ValueError(f"expected [seeds, images] with the same images, got {a.shape} and {b.shape}")
    means = np.empty(resamples)
    for index in range(resamples):
        images = rng.integers(a.shape[1], size=a.shape[1])
        rows = rng.integers(len(a), size=len(a))
        others = rows if pairs else rng.integers(len(b), size=len(b))
        means[index] = a[rows][:, images].mean() - b[others][:, images].mean()
    tail = (1 - level) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjusted p values that keep the chance of any false alarm among all comparisons at the level (Holm 1979)."""
    order = np.argsort(p_values)
    adjusted = np.empty(len(p_values))
    running = 0.0
    for rank, index in enumerate(order):
        running = max(running, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = running
    return [float(p) for p in adjusted]


def wilson(failures: int, trials: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927): honest also for 0 of 5."""
    if not 0 <= failures <= trials or trials == 0:
        raise ValueError(f"expected 0 <= failures <= trials and a trial, got {failures} of {trials}")
    interval = stats.binomtest(failures, trials).proportion_ci(LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def kendall(a: Sequence[float], b: Sequence[float]) -> float:
    """Kendall's tau: the share of pairs in the same order minus that in the opposite one; ties count as neither.

    That is tau-a, which says what readers of a ranking ask; SciPy has tau-b and tau-c, which forgive ties.
    """
    signs = [np.sign(np.subtract.outer(values, values)) for values in (a, b)]
    return float((signs[0] * signs[1]).sum() / (len(a) * (len(a) - 1)))


def _difference(mean: float, spread: float, test: Callable[[], Any], level: float) -> Difference:
    """The test's result as a difference; samples without any spread need no test: what differs, differs."""
    if spread <= EXACT * abs(mean) or spread == 0:
        effect = 0.0 if mean == 0 else math.copysign(math.inf, mean)
        return Difference(mean=mean, low=mean, high=mean, p=float(mean == 0), spread=0.0, effect=effect, detectable=0.0)
    found = test()
    interval = found.confidence_interval(level)
    quantile = float(stats.t.ppf((1 + level) / 2, found.df))
    error = (float(interval.high) - float(interval.low)) / (2 * quantile)
    return Difference(
        mean=mean,
        low=float(interval.low),
        high=float(interval.high),
        p=float(found.pvalue),
        spread=spread,
        effect=mean / spread,
        detectable=noncentrality(float(found.df), quantile) * error,
    )


def moderated(differences: Sequence[Difference], *, level: float = LEVEL) -> list[Difference]:
    """Paired differences of many kinds over few captures, each with the variance that all of them make likely.

    Three captures hardly tell how far a difference spreads over people. So each variance is drawn towards what the
    others have in common, the more the more alike they are, and its interval counts with the freedom that this lends
    it (the moderated t of Smyth 2004, prior by moments of log variances). The prior counts half: it comes from the
    same few numbers, and in full raises 6.5 % false alarms at 5 % where variances spread as ours do; so, 4 to 5.3 %.

    Fewer than ten differences, and those that are no pairs or do not spread, stay as they are; `spread` and `effect`
    stay those of the captures.
    """
    lends = [each.pairs > 1 and each.spread > 0 for each in differences]
    lenders = [each for each, able in zip(differences, lends, strict=True) if able]
    if len(lenders) < LENDERS:
        return list(differences)
    prior = _prior([each.spread**2 for each in lenders], [each.pairs - 1 for each in lenders])
    return [_moderated(each, prior, level) if able else each for each, able in zip(differences, lends, strict=True)]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Prior:
    """What variances have in common: a typical one, and as how many degrees of freedom it counts."""

    variance: float
    freedom: float  # the more, the more alike they are


def _prior(variances: Sequence[float], freedoms: Sequence[int]) -> _Prior:
    """The scaled inverse chi-squared distribution that has the mean and spread of the variances' logarithms."""
    half = np.asarray(freedoms) / 2
    logs = np.log(variances) - digamma(half) + np.log(half)
    apart = float(np.var(logs, ddof=1) - polygamma(1, half).mean())
    least = float(polygamma(1, ALIKE))
    own = brentq(lambda x: float(polygamma(1, x)) - apart, 1e-6, ALIKE) if apart > least else ALIKE
    typical = float(np.exp(logs.mean() + digamma(own) - np.log(own)))
    return _Prior(variance=typical, freedom=own)  # Half of Smyth's, see `moderated`.


def _moderated(difference: Difference, prior: _Prior, level: float) -> Difference:
    own = difference.pairs - 1
    freedom = prior.freedom + own
    variance = (prior.freedom * prior.variance + own * difference.spread**2) / freedom
    error = math.sqrt(variance / difference.pairs)
    quantile = float(stats.t.ppf((1 + level) / 2, freedom))
    return replace(
        difference,
        low=difference.mean - quantile * error,
        high=difference.mean + quantile * error,
        p=float(2 * stats.t.sf(abs(difference.mean) / error, freedom)),
        detectable=noncentrality(freedom, quantile) * error,
    )


def detectable(spread: float, pairs: int, *, level: float = LEVEL) -> float:
    """The smallest difference that so many pairs, whose differences spread so far, show with 80 % power.

    A single pair shows none, however large: infinite.
    """
    if pairs < 2:
        return math.inf
    quantile = float(stats.t.ppf((1 + level) / 2, pairs - 1))
    return noncentrality(float(pairs - 1), quantile) * spread / math.sqrt(pairs)


def noncentrality(freedom: float, quantile: float, power: float = 0.8) -> float:
    """The true difference, in standard errors, at which a t test finds it with the given power."""
    return float(nctdtrinc(freedom, 1 - power, quantile))


def _require(a: Sequence[float], b: Sequence[float]) -> None:
    if len(a) < 2 or len(b) < 2:
        raise ValueError(f"expected at least two seeds on each side, got {len(a)} and {len(b)}")
