"""Accuracy against training seconds and against footage: who leads when, on numbers that are known."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.cells import cell

from ash.protocol import TrainingOutcome
from benchmarks.analysis import data_scaling, stability, time_to_quality
from benchmarks.analysis.scores import scores_of
from benchmarks.cell.cells import CellResult, CurvePoint, Snapshot
from benchmarks.cell.curves import seconds_to_settle
from benchmarks.report.content import Bullets, Chart
from benchmarks.report.sections import spent


def trained(method: str, course: dict[int, float], *, seed: int = 0) -> CellResult:
    """A cell whose snapshots scored as told; the last is its end."""
    *early, end = course.items()
    snapshots = tuple(
        Snapshot(seconds=float(s), split=split, psnr=p) for s, p in early for split in ("novel_view", "novel_pose")
    )
    outcome = TrainingOutcome(steps=100, seconds=float(end[0]), ended_by="plateau")
    return replace(cell(method, end[1], seed=seed), snapshots=snapshots, training=outcome)


STATIC = {30: 23.0, 60: 24.0, 120: 24.0}
LEARNED = {30: 22.0, 60: 23.5, 120: 25.0, 240: 26.0}


def test_methods_cross_where_their_scores_are_equal():
    """ASH is 0.5 dB behind after a minute and 1 dB ahead after two: a third of the way, in the logarithm."""
    table = time_to_quality.curves([trained("wo_mot", STATIC), trained("ash", LEARNED)])
    views = table[table.split == "novel_view"]
    assert views[views.method == "ash"].psnr.tolist() == [22.0, 23.5, 25.0, 26.0]
    assert views[views.method == "wo_mot"].psnr.tolist() == [23.0, 24.0, 24.0, 24.0]  # It had ended: kept.
    found = time_to_quality.crossings(views)
    assert (found.leader.tolist(), found.other.tolist()) == (["ash"], ["wo_mot"])
    assert found.seconds.item() == pytest.approx(60 * 2 ** (1 / 3))
    said = time_to_quality.sentences(views)
    assert said == ["On loose, held-out views, ASH is ahead of w/o mot. from 76 s of training on."]


def test_a_pair_that_never_crosses_is_said_to():
    table = time_to_quality.curves([trained("wo_mot", STATIC), trained("ash", {s: p + 1 for s, p in STATIC.items()})])
    assert time_to_quality.sentences(table)[0].endswith("ASH is ahead of w/o mot. at every time, by 1.0 to 1.0 dB.")


def test_seeds_give_intervals():
    cells = [
        trained("ash", {s: p + shift for s, p in LEARNED.items()}, seed=i) for i, shift in enumerate((-0.2, 0, 0.2))
    ]
    table = time_to_quality.curves(cells)
    assert (table.high > table.psnr).all() and (table.low < table.psnr).all()
    assert np.isnan(time_to_quality.curves(cells[:1]).low).all()


def test_seeds_are_averaged_within_captures_and_captures_give_intervals():
    runs = [
        replace(run, config=replace(run.config, capture=capture))
        for capture, shift in (("a", 0.0), ("b", 4.0))
        for seed in (0, 1)
        for run in [trained("ash", {s: p + shift + seed for s, p in LEARNED.items()}, seed=seed)]
    ]
    first = time_to_quality.curves(runs).query("split == 'novel_view'").iloc[0]
    assert (first.psnr, first.high - first.psnr) == (24.5, pytest.approx(12.706 * 2.0, rel=1e-4))  # t of 1 degree


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ((22.0, 23.1, 22.9, 23.5, 24.0), "from 160 training frames on."),
        ((23.1, 23.1, 23.1, 23.5, 24.0), "at every number of training frames that was tried, 20 to 320."),
        ((20.0, 20.0, 20.0, 20.0, 20.0), "at no number of training frames that was tried."),
        ((23.1, 22.0, 23.1, 22.0, 22.0), "at 20, 80 training frames, and no more at 320."),
    ],
)
def test_motion_pays_from_the_frames_on_after_which_it_never_loses(scores: tuple[float, ...], expected: str):
    frames = dict(zip((20, 40, 80, 160, 320), scores, strict=True))

    def made(method: str, score: float, count: int) -> CellResult:
        missing = 320 - count
        return cell(method, score, axis="footage" if missing else "", severity=float(missing))

    results = [made("ash", score, count) for count, score in frames.items()]
    results += [made("wo_mot", 23.0, count) for count in frames]
    table = data_scaling.curves(results)
    assert table[(table.method == "ash") & (table.split == "novel_pose")].frames.tolist() == [20, 40, 80, 160, 320]
    assert data_scaling.sentences(table) == [f"On loose, ASH is above w/o mot. on held-out motion {expected}"]
    assert list(dict.fromkeys(table.split)) == ["novel_view", "novel_pose"], "as they are told everywhere"
    assert stability.curves(scores_of(results)) == (), "less footage spoils nothing"


def test_the_sections_draw_what_was_run():
    results = [trained("wo_mot", STATIC), trained("ash", LEARNED)]
    (section,) = spent(results)
    chart, said = section.blocks
    assert isinstance(chart, Chart) and chart.figure.file == "chart_budget.svg" and len(chart.figure.panels) == 2
    assert chart.figure.svg().count("ahead") == 0 and chart.figure.svg().count("ASH") >= 1
    assert isinstance(said, Bullets) and any("ahead" in sentence for sentence in said.items)
    assert spent([cell("ash", 20.0)]) == []


def test_scenes_of_other_levels_have_scales_of_their_own_and_splits_of_a_scene_share_one():
    results = [trained("ash", LEARNED), trained("wo_mot", STATIC)]
    results += [replace(r, config=replace(r.config, scene="elsewhere")) for r in [trained("ash", {30: 31.0, 60: 33.0})]]
    (section,) = spent(results)
    chart = section.blocks[0]
    assert isinstance(chart, Chart)
    spans = [panel.to_dict()["layer"][1]["encoding"]["y"]["scale"]["domain"] for panel in chart.figure.panels]
    assert len(spans) == 4 and spans[0] == spans[1] != spans[2] == spans[3]
    assert spans[0][1] < 27 and spans[2][0] > 30


def test_a_curve_settles_where_it_never_leaves_the_last_three_tenths_again():
    scores = {10: 20.0, 20: 24.8, 30: 24.5, 40: 24.75, 80: 25.0}
    curve = tuple(CurvePoint(seconds=float(s), loss=None, psnr=p) for s, p in scores.items())
    assert seconds_to_settle(curve) == 40
    assert seconds_to_settle(curve[-1:]) == 80
    assert seconds_to_settle((CurvePoint(seconds=1.0, loss=0.1, psnr=None),)) is None
