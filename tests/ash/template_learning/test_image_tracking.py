"""The template from the training videos alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.captures import write_tube_capture
from helpers.figures import ring_cameras, tube_mesh, tube_motion
from scipy.ndimage import gaussian_filter, minimum_filter

from ash.capture.dataset import Capture, Pose, image_path
from ash.files import write_image
from ash.mesh.drawing import draw_mesh, textured, topology_of
from ash.mesh.rasterizing import Rasterized, rasterize_by_warp
from ash.template.graph import build_graph
from ash.template.template import skinned_template
from ash.template_learning import image_tracking
from ash.template_learning.image_tracking import track_images
from ash.template_learning.nearest import NearestPoint, nearest_naive
from ash.template_learning.observing import _least_around, blurred, observe, sample
from ash.training.images import ImageCrop

SIZE, FRAMES = 96, 6


def bulge(frame: int) -> np.ndarray:
    """How the tube's true canonical vertices differ from those at rest: outwards, up to 2 cm, more in odd frames."""
    rest = tube_mesh().vertices
    height = np.exp(-(((rest[:, 1:2] - 0.6) / 0.25) ** 2))
    return (0.008 + 0.012 * (frame % 2)) * height * rest * [10, 0, 10]


def paint() -> torch.Tensor:
    """A texture with something to see everywhere."""
    rng = np.random.default_rng(0)
    v, u = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64), indexing="ij")
    waves = [np.sin(2 * np.pi * (a * u + b * v) + c) for a, b, c in rng.uniform([2, 2, 0], [6, 8, 6], (9, 3))]
    return torch.from_numpy(0.5 + 0.15 * np.stack(waves).reshape(3, 3, 64, 64).sum(1)).float().clamp(0, 1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """The tube with a painted, bulging surface, seen by eight cameras."""
    made = write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
    cameras, motion, mesh = ring_cameras(8, SIZE), tube_motion(FRAMES), tube_mesh()
    at_rest, topology = skinned_template(made), topology_of(torch.from_numpy(mesh.faces))
    uvs, uv_faces = torch.from_numpy(mesh.uvs).float(), torch.from_numpy(mesh.uv_faces)
    for frame in range(FRAMES):
        posed = at_rest.pose(Pose(motion, frame))
        vertices = posed.transforms.apply(torch.from_numpy(mesh.vertices + bulge(frame)).float())
        shade = textured(paint(), uvs, uv_faces, posed.normals, topology.faces, None)
        for camera in cameras:
            drawn = draw_mesh(vertices, topology, camera, shade, torch.zeros(3)).numpy()
            straight = np.where(drawn[..., 3:] > 0, drawn[..., :3] / np.maximum(drawn[..., 3:], 1e-3), 0)
            rgba = np.concatenate([straight, drawn[..., 3:]], -1)
            write_image(image_path(made.folder, camera.name, frame), np.round(255 * rgba.clip(0, 1)).astype(np.uint8))
    train = replace(made.splits["train"], cameras=tuple(c.name for c in cameras), frames=tuple(range(FRAMES)))
    return replace(made, cameras={c.name: c for c in cameras}, motion=motion, splits={"train": train})


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


def test_every_frame_counts_also_when_there_is_one(capture: Capture) -> None:
    train = replace(capture.splits["train"], frames=(1,))
    left, before = errors_m(replace(capture, splits={"train": train}), passes=3)
    assert left.mean() < 0.6 * before.mean()


def test_tracking_is_the_same_again_and_by_what_a_gpu_does_in_its_place(
    capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warp's rasteriser, on the CPU; and all distances in place of the tree.

    But for points of the outline where two edges start: of points in one place any may be the nearest.
    """
    train = replace(capture.splits["train"], frames=(0, 1))
    few = replace(capture, splits={"train": train})
    expected, before = errors_m(few, passes=2)
    assert np.array_equal(errors_m(few, passes=2)[0], expected)
    drawn, asked = [], []

    def rasterize(corners: torch.Tensor, faces: torch.Tensor, *, width: int, height: int) -> Rasterized:
        drawn.append(corners)
        rows = faces.to(torch.int32)
        return rasterize_by_warp(corners.double().contiguous(), rows, width=width, height=height, near=0.01)

    with monkeypatch.context() as patch:
        patch.setattr(image_tracking, "rasterize_mesh", rasterize)
        found, _ = errors_m(few, passes=2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    by_tree = NearestPoint.of

    def of(nearest: NearestPoint, places: torch.Tensor, within: float) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(len(places))
        distance, row = nearest_naive(nearest.points, places, within)
        torch.testing.assert_close(distance, by_tree(nearest, places, within)[0], rtol=1e-9, atol=1e-12)
        return distance, row

    monkeypatch.setattr(NearestPoint, "of", of)
    found, _ = errors_m(few, passes=2)
    assert len(drawn) == len(asked) == 2 * 2 * 8 and min(asked) > 50
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)  # Metres: before, it is a hundred times as much.
    assert before.max() > 1e-2


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
