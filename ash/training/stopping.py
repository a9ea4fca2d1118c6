"""When training ends: views that no step sees are scored on a schedule, and where they stop gaining, rates decay.

The length of a training is not known in advance. Learning rates rise over a few steps, stay, and fall along a cosine
over the last fifth, which begins when the scores lie on a plateau, or when four fifths of a limit are spent. A method
that learns slowly looks as if it rested for a while: up to some thousand steps all of them go on.
"""

import json
import math
from dataclasses import asdict, dataclass, replace

from ash.capture.typed import from_json
from ash.config import TrainingConfig

FIRST_MARK = 64  # Steps after which views are scored for the first time; twice on the way to half as many more, ...
LULL_STEPS = 1000  # Before that a lull is chance: static Gaussians rest at 200 steps and gain 0.5 dB afterwards.
LEAST_STEPS = 4000  # Before that no plateau ends a training: the mesh lay on one at 1,368 and then gained 0.5 dB.
GAIN_DB = 0.1  # Less than that, gained over the last third of the steps at two marks in a row, is a plateau.
RAMP_STEPS = 20  # Over which the learning rates rise.
DECAY = 0.25  # Of the steps before they fall, hence the last fifth of all.
FINAL_LEARNING_RATE = 0.02  # Of the initial one, at the end.


@dataclass(frozen=True, kw_only=True, slots=True)
class ReservedScore:
    """Foreground PSNR, dB, of the reserved views after a step, with the weights as they would be used."""

    step: int
    psnr: float


@dataclass(frozen=True, kw_only=True, slots=True)
class ScheduleState:
    """What a training has decided so far. It is part of the checkpoint: a resumed run decides nothing anew."""

    scores: tuple[ReservedScore, ...] = ()
    decay_from: int | None = None  # None: not yet
    ended_by: str = ""  # "plateau", "steps" or "seconds": what the decay began for

    def to_json(self) -> str:
        """For the checkpoint."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "ScheduleState":
        """What `to_json` wrote.

        Raises:
            ValueError: it is something else.
        """
        course: ScheduleState = from_json(cls, json.loads(text))
        return course


def is_eval_step(step: int) -> bool:
    """Whether views are scored after this step: 64, 78, 96, 118, ..., each 1.5 times the last but one."""
    if step < FIRST_MARK:
        return False
    nearest = round(2 * math.log(step / FIRST_MARK) / math.log(1.5))
    return step == round(FIRST_MARK * 1.5 ** (nearest / 2))


def gain_of_last_third(scores: tuple[ReservedScore, ...], *, since: int = 0) -> float | None:
    """What the last third of the steps gained, dB; None where there is no score of two thirds of them after `since`."""
    if not scores:
        return None
    before = [score for score in scores if since <= score.step <= 2 / 3 * scores[-1].step + 1]
    return scores[-1].psnr - before[-1].psnr if before else None


def update(course: ScheduleState, config: TrainingConfig, *, step: int, seconds: float) -> ScheduleState:
    """The course after a step: whether the rates begin to fall now, and for what.

    A plateau counts once the warm-up is less than half of the steps that are compared; where a limit is met on one, it
    is told before the limit. `seconds`: CPU time so far.
    """
    if course.decay_from is not None:
        return course
    share = 1.0 if config.schedule == "constant" else 1 / (1 + DECAY)
    spent = {"steps": step >= share * config.steps, "seconds": seconds >= share * config.seconds}
    limits = [limit for limit, is_met in spent.items() if is_met]
    scored = step >= LEAST_STEPS and course.scores and course.scores[-1].step == step
    if not (limits or scored):
        return course
    if step >= LULL_STEPS and has_plateaued(course.scores, since=2 * config.static_steps):
        return replace(course, decay_from=step, ended_by="plateau")
    return replace(course, decay_from=step, ended_by=limits[0]) if limits else course


def has_plateaued(scores: tuple[ReservedScore, ...], *, since: int) -> bool:
    """Whether less than `GAIN_DB` was gained twice in a row: one score alone strays by as much as that."""
    gains = [gain_of_last_third(scores[: len(scores) - back], since=since) for back in (0, 1)]
    return all(gain is not None and gain < GAIN_DB for gain in gains)


def last_step(course: ScheduleState, config: TrainingConfig) -> int:
    """After which step training ends, as far as that is known."""
    if course.decay_from is None:
        return config.steps
    if config.schedule == "constant":
        return course.decay_from
    return min(config.steps, course.decay_from + math.ceil(course.decay_from * DECAY))


def rate_factor(course: ScheduleState, config: TrainingConfig, *, step: int) -> float:
    """By what the learning rates are multiplied in a step; 1 throughout in the schedule of the release."""
    if config.schedule == "constant":
        return 1.0
    rise = min(1.0, (step + 1) / RAMP_STEPS)
    if course.decay_from is None:
        return rise
    fraction = (step - course.decay_from) / max(1, last_step(course, config) - course.decay_from)
    return rise * (FINAL_LEARNING_RATE + (1 - FINAL_LEARNING_RATE) * 0.5 * (1 + math.cos(math.pi * min(1.0, fraction))))
