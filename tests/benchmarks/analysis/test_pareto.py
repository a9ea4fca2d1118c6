import pytest

from benchmarks.analysis.pareto import Candidate, chosen_on_others, front, smallest_sufficient


def candidate(name: str, quality: float, cost: float, spread: float = 0.05) -> Candidate:
    """Three seeds on one capture."""
    return Candidate(name=name, samples={"a": (quality - spread, quality, quality + spread)}, frame_ms=cost)


def over_captures(name: str, cost: float, *qualities: float) -> Candidate:
    """A value for each capture."""
    return Candidate(name=name, samples={f"{i}": (q,) for i, q in enumerate(qualities)}, frame_ms=cost)


FIELD = [candidate("best", 30.0, 100.0), candidate("near", 29.8, 40.0), candidate("fast", 25.0, 5.0)]


def test_the_front_holds_those_that_no_other_beats_in_both() -> None:
    assert front([*FIELD, candidate("slow and poor", 24.0, 50.0)]) == ("fast", "near", "best")
    assert front([]) == ()
    assert set(front([candidate("a", 20.0, 5.0), candidate("b", 20.0, 5.0)])) == {"a", "b"}


def test_the_smallest_sufficient_is_the_cheapest_that_is_not_inferior() -> None:
    found = smallest_sufficient(FIELD)
    assert found is not None and (found.name, found.best) == ("near", "best")
    assert 0.2 < found.loss_bound_db < 0.5
    noisy = smallest_sufficient([FIELD[0], candidate("near", 29.8, 40.0, spread=1.0), FIELD[2]])
    assert noisy is not None and (noisy.name, noisy.loss_bound_db) == ("best", 0.0), "an unknown loss does not suffice"
    assert smallest_sufficient([Candidate(name="a", samples={"a": (20.0,)}, frame_ms=1.0)]) is None
    assert smallest_sufficient([]) is None


def test_captures_are_compared_in_pairs() -> None:
    """Captures differ by far more than the methods: as samples nothing would suffice, in pairs the cheap one does."""
    best = over_captures("best", 50.0, 20.2, 24.2, 29.2, 31.2)
    found = smallest_sufficient([best, over_captures("cheap", 5.0, 20.0, 24.02, 28.98, 31.01)])
    assert found is not None and found.name == "cheap" and 0.2 < found.loss_bound_db < 0.25
    elsewhere = Candidate(name="x", frame_ms=1.0, samples={"elsewhere": (20.0, 21.0)})
    assert smallest_sufficient([best, elsewhere]) is None


def test_a_choice_is_judged_on_other_captures() -> None:
    there = [
        over_captures("best", 50.0, 30.0, 25.0),
        over_captures("cheap", 5.0, 29.9, 24.92),
        over_captures("theirs", 1.0, 30.0, 25.0),
    ]
    best = over_captures("best", 50.0, 20.0, 26.0, 23.0)

    def judged(*qualities: float) -> tuple[str, str, float, str]:
        here = [best, over_captures("cheap", 5.0, *qualities), over_captures("ours", 90.0, 40.0, 40.0, 40.0)]
        choice = chosen_on_others(here, there)
        assert choice is not None
        return choice[0].name, choice[0].best, round(choice[1].mean, 9), choice[1].verdict

    assert judged(19.6, 25.5, 22.7) == ("cheap", "best", -0.4, "unclear"), "among the methods that both have"
    assert judged(19.9, 25.9, 22.8)[3] == "equivalent"
    assert judged(18.0, 24.1, 21.0)[3] == "worse"
    assert chosen_on_others([best], [over_captures("theirs", 1.0, 30.0, 25.0)]) is None
    assert chosen_on_others([], there) is None
    assert best.psnr == pytest.approx(23.0)
