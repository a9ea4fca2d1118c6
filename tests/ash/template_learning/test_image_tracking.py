"""The template from the training videos alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import paint_tube, write_tube_capture
from helpers.figures import ring_cameras, tube_mesh
from scipy.ndimage import gaussian_filter, minimum_filter

from ash.capture.dataset import Capture, Pose
from ash.template.graph import build_graph
from ash.template.template import skinned_template
from ash.template_learning.image_tracking import track_images
from ash.template_learning.observing import _least_around, blurred, observe, sample
from ash.training.images import ImageCrop

CAMERAS, SIZE, FRAMES = 6, 96, 4


def bulge(frame: int) -> np.ndarray:
    """How the tube's true canonical vertices differ from those at rest: outwards, up to 2 cm, more in odd frames."""
    rest = tube_mesh().vertices
    height = np.exp(-(((rest[:, 1:2] - 0.6) / 0.25) ** 2))
    return (0.008 + 0.012 * (frame % 2)) * height * rest * [10, 0, 10]


def waves() -> torch.Tensor:
    """A texture with something to see everywhere."""
    rng = np.random.default_rng(0)
    v, u = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64), indexing="ij")
    made = [np.sin(2 * np.pi * (a * u + b * v) + c) for a, b, c in rng.uniform([2, 2, 0], [6, 8, 6], (9, 3))]
    return torch.from_numpy(0.5 + 0.15 * np.stack(made).reshape(3, 3, 64, 64).sum(1)).float().clamp(0, 1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The tube with a painted, bulging surface."""
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    cameras = ring_cameras(CAMERAS, SIZE)
    train = replace(made.splits["train"], cameras=tuple(c.name for c in cameras), frames=tuple(range(FRAMES)))
    bulging = replace(made, cameras={c.name: c for c in cameras}, splits={"train": train})
    at_rest = skinned_template(made)

    def vertices(pose: Pose) -> torch.Tensor:
        canonical = torch.from_numpy(tube_mesh().vertices + bulge(pose.frame)).float()
        return at_rest.pose(pose).transforms.apply(canonical)

    paint_tube(bulging, waves(), vertices)
    return bulging


def errors_m(capture: Capture, *, passes: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances from the truth of what was tracked, and of the rest shape, `[t, v]`."""
    template = skinned_template(capture)
    tracked = track_images(capture, template, build_graph(tube_mesh(), nodes=30), passes=passes)
    true = np.stack([tube_mesh().vertices + bulge(frame) for frame in tracked.frames])
    found, before = tracked.canonical.numpy() - true, tube_mesh().vertices - true
    return np.linalg.norm(found, axis=-1), np.linalg.norm(before, axis=-1)


def test_images_alone_tell_where_the_surface_is_and_more_passes_tell_more(capture: Capture) -> None:
    left, before = errors_m(capture, passes=4)
    assert left.mean() < errors_m(capture, passes=1)[0].mean()
    middle = np.abs(tube_mesh().vertices[:, 1] - 0.6) < 0.3  # Elsewhere there is hardly anything to find.
    assert np.sqrt((left[:, middle] ** 2).mean()) < 0.55 * np.sqrt((before[:, middle] ** 2).mean())
    for frame in (0, 1):  # Of each frame its own bulge, not the mean of both.
        assert left[frame, middle].mean() < 0.5 * before[frame, middle].mean()


def test_every_frame_counts_also_when_there_is_one_and_tracking_is_the_same_again(capture: Capture) -> None:
    one = replace(capture, splits={"train": replace(capture.splits["train"], frames=(1,))})
    left, before = errors_m(one, passes=3)
    assert left.mean() < 0.6 * before.mean()
    assert np.array_equal(errors_m(one, passes=3)[0], left)


def test_a_view_is_cut_out_around_the_subject_with_its_outline() -> None:
    """A disc of radius 10.25 pixels, drawn with the coverage that its pixels have."""
    fine = np.indices((64 * 8, 64 * 8)).transpose(1, 2, 0) / 8 + 1 / 16
    inside = np.hypot(fine[..., 1] - 30, fine[..., 0] - 34) < 10.25
    alpha = inside.reshape(64, 8, 64, 8).mean((1, 3))
    rgba = np.zeros((64, 64, 4), np.uint8)
    rgba[..., 0], rgba[..., 3] = 200, np.round(255 * alpha)
    camera = ring_cameras(1, 64)[0]
    cutout = ImageCrop(pixels=torch.from_numpy(rgba[23:45, 19:41].copy()), left=19, top=23)
    view = observe(cutout, camera, blur=0.5)
    shift = camera.K[:2, 2] - view.K[:2, 2].numpy()
    outline = view.outline.numpy() + shift
    assert len(outline) > 60
    np.testing.assert_allclose(np.hypot(outline[:, 0] - 30, outline[:, 1] - 34), 10.25, atol=0.12)
    away = (outline - [30, 34]) / 10.25
    assert ((away * view.outward.numpy()).sum(1) > 0.98).all()
    row, column = (np.array([34, 30]) - shift[::-1]).astype(int)
    np.testing.assert_allclose(view.colours[row, column], [200 / 255, 0, 0, 0, 0, 0, 0, 0, 0, 1], atol=1e-5)
    assert view.colours[int(34 - shift[1]), int(41 - shift[0]), 9] == 0  # The rim's colours do not count.


def test_samples_are_bilinear_with_centres_at_a_half() -> None:
    image = torch.arange(12.0).reshape(3, 4, 1)
    points = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.5, 2.0], [-3.0, 9.0], [3.5, 2.5]])
    np.testing.assert_allclose(sample(image, points)[:, 0], [0, 0.5, 7, 8, 11])


@pytest.mark.parametrize(("size", "deviation"), [((40, 31), 1.5), ((40, 31), 0.5), ((3, 4), 1.5)])
def test_images_are_filtered_as_by_scipy(size: tuple[int, int], deviation: float) -> None:
    """Near the border, too, and where a filter reaches beyond the opposite one."""
    image = torch.rand(2, *size, generator=torch.Generator().manual_seed(0))
    expected = np.stack([gaussian_filter(channel, deviation) for channel in image.numpy()])
    np.testing.assert_allclose(blurred(image, deviation), expected, rtol=0, atol=1e-7)
    expected = minimum_filter(image[0].numpy(), 7)
    np.testing.assert_array_equal(_least_around(image[0], 3), expected)
