"""Training images where there is room for few of them: the same batches, bounded memory, and no error lost."""

import shutil
from collections import Counter
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import tiny_plus

import ash.capture.dataset
import ash.training.loop
from ash.avatar import AshAvatar
from ash.bounded_cache import size_of
from ash.capture.dataset import Capture, image_path
from ash.capture.formats import load_capture
from ash.devices import CPU
from ash.files import InputError
from ash.training.batches import draw_ahead, draw_batch, sampled
from ash.training.images import STEPS_AHEAD, ReadAhead, load_training_images, read_crop
from ash.training.loop import Trainer

STEPS = 24


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each image is read."""
    counted: Counter[str] = Counter()
    read = ash.capture.dataset.read_image

    def counting(path: Path, *, shape: tuple[int, ...]) -> np.ndarray:
        counted[str(path)] += 1
        return read(path, shape=shape)

    monkeypatch.setattr(ash.capture.dataset, "read_image", counting)
    return counted


TRAINING = replace(tiny_plus(steps=4, warmup_steps=0).training, views_per_step=2)


def room_for(count: int, capture: Capture) -> int:
    """Bytes of the first so many cutouts."""
    return sum(size_of(read_crop(capture, *view)) for view in capture.splits["train"].views[:count])


def test_a_window_of_a_cutout_is_that_of_the_image(capture: Capture) -> None:
    camera = capture.cameras["cam1"]
    image = capture.image("cam1", 0)
    image[image[..., 3] == 0] = 0
    cutout = read_crop(capture, "cam1", 0)
    assert size_of(cutout) < image.nbytes
    padded = np.zeros((camera.height + 40, camera.width + 40, 4), np.uint8)
    padded[20:-20, 20:-20] = image
    for left, top, width, height in [
        (0, 0, camera.width, camera.height),
        (-7, 3, 20, 30),
        (19, 15, 9, 11),
        (60, 0, 5, 5),
    ]:
        window = padded[20 + top :][:height, 20 + left :][:, :width]
        np.testing.assert_array_equal(cutout.window(left, top, width, height).numpy(), window)


@pytest.mark.parametrize("crop", [True, False])
def test_with_little_room_and_readers_the_batches_are_those_of_the_whole_images(crop: bool, capture: Capture) -> None:
    images = replace(load_training_images(capture, max_bytes=room_for(3, capture)), whole=not crop)
    with closing(ReadAhead(images.views, readers=2)) as ahead:
        for step in [*range(STEPS), 5, 6, 2]:  # A training that was rolled back goes on from an earlier step.
            batch = draw_ahead(ahead, images, TRAINING, 3, step)
            assert [camera.name for camera in batch.cameras] == list(sampled(images, TRAINING, 3, step).cameras)
            for camera, target, mask in zip(batch.cameras, batch.targets, batch.foreground, strict=True):
                whole = capture.cameras[camera.name]
                left, top = np.round(whole.K[:2, 2] - camera.K[:2, 2]).astype(int)
                image = capture.image(camera.name, batch.frame)
                window = np.ascontiguousarray(image[top : top + camera.height, left : left + camera.width])
                rgb, alpha = np.split(window / np.float32(255), [3], axis=2)
                expected = torch.from_numpy(rgb * alpha) + (1 - torch.from_numpy(alpha)) * batch.background
                torch.testing.assert_close(target, expected, rtol=0, atol=2e-7)
                assert torch.equal(mask, torch.from_numpy(alpha[..., 0])) and float(mask.sum()) == pytest.approx(
                    image[..., 3].sum() / 255, rel=1e-5
                )
            if not crop:
                assert (batch.cameras[0].width, batch.cameras[0].height) == (whole.width, whole.height)


def test_what_is_kept_and_what_waits_is_bounded(capture: Capture, reads: Counter[str]) -> None:
    room = room_for(3, capture)
    reads.clear()
    images = load_training_images(capture, max_bytes=room)
    count = len(capture.splits["train"].views)
    assert count > 8 and sum(reads.values()) <= 4, "no more is read at the start than there is room for"
    assert 0 < images.views.bytes <= room
    with closing(ReadAhead(images.views, readers=3)) as ahead:
        for step in range(STEPS):
            draw_ahead(ahead, images, TRAINING, 0, step)
            assert ahead.waiting <= (STEPS_AHEAD - 1) * TRAINING.views_per_step
            assert images.views.bytes <= room
    assert ahead.waiting == 0
    assert sum(reads.values()) > count, "what was not kept was read again"
    reads.clear()
    everything = load_training_images(capture)
    for step in range(STEPS):
        draw_batch(everything, TRAINING, 0, step)
    assert set(reads.values()) == {1} and len(reads) == count


def test_what_a_reader_meets_reaches_the_training(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(capture.folder, tmp_path / "capture")
    copied = load_capture(tmp_path / "capture").training_only()
    avatar = AshAvatar.from_capture(tiny_plus(steps=200, warmup_steps=0), copied)
    images = load_training_images(copied, max_bytes=1)  # There is no room for any image.
    lost = image_path(copied.folder, "cam2", 3)
    lost.write_bytes(lost.read_bytes()[:100])
    monkeypatch.setattr(ash.training.loop, "CPU", torch.device("meta"))  # As where training is not on the CPU.
    opened = ash.training.loop.ReadAhead

    def noted(views: object, *, readers: int) -> ReadAhead:
        assert readers > 0
        ahead = opened(views, readers=readers)
        seen.append(ahead)
        return ahead

    seen: list[ReadAhead] = []
    monkeypatch.setattr(ash.training.loop, "ReadAhead", noted)
    with pytest.raises(InputError, match=r"cam2/000003\.png: expected a PNG image"):
        Trainer(avatar, avatar.config.training, images, seed=0, folder=tmp_path / "run").fit()
    assert seen[0].waiting == 0, "its threads have ended"


def test_on_the_cpu_a_step_reads_its_own(capture: Capture) -> None:
    images = load_training_images(capture)
    assert images.device == CPU
    with closing(ReadAhead(images.views, readers=0)) as ahead:
        assert ahead.of_step(0, lambda step: pytest.fail("nobody reads ahead")) is images.views


def test_an_image_that_shows_nobody_is_refused(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Capture, "image", lambda self, camera, frame: np.zeros((4, 4, 4), np.uint8))
    with pytest.raises(InputError, match="nobody is seen by camera cam1 in frame 2"):
        read_crop(capture, "cam1", 2)
