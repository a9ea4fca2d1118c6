import math
from dataclasses import replace

import numpy as np
import pytest

from ash import presets
from ash.capture.manifest import Split
from ash.config import TrainingConfig
from ash.training.images import reserved_views
from ash.training.stopping import (
    FINAL_LEARNING_RATE,
    LEAST_STEPS,
    ReservedScore,
    ScheduleState,
    gain_of_last_third,
    is_eval_step,
    last_step,
    rate_factor,
    update,
)

CONFIG = replace(presets.plus("ci").training, steps=20_000, warmup_steps=200, learning_rate=1e-3, ema=0.0)


def train(curve, config: TrainingConfig, *, seconds_per_step: float = 0.0) -> tuple[ScheduleState, list[float]]:
    """What would be decided if the reserved views scored `curve(step)`; and the rates' factors, step by step."""
    course, step, factors = ScheduleState(), 0, []
    while step < last_step(course, config):
        factors.append(rate_factor(course, config, step=step))
        step += 1
        if is_eval_step(step):
            course = replace(course, scores=(*course.scores, ReservedScore(step=step, psnr=float(curve(step)))))
        course = update(course, config, step=step, seconds=step * seconds_per_step)
    return course, factors


def test_marks_come_twice_on_the_way_to_half_as_many_steps_more():
    marks = [step for step in range(20_000) if is_eval_step(step)]
    assert marks[:5] == [64, 78, 96, 118, 144]
    assert 25 < len(marks) < 32
    for before, after in zip(marks, marks[2:], strict=False):
        assert after / before == pytest.approx(1.5, abs=0.02)


def test_training_ends_a_quarter_after_the_scores_stop_gaining():
    """A decibel per e-fold until 6,000 steps, then nothing: the plateau shows at the third mark after that."""
    course, factors = train(lambda step: 20 + math.log(min(step, 6000)), CONFIG)
    assert course.ended_by == "plateau"
    assert 6000 < course.decay_from < 6000 * 1.5**2
    assert len(factors) == pytest.approx(course.decay_from / 0.8, abs=1)
    before = [score for score in course.scores if score.step <= course.decay_from]
    assert gain_of_last_third(tuple(before)) < 0.1
    assert gain_of_last_third(tuple(before[:-1])) < 0.1
    assert gain_of_last_third(tuple(before[:-2])) > 0.1


def test_one_score_that_strays_is_no_plateau():
    steady = 0.15 / math.log(1.5)
    course, _ = train(lambda step: steady * math.log(step) - 0.06 * (6700 < step < 6900), CONFIG)
    assert any(score.step == 6780 for score in course.scores)
    assert course.ended_by == "steps"


def test_a_curve_that_gains_a_tenth_in_every_third_never_ends_by_itself():
    steady = 0.11 / math.log(1.5)
    course, factors = train(lambda step: steady * math.log(step), CONFIG)
    assert (course.ended_by, course.decay_from, len(factors)) == ("steps", 16_000, 20_000)


def test_a_level_warm_up_is_no_plateau():
    """While the base alone is trained nothing is learned about motion: twice the warm-up passes before it counts."""
    course, _ = train(lambda step: 20.0, replace(CONFIG, warmup_steps=2000))
    assert course.decay_from >= 3 * 2000 * 0.99


def test_no_lull_ends_a_training_of_less_than_some_thousand_steps():
    course, _ = train(lambda step: 20.0, CONFIG)
    assert course.ended_by == "plateau" and LEAST_STEPS <= course.decay_from < 1.25 * LEAST_STEPS


@pytest.mark.parametrize(("steps", "told"), [(1000, "steps"), (3000, "plateau")])
def test_a_limit_that_is_met_on_a_plateau_says_so(steps, told):
    """But not after so few steps that a lull is chance."""
    course, factors = train(lambda step: 20.0, replace(CONFIG, steps=steps))
    assert (course.ended_by, course.decay_from, len(factors)) == (told, 0.8 * steps, steps)
    course, _ = train(lambda step: step / 100, replace(CONFIG, steps=steps))
    assert course.ended_by == "steps"


def test_a_limit_in_seconds_leaves_a_fifth_of_them_for_the_decay():
    course, factors = train(lambda step: step, replace(CONFIG, seconds=60.0), seconds_per_step=0.02)
    assert (course.ended_by, course.decay_from, len(factors)) == ("seconds", 2400, 3000)


def test_rates_rise_stay_and_fall():
    _, factors = train(lambda step: step, replace(CONFIG, steps=1000))
    assert factors[:20] == pytest.approx(np.arange(1, 21) / 20)
    assert set(factors[20:801]) == {1.0}
    assert (np.diff(factors[800:]) < 0).all()
    assert factors[-1] == pytest.approx(FINAL_LEARNING_RATE, abs=1e-3)


def test_the_schedule_of_the_release_stays_and_ends_at_the_plateau_itself():
    course, factors = train(lambda step: 20.0, replace(CONFIG, schedule="constant"))
    assert set(factors) == {1.0}
    assert len(factors) == course.decay_from
    assert course.ended_by == "plateau"
    _, factors = train(lambda step: step, replace(CONFIG, schedule="constant", steps=300))
    assert len(factors) == 300


def test_a_course_survives_a_checkpoint():
    course = ScheduleState(
        scores=(ReservedScore(step=64, psnr=1 / 3), ReservedScore(step=78, psnr=21.0)),
        decay_from=78,
        ended_by="plateau",
    )
    assert ScheduleState.from_json(course.to_json()) == course


@pytest.mark.parametrize(
    ("cameras", "frames", "count"),
    [(12, 40, 24), (4, 16, 8), (12, 4, 6), (4, 4, 2), (12, 1, 1), (2, 40, 0), (3, 2, 0), (120, 2000, 24)],
)
def test_reserved_views_are_few_distinct_and_spread(cameras, frames, count):
    train = Split(cameras=tuple(f"cam{i}" for i in range(cameras)), frames=tuple(range(frames)))
    reserved = reserved_views(train)
    assert len(set(reserved)) == len(reserved) == count
    assert len({frame for _, frame in reserved}) == min(count, frames)
    assert len({camera for camera, _ in reserved}) == min(count, cameras)
    for frame in range(frames):
        assert sum(other == frame for _, other in reserved) <= cameras // 3
