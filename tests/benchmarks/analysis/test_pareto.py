from dataclasses import replace

import numpy as np
import pytest

from benchmarks.analysis.pareto import (
    Contender,
    chosen_elsewhere,
    confirmed,
    front,
    hypervolume,
    hypervolume_interval,
    smallest_sufficient,
)


def candidate(name: str, quality: float, cost: float, spread: float = 0.05) -> Contender:
    return Contender(name=name, samples={"a": (quality - spread, quality, quality + spread)}, cost=cost)


FIELD = [candidate("best", 30.0, 100.0), candidate("near", 29.8, 40.0), candidate("fast", 25.0, 5.0)]


def test_the_front_holds_whom_nobody_beats_in_both() -> None:
    dominated = candidate("slow and poor", 24.0, 50.0)
    assert front([*FIELD, dominated]) == ("fast", "near", "best")
    assert front([]) == ()
    assert set(front([candidate("a", 20.0, 5.0), candidate("b", 20.0, 5.0)])) == {"a", "b"}


def test_hypervolume_by_hand() -> None:
    alone = [candidate("a", 20.0, 10.0)]
    assert hypervolume(alone) == pytest.approx(10 * 2)  # 10 dB above the corner, two decades before it
    two = [*alone, candidate("b", 25.0, 100.0)]
    assert hypervolume(two) == pytest.approx(10 * 2 + 5 * 1)
    assert hypervolume([*two, candidate("dominated", 19.0, 50.0)]) == pytest.approx(25)
    assert hypervolume([candidate("too slow", 30.0, 2000.0)]) == 0
    low, high = hypervolume_interval(two, rng=np.random.default_rng(0), resamples=300)
    assert low < 25 < high < low + 1


def test_the_smallest_sufficient_is_the_cheapest_that_is_not_inferior() -> None:
    found = smallest_sufficient(FIELD)
    assert found is not None and (found.name, found.best) == ("near", "best")
    assert 0.2 < found.loss_bound_db < 0.5
    strict = smallest_sufficient(FIELD, margin=0.1)
    assert strict is not None and strict.name == "best"
    noisy = [FIELD[0], candidate("near", 29.8, 40.0, spread=1.0), FIELD[2]]
    assert smallest_sufficient(noisy).name == "best", "what is not known not to be inferior does not suffice"
    assert smallest_sufficient([Contender(name="a", samples={"a": (20.0,)}, cost=1.0)]) is None


def test_captures_are_compared_and_drawn_in_pairs() -> None:
    """Captures differ by far more than the methods: seen as samples nothing would suffice, in pairs the cheap one."""
    levels = {"a": 20.0, "b": 24.0, "c": 29.0, "d": 31.0}
    best = Contender(name="best", cost=50.0, samples={name: (level + 0.2,) for name, level in levels.items()})
    shifts = (0.0, 0.02, -0.02, 0.01)
    cheap = Contender(
        name="cheap",
        cost=5.0,
        samples={name: (level + shift,) for (name, level), shift in zip(levels.items(), shifts, strict=True)},
    )
    found = smallest_sufficient([best, cheap])
    assert found is not None and found.name == "cheap" and 0.2 < found.loss_bound_db < 0.25
    low, high = hypervolume_interval([best, cheap], rng=np.random.default_rng(0), resamples=300)
    assert high - low > 5, "which captures there are matters"
    assert smallest_sufficient([best, Contender(name="x", cost=1.0, samples={"elsewhere": (20.0, 21.0)})]) is None


def test_a_choice_is_confirmed_on_the_captures_that_had_no_say_in_it() -> None:
    """Cheap is level with the best on a, b and c, and falls by 2 dB on d: with d nobody would have chosen it."""
    levels = {"a": 20.0, "b": 25.0, "c": 30.0, "d": 27.0}
    best = Contender(name="best", cost=50.0, samples={name: (level,) for name, level in levels.items()})
    losses = {"a": 0.10, "b": 0.12, "c": 0.11, "d": 2.0}
    fallen = Contender(name="cheap", cost=5.0, samples={k: (levels[k] - loss,) for k, loss in losses.items()})
    found = confirmed([best, fallen])
    assert found is not None and (found.same, found.captures) == (3, 4), "without d the others choose cheap"
    assert found.loss_db == pytest.approx(2.0 / 4)
    steady = replace(fallen, samples={k: (level - 0.1,) for k, level in levels.items()})
    always = confirmed([best, steady])
    assert always is not None and (always.same, always.captures) == (4, 4)
    assert always.loss_db == pytest.approx(0.1)
    two = [replace(c, samples={k: c.samples[k] for k in "ab"}) for c in (best, steady)]
    assert confirmed(two) is None and confirmed([]) is None


def test_a_choice_is_judged_on_captures_that_made_none() -> None:
    def row(name: str, cost: float, *qualities: float) -> Contender:
        return Contender(name=name, samples={f"{i}": (q,) for i, q in enumerate(qualities)}, cost=cost)

    there = [row("best", 50.0, 30.0, 25.0), row("cheap", 5.0, 29.9, 24.92), row("theirs", 1.0, 30.0, 25.0)]
    best = row("best", 50.0, 20.0, 26.0, 23.0)
    here = [best, row("cheap", 5.0, 19.6, 25.5, 22.7), row("ours", 90.0, 40.0, 40.0, 40.0)]
    found = chosen_elsewhere(here, there)
    assert found is not None and (found.name, found.best) == ("cheap", "best"), "among rows that both have"
    assert found.loss.mean == pytest.approx(0.4) and 0.5 < found.loss.high < 0.6 and found.verdict == "unclear"
    level = [best, row("cheap", 5.0, 19.9, 25.9, 22.8)]
    assert chosen_elsewhere(level, there).verdict == "suffices"
    fallen = [best, row("cheap", 5.0, 18.0, 24.1, 21.0)]
    assert chosen_elsewhere(fallen, there).verdict == "too little"
    assert chosen_elsewhere(here, [row("theirs", 1.0, 30.0, 25.0)]) is None
    assert chosen_elsewhere([], there) is None
