"""Dotted keys: what a configuration holds, what differs, and what is refused."""

import math
from dataclasses import dataclass

import pytest

from ash.fields import apply_overrides, changed, flat, for_json, suggest
from ash.files import InputError, hash_of


@dataclass(frozen=True, kw_only=True)
class Part:
    size: int = 4
    share: float = 0.5
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.size * self.share < 1:
            raise InputError("size times share: expected at least 1")


@dataclass(frozen=True, kw_only=True)
class Whole:
    part: Part = Part()
    parts: tuple[Part, ...] = (Part(), Part(size=8))
    on: bool = True
    limit: float | None = None


def test_every_field_has_a_key_and_what_differs_is_found() -> None:
    whole = Whole()
    assert flat(whole)["parts.1.size"] == 8 and flat(whole)["part.names"] == ()
    changes = (("limit", 2.0), ("on", False), ("part.names", ("a", "b")), ("parts.1.share", 0.25))
    after = apply_overrides(whole, changes, of="whole")
    assert changed(whole, after) == changes
    assert after.parts[0] is whole.parts[0] and after.part.size == 4
    assert changed(whole, whole) == ()


def test_values_are_what_the_annotation_says() -> None:
    after = apply_overrides(Whole(), {"part.names": ["a"], "part.share": 1}, of="whole")
    assert after.part.names == ("a",) and type(after.part.share) is float


def test_an_infinite_number_goes_through_files() -> None:
    changes = for_json((("part.share", math.inf), ("part.size", 8)))
    assert changes == {"part.share": "inf", "part.size": 8} and hash_of(changes)
    assert apply_overrides(Whole(), changes, of="whole").part == Part(share=math.inf, size=8)


def test_a_value_may_follow_from_the_rest() -> None:
    assert apply_overrides(Whole(), {"part.size": lambda whole: whole.part.size * 2}, of="whole").part.size == 8


def test_fields_that_must_agree_are_checked_together() -> None:
    together = {"part.size": 100, "part.share": 0.01}
    assert apply_overrides(Whole(), together, of="whole").part.size == 100
    with pytest.raises(InputError, match="at least 1"):
        apply_overrides(Whole(), {"part.share": 0.01}, of="whole")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"part.sise": 1}, r"whole: unknown key 'part.sise', did you mean part.size"),
        ({"share": 1.0}, r"unknown key 'share', did you mean part.share or parts.0.share"),
        ({"zzz": 1}, r"expected one of part.\*, parts.\*, on, limit"),
        ({"part.size": "4"}, "part.size: expected a whole number, got '4'"),
        ({"part.size": True}, "part.size: expected a whole number, got True"),
        ({"on": 1}, "on: expected true or false, got 1"),
        ({"part.names": [1]}, "part.names: expected"),
        ({"parts.2.size": 1}, "unknown key 'parts.2'"),
        ({"part": 3}, "part: expected"),
        ({"part.size": 1, "part.size.x": 2}, "both given"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        apply_overrides(Whole(), changes, of="whole")
    assert "\n" not in str(refusal.value)


def test_near_names_are_told_first() -> None:
    assert suggest("tihgt", ("tight", "loose")) == "did you mean tight?"
    assert suggest("x", ("tight", "loose")) == "expected one of tight, loose"
