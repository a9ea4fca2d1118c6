"""The paper's warm-up: some frames are fitted one by one, each for as long as it gains, and decoders learn the fits."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.captures import tiny_plus

import ash.avatar
from ash.avatar import FITTED_EVERY, FITTED_GAIN, FITTED_LOOK, AshAvatar
from ash.capture.dataset import Capture
from ash.training.batches import Batch, draw_batch
from ash.training.images import load_training_images
from ash.training.losses import view_loss

LOOK = 5  # in place of a hundred steps


@pytest.fixture(scope="module")
def capture(capture: Capture) -> Capture:
    return capture.training_only()


def avatar(capture: Capture, **training: Any) -> AshAvatar:
    changes = {"warmup": "fitted", **training}
    config = tiny_plus({f"training.{key}": value for key, value in changes.items()}, steps=2, warmup_steps=2)
    return AshAvatar.from_capture(config, capture)


@pytest.mark.parametrize(("every", "fitted"), [(1, (0, 1, 2, 3)), (2, (0, 2)), (3, (0, 3)), (FITTED_EVERY, (0,))])
def test_every_so_manyth_frame_is_fitted_and_no_other(
    every: int, fitted: tuple[int, ...], capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To its own views, before the first step; decoders are then regressed to these frames, each to its own fit."""
    monkeypatch.setattr(ash.avatar, "FITTED_EVERY", every)
    made = avatar(capture, fitted_steps=2)
    shown: list[int] = []
    taught: dict[int, torch.Tensor] = {}

    def draw(*arguments: Any) -> Batch:
        batch = draw_batch(*arguments)
        shown.append(batch.frame)
        return batch

    def teach(frames: Sequence[int], target: Callable[[int], torch.Tensor]) -> None:
        taught.update({frame: target(frame) for frame in frames})

    monkeypatch.setattr(ash.avatar, "draw_batch", draw)
    monkeypatch.setattr(made, "_regress", teach)
    made.fit(capture, folder=tmp_path)
    assert shown == [frame for frame in fitted for _ in range(2)]
    assert tuple(taught) == fitted
    assert len({fit.numpy().tobytes() for fit in taught.values()}) == len(fitted)


Loss = Callable[[int], float]  # of a step


def steps_of_a_fit(made: AshAvatar, capture: Capture, loss: Loss, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many steps a frame is fitted whose loss takes such a course."""
    steps: list[float] = []

    def told(drawn: list[torch.Tensor], *_: Any) -> torch.Tensor:
        steps.append(loss(len(steps)))
        return steps[-1] + 0 * drawn[0].sum()

    with monkeypatch.context() as patch:
        patch.setattr(ash.avatar, "FITTED_LOOK", LOOK)
        patch.setattr(ash.avatar, "view_loss", told)
        made._fit_frame(load_training_images(capture), 0)
    return len(steps)


def falling(share: float) -> Loss:
    """By a share from look to look."""
    return lambda step: (1 - share) ** (step // LOOK)


@pytest.mark.parametrize(
    ("loss", "most", "expected"),
    [
        (lambda step: 1.0, 40, 2 * LOOK),
        (lambda step: 1.0 + step, 40, 2 * LOOK),
        (falling(0.9 * FITTED_GAIN), 40, 2 * LOOK),
        (falling(1.1 * FITTED_GAIN), 40, 40),
        (lambda step: 0.9**step, 43, 43),
        (lambda step: 0.9 ** min(step, 3 * LOOK), 40, 5 * LOOK),  # Four looks gain, the fifth does not.
        (lambda step: 0.9 ** min(step, 3 * LOOK + 2), 40, 6 * LOOK),
        (lambda step: 1.0, 2 * LOOK - 1, 2 * LOOK - 1),
        (lambda step: 1.0, 1, 1),
    ],
    ids=["level", "rising", "gains too little", "gains enough", "falls", "rests", "rests amid", "few", "one"],
)
def test_a_fit_ends_where_nothing_is_gained(
    loss: Loss, most: int, expected: int, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundredth less than in the steps looked at before is a gain; there are never more than `fitted_steps`."""
    assert (FITTED_LOOK, FITTED_GAIN) == (100, 0.01)
    assert steps_of_a_fit(avatar(capture, fitted_steps=most), capture, loss, monkeypatch) == expected


def test_a_fit_is_like_its_frame_and_stays_on_the_template(capture: Capture) -> None:
    made, images = avatar(capture, fitted_steps=30), load_training_images(capture)
    batch = draw_batch(images, made.config.training, 0, 0)

    def loss(raw: torch.Tensor) -> float:
        drawn = made._draw(raw, made._inputs_of(batch.frame), batch.cameras, batch.background, 0)
        return float(view_loss([drawn], [batch], made.config.training).detach())

    fitted = made._fit_frame(images, batch.frame)
    assert not fitted[:, :3].any() and not fitted.requires_grad
    assert loss(fitted) < 0.7 * loss(made.analytic)


def test_decoders_are_regressed_to_the_fits_for_the_steps_of_the_warm_up(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each frame's decoded Gaussians come near to its own fit; without steps they stay where they start."""
    far = {}
    for steps in (0, 40):
        monkeypatch.setattr(ash.avatar, "FITTED_EVERY", 2)
        made = avatar(capture, steps=40, warmup_steps=steps)
        fits = {frame: made.analytic + 0.3 + 0.1 * frame for frame in (0, 2)}
        made._fit_frame = lambda images, frame, fits=fits: fits[frame]  # type: ignore[method-assign]
        made._warm_up(load_training_images(capture))
        with torch.no_grad():
            apart = {frame: made.module.decode([made._inputs_of(frame)])[0] - fit for frame, fit in fits.items()}
        far[steps] = {frame: float(difference.square().mean().sqrt()) for frame, difference in apart.items()}
    assert far[0] == pytest.approx({0: 0.3, 2: 0.5})
    assert all(far[40][frame] < 0.25 * far[0][frame] for frame in fits)
