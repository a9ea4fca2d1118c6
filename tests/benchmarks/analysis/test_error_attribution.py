"""Which truth channel explains an error."""

from pathlib import Path

import numpy as np
import pytest

from ash.capture.formats import load_capture
from benchmarks.analysis import error_attribution
from benchmarks.analysis.error_attribution import REGIONS, explanation, region_map
from benchmarks.cell import metrics


@pytest.mark.parametrize(
    ("edge", "novelty", "text"),
    [
        # pixels and squared error of the silhouette, of 10 pixels and an error of 100 that truth or prediction cover
        ((2, 60.0), (21.4, 0.0), "silhouette: 60 % of the squared error on 20 % of the pixels; pose 21 degrees"),
        ((2, 30.0), (21.4, 0.9), "interior: 70 % of the squared error on 80 % of the pixels; pose 21 degrees"),
        ((5, 55.0), (3.0, 0.0), "interior: 45 % of the squared error on 50 % of the pixels; pose 3 degrees"),
    ],
    ids=["dense and the largest", "dense and smaller", "not denser than elsewhere"],
)
def test_a_region_explains_a_frame_if_its_error_is_dense_and_the_largest(
    edge: tuple[int, float], novelty: tuple[float, float], text: str
) -> None:
    pixels, share = edge
    regions = np.array([[0] * pixels + [4] * (10 - pixels) + [-1] * 2])
    error = np.where(regions == 0, share / pixels, np.where(regions == 4, (100 - share) / (10 - pixels), 99.0))
    said = explanation(regions, error, *novelty)
    assert said.startswith(text)
    assert said.endswith("among the most novel quarter") == (novelty[1] == 0.9)


def test_depth_bends_at_edges_and_not_on_slopes() -> None:
    slope = np.tile(np.linspace(2.0, 4.0, 9), (9, 1))  # 25 cm per pixel
    hit = np.ones((9, 9), bool)
    assert not error_attribution._depth_steps(slope, hit).any()
    slope[:, 5:] += 0.2
    assert set(np.flatnonzero(error_attribution._depth_steps(slope, hit).any(0))) == {4, 5}


def test_regions_cover_truth_and_prediction_and_nothing_else(small_capture: Path) -> None:
    capture = load_capture(small_capture)
    camera, frame = capture.splits["novel_pose"].views[0]
    truth = metrics.foreground(metrics.on_black(capture.image(camera, frame)))
    predicted = np.roll(truth, 6, axis=1)
    visible = error_attribution._visible_triangles(capture.folder, capture.identity)
    regions = region_map(capture, camera, frame, truth, predicted, visible)
    assert ((regions >= 0) == (truth | predicted)).all()
    assert (regions[truth & ~predicted] == REGIONS.index("silhouette")).all()
    hidden = region_map(capture, camera, frame, truth, truth, np.zeros_like(visible))
    unseen = REGIONS.index("not visible in training")
    assert (hidden == unseen).sum() > (region_map(capture, camera, frame, truth, truth, visible) == unseen).sum()
    assert REGIONS.index("interior") not in hidden
