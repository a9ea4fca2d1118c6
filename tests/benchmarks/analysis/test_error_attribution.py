"""Which truth channel explains an error."""

from pathlib import Path

import numpy as np
import pytest

from ash.capture.formats import load_capture
from benchmarks.analysis import error_attribution
from benchmarks.analysis.error_attribution import REGIONS, ErrorAttribution, Share, region_map, shares
from benchmarks.cell import metrics
from benchmarks.cell.schema import ViewScore

VIEW = ViewScore(split="novel_pose", camera="a", frame=0, prediction="d" * 64, scores={})


def cause(error: dict[str, float], pixels: dict[str, float], rank: float = 0.0) -> ErrorAttribution:
    found = tuple(Share(region=name, pixels=pixels.get(name, 0.0), error=error.get(name, 0.0)) for name in REGIONS)
    nothing = np.zeros((1, 1, 4), np.uint8)
    return ErrorAttribution(
        view=VIEW,
        shares=found,
        novelty_deg=21.4,
        novelty_rank=rank,
        map=np.zeros((1, 1)),
        truth=nothing,
        predicted=nothing,
    )


def test_shares_are_of_covered_pixels_and_their_error() -> None:
    regions = np.array([[0, 0, 4, 4], [4, 4, -1, -1]])
    error = np.array([[3.0, 3.0, 1.0, 1.0], [0.0, 0.0, 99.0, 99.0]])
    found = {share.region: (share.pixels, share.error) for share in shares(regions, error)}
    assert found["silhouette"] == (pytest.approx(2 / 6), 0.75)
    assert found["interior"] == (pytest.approx(4 / 6), 0.25)
    assert found["grazing view"] == (0.0, 0.0)


def test_a_region_explains_a_frame_if_its_error_is_dense_and_the_largest() -> None:
    dense = cause({"silhouette": 0.6, "interior": 0.4}, {"silhouette": 0.2, "interior": 0.8})
    assert dense.explanation.startswith("silhouette: 60 % of the squared error on 20 % of the pixels; pose 21 degrees")
    spread = cause({"silhouette": 0.3, "interior": 0.7}, {"silhouette": 0.2, "interior": 0.8}, rank=0.9)
    assert spread.explanation.startswith("interior: 70 %")
    assert spread.explanation.endswith("among the most novel quarter")
    thin = cause({"silhouette": 0.55, "interior": 0.45}, {"silhouette": 0.5, "interior": 0.5})
    assert thin.explanation.startswith("interior")  # not denser than elsewhere


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
