"""The search for decoders that suffice: what is left out, what is chosen, what is kept."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.captures import tiny_preset, write_tube_capture

from ash import searching
from ash.avatar import AshAvatar
from ash.files import InputError
from ash.searching import Tried, smallest_sufficient, without_a_sequence
from baselines.ddc import DdcAvatar, ddc_config


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tube")
    return replace(write_tube_capture(folder / "capture").training_only(), store=folder / "templates")


def tried(name: str, parameters: int, seen: float, left_out: float) -> Tried:
    return Tried(name=name, parameters=parameters, fade=1.0, seen=seen, left_out=left_out)


def test_the_smallest_that_loses_less_than_a_tenth_of_a_decibel_is_chosen():
    found = [tried("large", 900, 26.0, 24.0), tried("half", 400, 25.9, 23.95), tried("quarter", 100, 25.0, 24.5)]
    assert smallest_sufficient(found).name == "half"
    found.append(tried("as small, better", 400, 26.0, 24.0))
    assert smallest_sufficient(found).name == "as small, better"


def test_the_middle_sequence_is_left_out_and_of_a_single_one_the_end(capture):
    less, apart = without_a_sequence(capture)
    assert (less.splits["train"].frames, apart.frames) == ((0, 1, 2), (3,))
    motion = replace(capture.motion, sequence=np.array([0, 1, 1, 2, 3, 3]))
    less, apart = without_a_sequence(replace(capture, motion=motion))
    assert (less.splits["train"].frames, apart.frames) == ((0, 3), (1, 2))
    assert "novel_view" not in less.splits
    one = replace(capture, splits={"train": replace(capture.splits["train"], frames=(0,))})
    with pytest.raises(InputError, match="only one"):
        without_a_sequence(one)


@pytest.mark.parametrize("method", ["ash", "ddc"])
def test_a_choice_is_made_once_recorded_and_trained(capture, tmp_path, monkeypatch, method):
    monkeypatch.setattr(searching, "SEARCH_STEPS", 6)
    config = replace(tiny_preset(steps=8, warmup_steps=2), search=True)
    config = replace(config, model=replace(config.model, window=3))

    def make():
        if method == "ash":
            return AshAvatar(config, capture)
        return DdcAvatar(ddc_config(config, seed=0, template=config.template), capture)

    avatar = make()
    choice = avatar.choice
    assert [one.name for one in choice.tried] == [candidate.name for candidate in searching.CANDIDATES]
    assert choice.name == smallest_sufficient(choice.tried).name
    assert choice.seconds > 0 and choice.fade in searching.FADES
    assert len({one.parameters for one in choice.tried}) == 3  # Noise has none.
    monkeypatch.setattr(searching, "_search", lambda *_: pytest.fail("searched again"))
    again = make()
    assert again.choice == choice and again.parameter_count() == avatar.parameter_count()
    assert avatar.parameter_count() == next(one.parameters for one in choice.tried if one.name == choice.name)
    avatar.fit(capture, folder=tmp_path)
    assert avatar.outcome().choice == f"{choice.name}, fade {choice.fade:g}"
    assert avatar.outcome().search_seconds == choice.seconds
    first = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[0])
    assert first["choice"]["name"] == choice.name


def test_there_is_nothing_to_choose_without_decoders(capture):
    config = replace(tiny_preset(steps=8, warmup_steps=2), search=True)
    training = replace(config.training, warmup="none", warmup_steps=0)
    static = replace(config, model=replace(config.model, motion=False), training=training)
    assert AshAvatar(static, capture).choice is None
