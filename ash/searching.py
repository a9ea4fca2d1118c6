"""No more than the scene needs: how large the decoders are is chosen on a sequence of the training motion left out.

Every candidate is trained for a few hundred steps without the sequence, then scored on new views of what it saw and on
the sequence. The smallest that loses little against the best is taken, and with it how fast its corrections fade with
the novelty of a pose. The choice is made once per capture and configuration, and kept beside learned templates.
"""

import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ash.capture.dataset import Capture, Pose, Split
from ash.capture.typed import from_json
from ash.config import TrainingConfig
from ash.files import InputError, hash_of, hash_sources, only_one, read_json, write_json
from ash.protocol import Avatar, StageClock, TrainingOutcome
from ash.textures import TextureDrawer

SEARCH_STEPS = 600
LEFT_OUT_VIEWS = 24
FADES = (0.35, 0.5, 0.7, 1.0, 1.4)  # Novelties at which half of a picture is decoded, in spreads.
SUFFICIENT_DB = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class Candidate:
    """A size of the decoders, relative to the preset's."""

    name: str
    halvings: int = 0  # of the width
    history: bool = True  # False: a window of one frame
    place: bool = True  # False: no Phi
    noise: float = 0.0  # in the textures


CANDIDATES = (
    Candidate(name="as the preset"),
    Candidate(name="one frame, no Phi", history=False, place=False),
    Candidate(name="half width, one frame, no Phi", halvings=1, history=False, place=False),
    Candidate(name="half width, one frame, no Phi, noise", halvings=1, history=False, place=False, noise=1.0),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Tried:
    """What a candidate came to: foreground PSNR, dB, of reserved views of what it saw, and of the sequence left out."""

    name: str
    parameters: int
    fade: float
    seen: float
    left_out: float

    @property
    def worth(self) -> float:
        """Seen and unseen motion count alike."""
        return (self.seen + self.left_out) / 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Choice:
    """What the search settled on, everything that it tried, and the CPU seconds that it took when it was made."""

    name: str
    fade: float
    seconds: float
    tried: tuple[Tried, ...]

    @property
    def candidate(self) -> Candidate:
        """The candidate of that name."""
        return next(candidate for candidate in CANDIDATES if candidate.name == self.name)


class Sized(Avatar, Protocol):
    """What the search needs of an avatar besides."""

    def outcome(self) -> TrainingOutcome | None:
        """How training ended."""

    def texture_drawer(self) -> TextureDrawer | None:
        """What fades the corrections; None for an avatar that has none."""


Build = Callable[[Candidate, Capture], Sized]  # an avatar of that size, which trains as `brief_training` says


def brief_training(training: TrainingConfig) -> TrainingConfig:
    """The same training, as long as the search lets a candidate have."""
    steps = min(training.steps, SEARCH_STEPS)
    return replace(
        training, steps=steps, warmup_steps=min(training.warmup_steps, steps // 4), seconds=math.inf, snapshots=False
    )


def at_size(config: Any, candidate: Candidate, fade: float) -> Any:
    """A configuration, of ASH or the mesh avatar, at a candidate's size; its search is over."""
    model = replace(
        config.model,
        width=max(1, config.model.width >> candidate.halvings),
        window=config.model.window if candidate.history else 1,
        global_features=config.model.global_features and candidate.place,
        fade=fade,
    )
    training = replace(config.training, texture_noise=candidate.noise or config.training.texture_noise)
    return replace(config, model=model, training=training, search=False)


def sufficient(build: Build, config: Any, capture: Capture) -> Choice:
    """The smallest candidate that suffices on a capture, from the capture's `store` where it was found before."""
    if capture.store is None:
        return _search(build, capture)
    path = capture.store / f"{_key(config, capture)}.json"
    with only_one(path):
        if not path.exists():
            write_json(path, asdict(_search(build, capture)))
        return _read(path)


def smallest_sufficient(tried: Sequence[Tried]) -> Tried:
    """The fewest parameters among those that lose less than 0.1 dB against the best; of equals, the better."""
    best = max(one.worth for one in tried)
    return min((one for one in tried if one.worth > best - SUFFICIENT_DB), key=lambda one: (one.parameters, -one.worth))


def without_a_sequence(capture: Capture) -> tuple[Capture, Split]:
    """Training without one of the training sequences, the middle one, and views of it, evenly spread.

    Of a single sequence, its last quarter is left out.

    Raises:
        InputError: there are fewer than two training frames.
    """
    train = capture.splits["train"]
    if len(train.frames) < 2:
        raise InputError(f"{capture.folder}: a search leaves training frames out, and there is only one")
    numbers = [int(capture.motion.sequence[frame]) for frame in train.frames]
    known = sorted(set(numbers))
    apart = [frame for frame, number in zip(train.frames, numbers, strict=True) if number == known[len(known) // 2]]
    if len(known) == 1:
        apart = list(train.frames[-max(1, len(train.frames) // 4) :])
    rest = train.only(frames=[frame for frame in train.frames if frame not in apart])
    return replace(capture, splits={"train": rest}), train.only(frames=apart)


def with_choice(outcome: TrainingOutcome | None, choice: Choice | None) -> TrainingOutcome | None:
    """The outcome of a training that a search came before."""
    if outcome is None or choice is None:
        return outcome
    return replace(outcome, choice=f"{choice.name}, fade {choice.fade:g}", search_seconds=choice.seconds)


def write_choice(choice: Choice, log: Path) -> None:
    """Note the choice in a training's log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(json.dumps({"choice": asdict(choice)}) + "\n")


def _search(build: Build, capture: Capture) -> Choice:
    start = time.process_time()
    less, apart = without_a_sequence(capture)
    tried = [_try(build(candidate, less), candidate, less, apart) for candidate in CANDIDATES]
    chosen = smallest_sufficient(tried)
    return Choice(name=chosen.name, fade=chosen.fade, seconds=time.process_time() - start, tried=tuple(tried))


def _try(avatar: Sized, candidate: Candidate, capture: Capture, apart: Split) -> Tried:
    with tempfile.TemporaryDirectory() as folder:
        avatar.fit(capture, folder=Path(folder))
    outcome, drawer = avatar.outcome(), avatar.texture_drawer()
    assert outcome is not None and drawer is not None
    views = [apart.views[i] for i in np.linspace(0, len(apart.views) - 1, LEFT_OUT_VIEWS).round().astype(int)]
    scores = {}
    for fade in FADES:
        drawer.fade = fade
        scores[fade] = _psnr(avatar, capture, sorted(set(views)))
    fade = max(scores, key=scores.__getitem__)
    left_out = scores[fade]
    seen = left_out if outcome.reserved_psnr is None else outcome.reserved_psnr
    return Tried(name=candidate.name, parameters=avatar.parameter_count(), fade=fade, seen=seen, left_out=left_out)


def _psnr(avatar: Sized, capture: Capture, views: Sequence[tuple[str, int]]) -> float:
    """Foreground PSNR over views, dB."""
    errors = [_squared_errors(avatar, capture, name, frame) for name, frame in views]
    return -10 * math.log10(max(float(np.concatenate(errors).mean()), 1e-10))


def _squared_errors(avatar: Sized, capture: Capture, name: str, frame: int) -> np.ndarray:
    truth = capture.image(name, frame).astype(np.float32) / 255
    drawn = avatar.render(Pose(capture.motion, frame), capture.cameras[name], clock=StageClock())
    errors: np.ndarray = (drawn[..., :3] - truth[..., :3] * truth[..., 3:])[truth[..., 3] > 0.5] ** 2
    return errors.ravel()


def _key(config: Any, capture: Capture) -> str:
    train = capture.splits["train"]
    decisive = {
        "capture": capture.identity,
        "config": repr(config),
        "train": asdict(train),
        "sources": hash_sources(Path(__file__).parent),
        "torch": torch.__version__,
    }
    return hash_of(decisive)[:16]


def _read(path: Path) -> Choice:
    content = read_json(path)
    try:
        choice: Choice = from_json(Choice, content)
        if choice.name not in {candidate.name for candidate in CANDIDATES}:
            raise ValueError(f"unknown candidate {choice.name!r:.60}")
        return choice
    except ValueError as error:
        raise InputError(f"{path}: expected the choice of a search ({error}); remove it") from error
